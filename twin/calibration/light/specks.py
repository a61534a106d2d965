"""Fit of specks on the window (bubbles, grains, dust): bright spots that do not move while pins pass behind them."""

import cv2
import numpy as np

from scenes.sensor import ResponseSpec, SensorSpec, SpeckSpec
from twin.calibration.light.still import Still, fit_bounded, level_misfit, sample_field, subpixel_offsets
from twin.camera.capture import blurred
from twin.camera.projection import lens_disc
from twin.evaluation.pictures.aligned import to_light, with_changes
from twin.evaluation.pictures.statistics import clear_of_pins
from twin.frames.forms import gray_levels
from twin.geometry.pins import usual_spacing
from twin.optics.static_layer import reflections

# Distance from the disc's edge, px, within which nothing is searched, because the edge is blurred.
RIM_PX = 3.0
# Least distance of every pin's middle from a place that is clear in a frame, as a share of the pins' spacing.
CLEAR_SHARE = 0.41
# Distance of a cap's middle, as a share of the pins' spacing, below which the cap is directly behind a place.
BEHIND_SHARE = 0.28
# Least number of frames in which a place must be clear, and least number of caps behind a speck from which its opacity is measured.
LEAST_FRAMES = 3
# Number of neighbours of such a cap whose light is taken as that of the cap without the speck.
NEIGHBOURS = 6
# Side of the median filter that gives the background level, px; least difference of a speck from this level, gray levels.
GROUND_PX, LEAST_RISE_LEVELS = 25, 8.0
# Least and largest area of a speck, px^2.
AREA_PX2 = (3, 90)
# Least area of a speck relative to that of the circle around it.
LEAST_ROUNDNESS = 0.45
# Least share of a speck's border at which the window is visible.
LEAST_CLEAR_BORDER = 0.7
# Side of the square by which the LEDs' reflections are grown before they are left out, px.
REFLECTION_MARGIN_PX = 9
# Half of the side of the square in which a speck is compared, px.
PATCH_PX = 6
# Bounds of a speck's radius, mm, and of its light; largest distance of its place from the first guess, mm.
RADIUS_MM, LIGHT, MOST_MOVE_MM = (0.03, 0.6), (1e-4, 3.0), 0.15
# Starting value of the radius, mm.
START_RADIUS_MM = 0.15
# Least share of the squared misfit around a speck that its model must explain. Otherwise it is not a soft disc, and is left out.
LEAST_GAIN = 0.6
# Most specks that are kept. The most significant ones are kept.
MOST_SPECKS = 60
# Opacity of all specks if no cap passes behind any of them. If some were measured, the others have the opacity of the speck with the most
# similar brightness.
PLAIN_OPACITY = 0.5


class _WindowView:
    """The window in frames (M, H, W, 3) uint8 with pins at (M, N, 2) px, from the frames in which no pin is near a place.

    Attributes
    ----------
    gray : (M, H, W) uint8
        All frames.
    pins_px : (M, N, 2) float
    spacing_px : float
        Spacing of the pins in the first frame.
    place_mm : (H, W, 2) float
        Place at which each pixel's ray passes from the window into the gel.
    usable : (H, W) bool
        Pixels in the disc that are away from the LEDs' reflections, and clear of pins in enough frames.
    behind : (H, W) float32
        Median gray level over the frames in which a pixel is clear; 0 if it is not usable.
    ground : (H, W) float32
        ``behind`` without small bright spots.
    rise : (H, W) float32
        Gray levels above the ground; 0 if not usable.
    """

    def __init__(self, spec: SensorSpec, still: Still, images: np.ndarray, pins_px: np.ndarray) -> None:
        self.gray, self.pins_px = np.array([gray_levels(image) for image in images]), pins_px
        self.spacing_px = usual_spacing(pins_px[0])
        shape, disc, response, lens = self.gray.shape[1:], lens_disc(spec.view, spec.housing), spec.response, spec.lens
        clear = np.array([clear_of_pins(shape, pins, CLEAR_SHARE * self.spacing_px) for pins in pins_px])
        u2 = np.sum(still.tangents**2, axis=-1, keepdims=True)
        in_window = 1 / np.sqrt(lens.refractive_index**2 + (lens.refractive_index**2 - 1) * u2)  # tangent in the window / tangent in air
        self.place_mm = still.tangents * (lens.back_mm + spec.camera.distance_mm + lens.thickness_mm * in_window)
        shine = reflections(spec.view, spec.leds, spec.housing, still.tangents).max(axis=2) * response.exposure
        least_shine = to_light(np.array(response.black_level + LEAST_RISE_LEVELS), response)
        grown = cv2.dilate((shine > least_shine).astype(np.uint8), np.ones((REFLECTION_MARGIN_PX, REFLECTION_MARGIN_PX)))
        y, x = np.mgrid[: shape[0], : shape[1]]
        in_disc = disc.distance_px(np.stack([x, y], axis=-1)) < disc.radius_px - RIM_PX
        self.usable = in_disc & ~(grown > 0) & (clear.sum(axis=0) >= LEAST_FRAMES)
        self.behind = np.zeros(shape, np.float32)
        seen = np.where(clear[:, self.usable], self.gray[:, self.usable].astype(np.float32), np.nan)
        self.behind[self.usable] = np.nanmedian(seen, axis=0)
        self.ground = _without_spots(self.behind, self.usable)
        self.rise = np.where(self.usable, self.behind - self.ground, 0)


def fit_specks(spec: SensorSpec, still: Still, images: np.ndarray, pins_px: np.ndarray) -> SensorSpec:
    """The specification with the specks in frames (M, H, W, 3) uint8, whose pins are at (M, N, 2) px."""
    view = _WindowView(spec, still, images, pins_px)
    centers = _bright_spots(view)
    opacities = np.array([_measured_opacity(view, center, spec.response) for center in centers])
    brightness = np.array([view.rise[row, column] for column, row in np.rint(np.array(centers).reshape(-1, 2)).astype(int)])
    if len(known := np.flatnonzero(np.isfinite(opacities))):  # each has that of the known one whose brightness is most similar
        opacities = opacities[known[np.argmin(np.abs(brightness[known] - brightness[:, None]), axis=1)]]
    specks: list[SpeckSpec] = []
    for center, opacity in zip(centers, np.nan_to_num(opacities, nan=PLAIN_OPACITY).tolist(), strict=True):
        speck = _fitted_speck(view, center, opacity, spec.response)
        if speck and not any(np.hypot(speck.x_mm - s.x_mm, speck.y_mm - s.y_mm) < s.radius_mm for s in specks):
            specks.append(speck)
    return with_changes(spec, appearance={"specks": [speck.model_dump() for speck in specks]})


def _without_spots(behind: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Gray levels (H, W) without small bright spots: the median around each pixel, after gaps were filled from their surroundings."""
    weight = blurred(usable.astype(np.float32), GROUND_PX / 4)
    filled = np.where(usable, behind, blurred(behind, GROUND_PX / 4) / np.maximum(weight, 1e-6))
    return cv2.medianBlur(np.clip(np.rint(filled), 0, 255).astype(np.uint8), GROUND_PX).astype(np.float32)


def _bright_spots(view: _WindowView) -> list[np.ndarray]:
    """Middles (2,) px of round bright spots; the most significant comes first."""
    count, labels, stats, centers = cv2.connectedComponentsWithStats((view.rise > LEAST_RISE_LEVELS).astype(np.uint8), connectivity=8)
    found = []
    for k in range(1, count):
        area, across = stats[k, cv2.CC_STAT_AREA], max(stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT])
        if AREA_PX2[0] <= area <= AREA_PX2[1] and area > LEAST_ROUNDNESS * np.pi / 4 * across**2:
            spot = labels == k
            border = (cv2.dilate(spot.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (labels == 0)
            if view.usable[border].mean() > LEAST_CLEAR_BORDER:
                found.append((float(view.rise[spot].sum()), centers[k]))
    return [center for _, center in sorted(found, key=lambda each: -each[0])[:MOST_SPECKS]]


def _measured_opacity(view: _WindowView, center_px: np.ndarray, response: ResponseSpec) -> float:
    """Share of a cap's light that a speck hides; NaN if too few caps pass behind it.

    A cap directly behind the speck is compared with its neighbours in the same frame. The light that the speck itself sends is measured in
    the frames in which the place is clear.
    """
    frames, pins = np.nonzero(np.linalg.norm(view.pins_px - center_px, axis=2) < BEHIND_SHARE * view.spacing_px)
    if len(frames) < LEAST_FRAMES:
        return np.nan
    column, row = np.rint(center_px).astype(int)
    before = np.median(to_light(view.gray[frames, row, column], response))
    beside = [_neighbours(view.pins_px[frame], int(pin)) for frame, pin in zip(frames, pins, strict=True)]
    caps_px = np.rint(np.concatenate([view.pins_px[f, near] for f, near in zip(frames, beside, strict=True)])).astype(int)
    cap = np.median(to_light(view.gray[np.repeat(frames, list(map(len, beside))), caps_px[:, 1], caps_px[:, 0]], response))
    bare, clear = (to_light(level[row, column], response) for level in (view.ground, view.behind))
    return float(np.clip(1 - (before - clear) / max(cap - bare, 1e-6), 0, 1))


def _neighbours(pins_px: np.ndarray, pin: int) -> np.ndarray:
    """Indices of the found pins nearest to one of the pins (N, 2). Lost pins are NaN."""
    nearest = np.argsort(np.linalg.norm(pins_px - pins_px[pin], axis=1))[1 : 1 + NEIGHBOURS]
    return nearest[np.isfinite(pins_px[nearest, 0])]


def _fitted_speck(view: _WindowView, center_px: np.ndarray, opacity: float, response: ResponseSpec) -> SpeckSpec | None:
    """A speck with place, radius and light fitted to the gray levels around it; None if a soft disc does not explain them."""
    column, row = np.rint(center_px).astype(int)
    top, left = max(row - PATCH_PX, 0), max(column - PATCH_PX, 0)
    patch = slice(top, row + PATCH_PX + 1), slice(left, column + PATCH_PX + 1)
    real = np.where(view.usable[patch], view.behind[patch], np.nan)
    used, dark = np.isfinite(real), to_light(view.ground[patch], response)
    y, x = np.mgrid[patch]
    at_mm = sample_field(view.place_mm, np.stack([x, y], axis=-1)[..., None, None, :] + subpixel_offsets())
    first_mm = sample_field(view.place_mm, center_px[None])[0]
    peak = max(float(to_light(np.nanmax(real), response)), 2 * LIGHT[0])

    def residual(values: np.ndarray) -> np.ndarray:
        away = np.linalg.norm(at_mm - first_mm - values[:2], axis=-1) / np.exp(values[2])
        disc = np.clip(2 - 2 * away, 0, 1).mean(axis=(2, 3))  # 1 up to half the radius, then decreasing linearly
        light = blurred((1 - opacity * disc) * dark + np.exp(values[3]) * disc, response.blur_sigma_px)
        return level_misfit(light[used][:, None], real[used][:, None], response)[:, 0]

    low, high = np.array([(-MOST_MOVE_MM, MOST_MOVE_MM)] * 2 + [np.log(RADIUS_MM), np.log(LIGHT)]).T
    found = fit_bounded(residual, np.array([0, 0, np.log(START_RADIUS_MM), np.log(peak)]), low, high)
    without = np.append(found[:3], np.log(1e-9))
    if np.sum(residual(found) ** 2) > (1 - LEAST_GAIN) * np.sum(residual(without) ** 2):
        return None
    radius_mm, light = np.exp(found[2:]).tolist()
    x_mm, y_mm = (first_mm + found[:2]).tolist()
    return SpeckSpec(x_mm=x_mm, y_mm=y_mm, radius_mm=radius_mm, opacity=opacity, light=light)
