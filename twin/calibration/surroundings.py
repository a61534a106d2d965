"""What contact does not change: the disc's edge, the ring and its LEDs' glow, the LEDs' reflections in the window, specks.

Found in the frames' per-pixel median, as gray levels behind the known response curve. Saturated pixels only say "at least".
LED power, gel haze and everything behind the window's gel side stay as the specification has them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from scenes.sensor import SensorSpec
from twin.calibration.aligned import SATURATED, revised, to_light
from twin.camera import blurred, hazed, vignetted
from twin.errors import FrameError
from twin.optics.static_layer import housing_light, reflections
from twin.preprocess.forms import gray_levels
from twin.projection import pixel_rays
from twin.realism.disc import lens_disc, round_disc
from twin.realism.spots import clear_of_pins, pin_spacing_px

MOST_BINARY = 0.6  # share of pixels at exactly 0 or 255 above which frames are thresholded (raw ones saturate on the ring only)
MOST_FRAMES = 40  # evenly chosen: more do not make the median better
EDGE_RAYS = 720
EDGE_REACH = ((0.75, 1.3), (0.9, 1.1), (0.9, 1.1))  # of the radius, searched in each pass
EDGE_STEP_PX, TOP_PX = 0.25, 4.0  # along a ray; from where the ring begins to where its light is read
EDGE_PX = 0.5  # beyond this a place of the edge counts less (cables, flaws of the rim)
RIM_PX = 3.0  # the edge itself is left out by this much on both sides
LEVELS = 16.0  # residual in gray levels beyond which a pixel counts less
STEP = 0.01  # of a parameter's range, for slopes
GLOW_SHARE, GLOW_SMOOTH_DEG = 0.12, 4.0  # width of the ring, of the disc's radius, whose brightness tells the LEDs' azimuths
ALIKE = 0.97  # of the best turn's brightness: rings of like LEDs look alike when turned by one, then the smallest turn is right
SECTOR_DEG, SECTOR_SHARE = 13.0, 0.88  # where an LED's reflection is looked for: this far from its azimuth, this far out in the disc
HEART_PX, GLINT_RISE = 6.0, 40.0  # radius of a reflection's bright heart; gray levels by which it stands out
PATCH_PX, GROUND_PERCENTILE = 11, 25  # half a side of what is compared of a reflection; of it is ground
BEHIND_MM = (0.2, 4.0)  # from the window's back to the LEDs that are mirrored in it
GLINT = {"size_mm": (0.3, 5.0), "rest": (5e-4, 1.0), "core_mm": (0.04, 2.0), "radius": (0.98, 1.02)}  # fitted as logarithms
GLINT_SIZES_MM, GLINT_RESTS, GLINT_CORES_MM = (
    (0.7, 1.0, 1.4, 2.0),
    (0.005, 0.02, 0.1, 0.4),
    (0.06, 0.2, 0.4),
)  # starts; rest: 1 - core_share
TURN_RAD = 0.06
ACROSS = 2  # places in a pixel, each way
EVERY = 6  # pixels the ring's fit looks at: one in this many, in both directions
RING = {  # least and most, fitted as logarithms; radii relative to the aperture's, red and blue to green
    "ambient": (0.01, 50.0),
    "ambient_falloff_mm": (1.0, 300.0),
    "glow": (0.01, 300.0),
    "glow_radius_mm": (0.9, 1.25),
    "glow_height_mm": (0.2, 15.0),
    "glow_exponent": (0.7, 10.0),
    "wall_fraction": (0.01, 1.0),
    "lip_width_mm": (0.05, 6.0),
    "red": (0.1, 3.0),
    "blue": (0.1, 3.0),
}
LIPS_MM, TRIES = (0.4, 1.0, 2.0, 3.5), 8  # starts of lip_width_mm, whose step makes local optima, and steps from each
STEP_GAIN = 0.05  # share of the misfit by which a step at the lip must be better than none
PIN_SHARE, ON_PIN_SHARE = 0.41, 0.28  # of the pins' spacing: nearer to a pin's middle nothing behind it is seen; only its cap is
CLEAR_FRAMES = 3  # in which a place has to be clear of pins, or before one
GROUND_PX, SPECK_RISE = 25, 8.0  # median filter that a speck has to rise above, gray levels by which it does
SPECK_PX2, SPECK_PATCH_PX = (3, 90), 6  # area of a speck; half a side of what is compared of it
SPECK_ROUND, SPECK_CLEAR = 0.45, 0.7  # area of a speck relative to that of the circle about it; share of its border that pins leave clear
SPECK_MM, SPECK_LIGHT, SPECK_MOVE_MM = (0.03, 0.6), (1e-4, 3.0), 0.15  # bounds of radius and light; of its place, about the first guess
SPECK_GAIN = 0.6  # share of the squared misfit around it that a speck has to explain
MOST_SPECKS = 60
PLAIN_OPACITY = 0.5  # where no cap passes behind any speck; else an unmeasured one hides as much as the one most like it in brightness


@dataclass(frozen=True)
class Still:
    """Median of the frames: ``image`` (H, W, 3) and ``gray`` (H, W), gray levels; ``tangents`` (H, W, 2) in air of the pixels' rays."""

    image: np.ndarray
    gray: np.ndarray
    tangents: np.ndarray


def fit_surroundings(
    spec: SensorSpec, images: np.ndarray, pins_px: np.ndarray, progress: Callable[[int, int], None] | None = None
) -> SensorSpec:
    """The specification with housing, LED places and reflections, and specks as frames of one sensor show them.

    Parameters
    ----------
    spec : SensorSpec
        Its camera, response, ``leds.power``, ``leds.balance`` and ``gel.haze`` are taken as known.
    images : (M, H, W, 3) or (M, H, W) uint8
        Raw frames with differing contacts, RGB or gray.
    pins_px : (M, N, 2) float
        Pins in raw-frame px; NaN where not found.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    FrameError
        Thresholded frames, frames of another size than the camera's, or no disc in them.
    """
    images = np.asarray(images)
    size = (spec.camera.height_px, spec.camera.width_px)
    if images.shape[1:3] != size:
        raise FrameError(f"frames are {images.shape[2]} x {images.shape[1]} px, the camera of {spec.name} has {size[1]} x {size[0]}")
    if np.mean((images == 0) | (images == 255)) > MOST_BINARY:
        raise FrameError(
            f"the frames of {spec.name} are thresholded: they hold no gray levels to find the surroundings' light in; "
            "give raw camera frames, or leave housing and leds as the specification has them"
        )
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), MOST_FRAMES)).astype(int))
    images, pins_px = images[chosen], np.asarray(pins_px)[chosen]
    images = np.repeat(images[..., None], 3, axis=3) if images.ndim == 3 else images
    image = np.median(images, axis=0).astype(np.float32)
    y, x = np.mgrid[: size[0], : size[1]]
    _, direction = pixel_rays(spec.view, np.stack([x, y], axis=-1))
    sine = spec.gel.refractive_index * direction[..., :2]  # in air: index times sine stays (Snell)
    tangents = sine / np.sqrt(np.maximum(1 - np.sum(sine**2, axis=-1, keepdims=True), 1e-12))
    still = Still(image, gray_levels(image), tangents)
    stages = (fit_aperture, turn_leds, fit_reflections, fit_ring, lambda spec, still: fit_specks(spec, still, images, pins_px))
    for done, stage in enumerate(stages):
        spec = stage(spec, still)
        if progress:
            progress(done + 1, len(stages))
    return spec


def fit_aperture(spec: SensorSpec, still: Still) -> SensorSpec:
    """Centre and radius of the disc's edge, a circle in the housing's plane.

    On each ray from the centre, the edge is the outermost crossing of the light half way between inside and ring.
    """
    found = lens_disc(spec)
    turn, each = np.linspace(0, 2 * np.pi, EDGE_RAYS, endpoint=False), np.arange(EDGE_RAYS)
    out, light = np.stack([np.cos(turn), np.sin(turn)], axis=-1), to_light(still.gray, spec.response)
    for least, most in EDGE_REACH:
        reach = found.radius_px * np.arange(least, most, EDGE_STEP_PX / found.radius_px)
        seen = _sampled(light, found.center_px + reach[:, None] * out[:, None])
        mean = np.median(seen, axis=0)
        top = int(np.argmax(mean > 0.9 * mean.max())) + round(TOP_PX / EDGE_STEP_PX)
        level = 0.5 * (np.median(seen[:, : top // 2], axis=1) + np.median(seen[:, top - 4 : top + 5], axis=1))
        last = top - 1 - np.argmax((seen[:, :top] < level[:, None])[:, ::-1], axis=1)
        below, above = seen[each, last], seen[each, np.minimum(last + 1, len(reach) - 1)]
        good = (below < level) & (above >= level)
        if good.mean() < 0.5:
            raise FrameError(
                f"{spec.name}: no bright ring around the disc; check [camera] and [housing] of the specification, or the frames"
            )
        radius = reach[last[good]] + EDGE_STEP_PX * ((level - below) / np.where(good, above - below, 1))[good]
        edge_px = found.center_px + radius[:, None] * out[good]
        x, y, r = _circle(edge_px, [*found.center_px, found.radius_px], EDGE_PX)
        found = round_disc(still.gray.shape[::-1], np.array([x, y]), r)
    edge_mm = _sampled(still.tangents, edge_px) * (spec.housing.z_mm + spec.camera.distance_mm)
    start = [*spec.housing.center_mm, spec.housing.aperture_radius_mm]
    x, y, r = _circle(edge_mm, start, EDGE_PX * spec.housing.aperture_radius_mm / found.radius_px)
    return revised(spec, housing={"center_mm": (x, y), "aperture_radius_mm": r})


def turn_leds(spec: SensorSpec, still: Still) -> SensorSpec:
    """LED azimuths from the brightness just outside the disc: the specification's turned as a whole, then each to its glow's middle."""
    lit = _lit(spec)
    out_mm = still.tangents * (spec.housing.z_mm + spec.camera.distance_mm) - spec.housing.center_mm
    beyond = np.linalg.norm(out_mm, axis=-1) - spec.housing.aperture_radius_mm
    near = (beyond > 0) & (beyond < GLOW_SHARE * spec.housing.aperture_radius_mm)
    azimuth = np.degrees(np.arctan2(out_mm[near][:, 1], out_mm[near][:, 0])) % 360
    sums = np.bincount(azimuth.astype(int), to_light(still.gray[near], spec.response), minlength=360)
    glow = sums / np.maximum(np.bincount(azimuth.astype(int), minlength=360), 1)
    glow = gaussian_filter1d(glow, GLOW_SMOOTH_DEG, mode="wrap")
    degrees, known = np.arange(360) + 0.5, np.array(spec.leds.azimuth_deg)
    turns = np.array(sorted(range(-180, 180), key=abs))
    total = np.array([np.interp(known[lit] + turn, degrees, glow, period=360).sum() for turn in turns])
    known = known + turns[np.argmax(total > ALIKE * total.max())]
    for k in lit:
        apart = (degrees - known[k] + 180) % 360 - 180
        weight = np.where(np.abs(apart) < SECTOR_DEG, glow, np.inf)
        weight = np.where(np.isfinite(weight), weight - weight.min(), 0)
        known[k] += np.average(apart, weights=weight) if weight.any() else 0.0
    return revised(spec, leds={"azimuth_deg": tuple(known % 360)})


def fit_reflections(spec: SensorSpec, still: Still) -> SensorSpec:
    """Radius, size and core of the LEDs, and their azimuths, such that their images in the window's back lie where the real ones do.

    At a tangent t the mirrored plane of the LEDs is met at ``t (2 back - z_led + distance)`` from the axis: the radius follows from
    the height, which is held (behind the window). What shows no reflection keeps the specification's values.
    """
    lens, leds = spec.lens, spec.leds
    z_mm = float(np.clip(leds.z_mm, lens.back_mm - BEHIND_MM[1], lens.back_mm - BEHIND_MM[0]))
    straight = 2 * lens.back_mm - z_mm + spec.camera.distance_mm
    hearts = {k: at for k in _lit(spec) if (at := _heart(spec, still, leds.azimuth_deg[k])) is not None}
    if not hearts:
        return spec
    lit, at_px = list(hearts), np.array(list(hearts.values()))
    at = _sampled(still.tangents, at_px)
    azimuth, radius = np.arctan2(at[:, 1], at[:, 0]), straight * np.median(np.linalg.norm(at, axis=1))
    disc, side = lens_disc(spec), np.arange(-PATCH_PX, PATCH_PX + 1)
    patches = np.rint(at_px).astype(int)[:, None, None] + np.stack(np.meshgrid(side, side), axis=-1)
    patches = np.clip(patches, 0, np.array(still.gray.shape[::-1]) - 1)  # (k, s, s, 2)
    fine = (np.arange(ACROSS) - (ACROSS - 1) / 2) / ACROSS
    rays = _sampled(still.tangents, patches[..., None, None, :] + np.stack(np.meshgrid(fine, fine), axis=-1))
    used = disc.distance_px(patches) < disc.radius_px - RIM_PX
    real = still.image[patches[..., 1], patches[..., 0]]
    ground = [to_light(np.percentile(r[u], GROUND_PERCENTILE, axis=0), spec.response) for r, u in zip(real, used, strict=True)]

    def with_values(values: np.ndarray) -> dict:
        size_mm, rest, core_mm, off = np.exp(values[:4]).tolist()
        return {"radius_mm": radius * off, "z_mm": z_mm, "size_mm": size_mm, "core_share": 1 - rest, "core_mm": core_mm}

    def residual(values: np.ndarray) -> np.ndarray:
        miss, shape = [], with_values(values) | {"off": ()}
        for n, k in enumerate(lit):
            turn = np.degrees(azimuth[n] + values[4 + n])
            one = shape | {"azimuth_deg": (turn,), "balance": (leds.balance[k],) if leds.balance else ()}
            light = reflections(spec.view, leds.model_copy(update=one), spec.housing, rays[n]).mean(axis=(2, 3))
            miss.append(_miss(blurred(light + ground[n], spec.response.blur_sigma_px), real[n], spec)[used[n]].ravel())
        return np.concatenate(miss)

    low, high = np.array([*np.log(list(GLINT.values())), *[(-TURN_RAD, TURN_RAD)] * len(lit)]).T
    starts = [np.append(np.log([*start, 1.0]), np.zeros(len(lit))) for start in product(GLINT_SIZES_MM, GLINT_RESTS, GLINT_CORES_MM)]
    first = min(starts, key=lambda values: np.abs(residual(values)).sum())
    found = _robust(residual, first, low, high)
    turned = np.array(leds.azimuth_deg)
    turned[lit] = np.degrees(azimuth + found[4:])
    return revised(spec, leds=with_values(found) | {"azimuth_deg": tuple((turned % 360).tolist())})


def fit_ring(spec: SensorSpec, still: Still) -> SensorSpec:
    """Light of the ring and wall outside the disc. The largest of ``housing.albedo`` stays: only its product with light is seen."""
    ring, few = spec.housing, (slice(None, None, EVERY),) * 2
    at_mm = still.tangents[few] * (ring.z_mm + spec.camera.distance_mm)
    margin = RIM_PX * ring.aperture_radius_mm / lens_disc(spec).radius_px
    beyond = np.linalg.norm(at_mm - ring.center_mm, axis=-1) - ring.aperture_radius_mm
    wall, compared = beyond >= 0, beyond > margin
    real, inside = still.image[few], to_light(still.image, spec.response)[few].astype(np.float32)
    loss = vignetted(np.ones((*still.gray.shape, 1), np.float32), spec.camera)[few]
    haze = spec.gel.model_copy(update={"haze_sigma_px": spec.gel.haze_sigma_px / EVERY})
    names, (low, high) = list(RING), np.log(np.array(list(RING.values())).T)
    red, green, blue = ring.albedo
    start = {n: getattr(ring, n) for n in names if hasattr(ring, n)} | {"red": red / green, "blue": blue / green}
    start["glow_radius_mm"] /= ring.aperture_radius_mm

    def with_values(values: np.ndarray) -> dict:
        found = dict(zip(names, np.exp(values).tolist(), strict=True))
        found["glow_radius_mm"] *= ring.aperture_radius_mm
        colour = np.array([found.pop("red"), 1.0, found.pop("blue")])
        found["albedo"] = tuple((colour * max(ring.albedo) / colour.max()).tolist())
        return found

    def residual(values: np.ndarray) -> np.ndarray:
        trial = spec.model_copy(update={"housing": ring.model_copy(update=with_values(values))})
        light = inside.copy()
        light[wall] = housing_light(trial.leds, trial.housing, at_mm[wall])
        return _miss(hazed(light, haze) * loss, real, spec)[compared].ravel()

    plain = low.copy()
    plain[names.index("wall_fraction")] = -1e-6  # as bright as the lip: no step
    fits = []
    for lip in (None, *LIPS_MM):
        first = np.log(np.maximum(list((start | ({"lip_width_mm": lip} if lip else {"wall_fraction": 1.0})).values()), 1e-3))
        found = _robust(residual, first, low if lip else plain, high, most=TRIES if lip else 40)
        fits.append((np.sum(np.log1p((residual(found) / LEVELS) ** 2)), found))
    smooth, stepped = fits[0], min(fits[1:], key=lambda fit: fit[0])
    if stepped[0] > (1 - STEP_GAIN) * smooth[0]:
        return revised(spec, housing=with_values(smooth[1]) | {"lip_width_mm": ring.lip_width_mm, "wall_fraction": 1.0})
    return revised(spec, housing=with_values(_robust(residual, stepped[1], low, high)))


def fit_specks(spec: SensorSpec, still: Still, images: np.ndarray, pins_px: np.ndarray) -> SensorSpec:
    """Bright spots (k) that stay put on the window while pins pass behind them; the most significant ``MOST_SPECKS``."""
    gray = np.array([gray_levels(image) for image in images])
    spacing = pin_spacing_px(pins_px[0])
    clear = np.array([clear_of_pins(gray.shape[1:], pins, PIN_SHARE * spacing) for pins in pins_px])
    size = gray.shape[:0:-1]
    y, x = np.mgrid[: size[1], : size[0]]
    disc, response, lens = lens_disc(spec), spec.response, spec.lens
    u2 = np.sum(still.tangents**2, axis=-1, keepdims=True)
    within = 1 / np.sqrt(lens.refractive_index**2 + (lens.refractive_index**2 - 1) * u2)  # tangent in the window to that in air
    place_mm = still.tangents * (lens.back_mm + spec.camera.distance_mm + lens.thickness_mm * within)
    shine = reflections(spec.view, spec.leds, spec.housing, still.tangents).max(axis=2) * response.exposure
    mirrored = cv2.dilate((shine > to_light(response.black_level + SPECK_RISE, response)).astype(np.uint8), np.ones((9, 9))) > 0
    usable = (disc.distance_px(np.stack([x, y], axis=-1)) < disc.radius_px - RIM_PX) & ~mirrored & (clear.sum(axis=0) >= CLEAR_FRAMES)
    behind = np.zeros(size[::-1], np.float32)
    levels = np.where(clear[:, usable], gray[:, usable].astype(np.float32), np.nan)
    behind[usable] = np.nanmedian(levels, axis=0)
    weight = blurred(usable.astype(np.float32), GROUND_PX / 4)
    filled = np.where(usable, behind, blurred(behind, GROUND_PX / 4) / np.maximum(weight, 1e-6))
    ground = cv2.medianBlur(np.clip(np.rint(filled), 0, 255).astype(np.uint8), GROUND_PX).astype(np.float32)
    rise = np.where(usable, behind - ground, 0)
    count, labels, stats, centers = cv2.connectedComponentsWithStats((rise > SPECK_RISE).astype(np.uint8), connectivity=8)
    found = []
    for k in range(1, count):
        area, across = stats[k, cv2.CC_STAT_AREA], max(stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT])
        if SPECK_PX2[0] <= area <= SPECK_PX2[1] and area > SPECK_ROUND * np.pi / 4 * across**2:
            spot = labels == k
            around = (cv2.dilate(spot.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (labels == 0)
            if usable[around].mean() > SPECK_CLEAR:
                found.append((float(rise[spot].sum()), centers[k]))
    found = [center for _, center in sorted(found, key=lambda each: -each[0])[:MOST_SPECKS]]
    known = [_opacity(spec, center, gray, pins_px, spacing, behind, ground) for center in found]
    light = np.array([rise[row, column] for column, row in np.rint(np.array(found).reshape(-1, 2)).astype(int)])
    measured = np.flatnonzero(np.isfinite(known))
    specks = []
    for k, center in enumerate(found):
        like = measured[np.argmin(np.abs(light[measured] - light[k]))] if len(measured) else None
        opacity = PLAIN_OPACITY if like is None else known[like]
        speck = _speck(spec, center, opacity, np.where(usable, behind, np.nan), ground, place_mm)
        if speck and not any(np.hypot(speck["x_mm"] - s["x_mm"], speck["y_mm"] - s["y_mm"]) < s["radius_mm"] for s in specks):
            specks.append(speck)
    return revised(spec, appearance={"specks": specks})


def _opacity(
    spec: SensorSpec,
    center_px: np.ndarray,
    gray: np.ndarray,
    pins_px: np.ndarray,
    spacing_px: float,
    behind: np.ndarray,
    ground: np.ndarray,
) -> float:
    """Share of a cap's light that a speck hides, from frames with a cap right behind it (by the rest it is brighter); NaN if none."""
    near = np.linalg.norm(pins_px - center_px, axis=2)
    frames, pins = np.nonzero(near < ON_PIN_SHARE * spacing_px)
    if len(frames) < CLEAR_FRAMES:
        return np.nan
    column, row = np.rint(center_px).astype(int)
    before = np.median(to_light(gray[frames, row, column], spec.response))
    around = [np.argsort(np.linalg.norm(pins_px[f] - pins_px[f, p], axis=1))[1:7] for f, p in zip(frames, pins, strict=True)]
    caps_px = np.rint(np.concatenate([pins_px[f, a] for f, a in zip(frames, around, strict=True)])).astype(int)
    cap = np.median(to_light(gray[np.repeat(frames, 6), caps_px[:, 1], caps_px[:, 0]], spec.response))
    bare, clear = (to_light(level[row, column], spec.response) for level in (ground, behind))
    return float(np.clip(1 - (before - clear) / max(cap - bare, 1e-6), 0, 1))


def _speck(
    spec: SensorSpec, center_px: np.ndarray, opacity: float, behind: np.ndarray, ground: np.ndarray, place_mm: np.ndarray
) -> dict | None:
    """Place, radius and light of a speck, fitted to the gray levels around it; None where a soft disc does not explain them."""
    column, row = np.rint(center_px).astype(int)
    top, left = max(row - SPECK_PATCH_PX, 0), max(column - SPECK_PATCH_PX, 0)
    patch = slice(top, row + SPECK_PATCH_PX + 1), slice(left, column + SPECK_PATCH_PX + 1)
    real, dark = behind[patch], to_light(ground[patch], spec.response)
    used, fine = np.isfinite(real), (np.arange(ACROSS) - (ACROSS - 1) / 2) / ACROSS
    y, x = np.mgrid[patch]
    at = _sampled(place_mm, np.stack([x, y], axis=-1)[..., None, None, :] + np.stack(np.meshgrid(fine, fine), axis=-1))
    first = _sampled(place_mm, center_px[None])[0]
    peak = max(to_light(np.nanmax(real), spec.response), 2 * SPECK_LIGHT[0])

    def residual(values: np.ndarray) -> np.ndarray:
        away = np.linalg.norm(at - first - values[:2], axis=-1) / np.exp(values[2])
        disc = np.clip(2 - 2 * away, 0, 1).mean(axis=(2, 3))
        light = blurred((1 - opacity * disc) * dark + np.exp(values[3]) * disc, spec.response.blur_sigma_px)
        return _miss(light[used][:, None], real[used][:, None], spec)[:, 0]

    low, high = np.array([(-SPECK_MOVE_MM, SPECK_MOVE_MM)] * 2 + [np.log(SPECK_MM), np.log(SPECK_LIGHT)]).T
    found = _robust(residual, np.array([0, 0, np.log(0.15), np.log(peak)]), low, high)
    without = np.append(found[:3], np.log(1e-9))
    if np.sum(residual(found) ** 2) > (1 - SPECK_GAIN) * np.sum(residual(without) ** 2):
        return None
    radius_mm, light = np.exp(found[2:]).tolist()
    x_mm, y_mm = (first + found[:2]).tolist()
    return {"x_mm": x_mm, "y_mm": y_mm, "radius_mm": radius_mm, "opacity": float(opacity), "light": light}


def _lit(spec: SensorSpec) -> list[int]:
    """Indices of the LEDs that give light."""
    balance = spec.leds.balance or (1.0,) * len(spec.leds.azimuth_deg)
    return [k for k, share in enumerate(balance) if share > 0 and k not in spec.leds.off]


def _heart(spec: SensorSpec, still: Still, azimuth_deg: float) -> np.ndarray | None:
    """Place (2,) px of the bright heart of an LED's reflection just inside the rim; None where there is none."""
    disc, smooth = lens_disc(spec), cv2.GaussianBlur(still.gray, (0, 0), 1.5)
    apart = np.degrees(np.arctan2(still.tangents[..., 1], still.tangents[..., 0])) - azimuth_deg
    y, x = np.mgrid[: still.gray.shape[0], : still.gray.shape[1]]
    out = disc.distance_px(np.stack([x, y], axis=-1))
    sector = (np.abs((apart + 180) % 360 - 180) < SECTOR_DEG) & (out > SECTOR_SHARE * disc.radius_px) & (out < disc.radius_px - RIM_PX)
    if not sector.any():
        return None
    ground, top = np.median(still.gray[sector]), np.argmax(np.where(sector, smooth, -1))
    row, column = np.unravel_index(top, smooth.shape)
    if smooth[row, column] < ground + GLINT_RISE:
        return None
    bright = sector & (np.hypot(x - column, y - row) < HEART_PX) & (still.gray > 0.5 * (ground + still.gray[row, column]))
    return np.array([x[bright].mean(), y[bright].mean()])


def _miss(light: np.ndarray, real: np.ndarray, spec: SensorSpec) -> np.ndarray:
    """Gray levels by which light (..., 3) differs from what was seen; a saturated pixel misses only light that is too little."""
    response = spec.response
    gain = response.exposure * (np.array(response.white_balance) if np.shape(light)[-1] == 3 else 1.0)
    shown = response.black_level + (255 - response.black_level) * np.maximum(gain * light, 1e-9) ** (1 / response.gamma)
    return np.where(real < SATURATED, shown - real, np.minimum(shown - SATURATED, 0))


def _robust(residual: Callable, start: np.ndarray, low: np.ndarray, high: np.ndarray, *, most: int = 40) -> np.ndarray:
    """Values within bounds of least soft-L1 misfit; slopes over a fixed share of each range, as the model has small steps in it."""
    span = high - low

    def slope(share: np.ndarray) -> np.ndarray:
        here = residual(low + share * span)
        return np.column_stack([(residual(low + (share + STEP * unit) * span) - here) / STEP for unit in np.eye(len(share))])

    first = np.clip((start - low) / span, 0.01, 0.99)
    fit = least_squares(
        lambda share: residual(low + share * span),
        first,
        slope,
        (0, 1),
        loss="soft_l1",
        f_scale=LEVELS,
        max_nfev=most,
        xtol=1e-4,
        ftol=1e-5,
    )
    return low + fit.x * span


def _circle(points: np.ndarray, start: list[float], scale: float) -> list[float]:
    """Centre and radius of the circle through most of the points (n, 2); residuals beyond ``scale`` count less."""
    fit = least_squares(lambda c: np.linalg.norm(points - c[:2], axis=1) - c[2], start, loss="cauchy", f_scale=scale)
    return fit.x.tolist()


def _sampled(field: np.ndarray, at_px: np.ndarray) -> np.ndarray:
    """Bilinear values of a field (H, W[, k]) at pixels (..., 2)."""
    x, y = (at_px[..., k].reshape(len(at_px), -1).astype(np.float32) for k in (0, 1))
    found = cv2.remap(field.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return found.reshape(at_px.shape[:-1] + field.shape[2:]).astype(float)
