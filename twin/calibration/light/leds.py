"""Fit of the LEDs: azimuths to their glow on the ring, place and shape to their reflections in the window."""

from functools import partial
from itertools import product

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.stats import binned_statistic

from scenes.sensor import HousingSpec, LedRingSpec, ResponseSpec, SensorSpec
from twin.calibration.light.still import Still, fit_bounded, level_misfit, sample_field, subpixel_offsets
from twin.camera.capture import blurred
from twin.camera.projection import Disc, lens_disc
from twin.evaluation.pictures.aligned import to_light, with_changes
from twin.optics.static_layer import reflections

# Width of the part of the ring in whose brightness the LEDs' azimuths are found, as a share of the disc's radius.
GLOW_SHARE = 0.12
# Standard deviation of the Gaussian that smooths the brightness over the azimuth, deg.
GLOW_SMOOTH_DEG = 4.0
# Share of the largest brightness that a turn of the LEDs must reach. A ring of equal LEDs looks the same after a turn by one LED, so the
# smallest of these turns is used.
ALIKE = 0.97
# Largest difference from an LED's azimuth at which its glow and reflection are searched, deg.
SECTOR_DEG = 13.0
# Share of the disc's radius outside of which reflections are searched.
SECTOR_SHARE = 0.88
# Distance from the disc's edge, px, within which nothing is searched, because the edge is blurred.
RIM_PX = 3.0
# Standard deviation of the Gaussian that smooths the picture before the brightest place is searched, px.
HEART_SMOOTH_PX = 1.5
# Radius of a reflection's bright middle, px.
HEART_PX = 6.0
# Least difference between a reflection and its surroundings, gray levels.
LEAST_RISE_LEVELS = 40.0
# Half of the side of the square in which a reflection is compared, px.
PATCH_PX = 11
# Percentile of the gray levels in that square that is taken as the background.
BACKGROUND_PERCENTILE = 25
# Least and largest distance of the LEDs behind the window's back, mm.
BEHIND_MM = (0.2, 4.0)
# Bounds of the fitted quantities, whose logarithms are fitted: the LED's side in mm, the share of its light outside the core
# (1 - core_share), the core's standard deviation in mm, and the radius relative to that of the reflections' middles.
BOUNDS = {"size_mm": (0.3, 5.0), "rest": (5e-4, 1.0), "core_mm": (0.04, 2.0), "radius": (0.98, 1.02)}
# Shares of an LED's light that its reflection shows, because the housing may hide the rest. They are tried in this order. A later share is
# used only if it reduces the sum of squares to less than DIMMER_BETTER times that of the best share before it.
MIRROR_SHARES, DIMMER_BETTER = (1.0, 0.1, 0.01), 0.8
# Starting values of size, rest and core. All combinations are tried, and the best one is refined.
START_SIZES_MM = (0.7, 1.0, 1.4, 2.0)
START_RESTS = (0.005, 0.02, 0.1, 0.4)
START_CORES_MM = (0.06, 0.2, 0.4)
# Largest difference between an LED's azimuth and that of its reflection's middle, rad.
MOST_TURN_RAD = 0.06


def turn_leds(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with the LEDs' azimuths from the brightness just outside the disc.

    First all LEDs are turned together, then each is moved to the middle of its own glow.
    """
    lit = lit_leds(spec.leds)
    glow = _glow_by_degree(still, spec.housing, spec.camera.distance_mm, spec.response)
    degrees, azimuth_deg = np.arange(360) + 0.5, np.array(spec.leds.azimuth_deg)
    turns = np.array(sorted(range(-180, 180), key=abs))
    total = np.array([np.interp(azimuth_deg[lit] + turn, degrees, glow, period=360).sum() for turn in turns])
    azimuth_deg = azimuth_deg + turns[np.argmax(total > ALIKE * total.max())]
    for k in lit:
        apart = (degrees - azimuth_deg[k] + 180) % 360 - 180
        weight = np.where(np.abs(apart) < SECTOR_DEG, glow, np.inf)
        weight = np.where(np.isfinite(weight), weight - weight.min(), 0)
        azimuth_deg[k] += np.average(apart, weights=weight) if weight.any() else 0.0
    return with_changes(spec, leds={"azimuth_deg": tuple(azimuth_deg % 360)})


def lit_leds(leds: LedRingSpec) -> list[int]:
    """Indices of the LEDs that give light."""
    balance = leds.balance or (1.0,) * len(leds.azimuth_deg)
    return [k for k, share in enumerate(balance) if share > 0 and k not in leds.off]


def _glow_by_degree(still: Still, housing: HousingSpec, pupil_mm: float, response: ResponseSpec) -> np.ndarray:
    """Mean light (360,) of the ring's innermost part in each degree of azimuth, smoothed; ``pupil_mm`` behind the dome's centre."""
    out_mm = still.tangents * (housing.z_mm + pupil_mm) - housing.center_mm
    beyond_mm = np.linalg.norm(out_mm, axis=-1) - housing.aperture_radius_mm
    near = (beyond_mm > 0) & (beyond_mm < GLOW_SHARE * housing.aperture_radius_mm)
    azimuth = np.degrees(np.arctan2(out_mm[near][:, 1], out_mm[near][:, 0])) % 360
    glow = binned_statistic(azimuth, to_light(still.gray[near], response), bins=360, range=(0, 360)).statistic
    return gaussian_filter1d(np.nan_to_num(glow), GLOW_SMOOTH_DEG, mode="wrap")


def fit_reflections(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with LEDs whose modelled reflections in the window have the place and the look of the real ones.

    Radius, size, core, azimuths and the share of the light that shows are fitted. An LED without a visible reflection keeps its azimuth.
    If no reflection is visible, the specification is returned unchanged.
    """
    disc = lens_disc(spec.view, spec.housing)
    hearts = {k: at for k in lit_leds(spec.leds) if (at := _heart_px(still, disc, spec.leds.azimuth_deg[k])) is not None}
    if not hearts:
        return spec
    seen, found, least = _Reflections(spec, still, disc, hearts), spec, np.inf
    for share in MIRROR_SHARES:
        fitted, squares = seen.fit(with_changes(spec, leds={"mirror_share": share}))
        if squares < DIMMER_BETTER * least:
            found, least = fitted, squares
    return found


class _Reflections:
    """The reflections of n LEDs, whose bright middles are ``hearts``, in squares of the still picture, and the fit of the LEDs to them.

    The mirror image of an LED at the height z_led is at ``2 back - z_led``. A ray of tangent t from the pupil meets that plane at the
    distance ``t (2 back - z_led + distance)`` from the axis. Therefore only the ratio of radius to that height can be measured. The height
    is held (behind the window), and the radius follows.
    """

    def __init__(self, spec: SensorSpec, still: Still, disc: Disc, hearts: dict[int, np.ndarray]) -> None:
        self._leds, at_px, back_mm = list(hearts), np.array(list(hearts.values())), spec.lens.back_mm
        tangents = sample_field(still.tangents, at_px)
        self._azimuth_rad = np.arctan2(tangents[:, 1], tangents[:, 0])  # of a reflection's middle, which is that of its LED
        self._z_mm = float(np.clip(spec.leds.z_mm, back_mm - BEHIND_MM[1], back_mm - BEHIND_MM[0]))
        straight_mm = 2 * back_mm - self._z_mm + spec.camera.distance_mm
        self._radius_mm = float(straight_mm * np.median(np.linalg.norm(tangents, axis=1)))
        side = np.arange(-PATCH_PX, PATCH_PX + 1)
        patches = np.rint(at_px).astype(int)[:, None, None] + np.stack(np.meshgrid(side, side), axis=-1)
        patches = np.clip(patches, 0, np.array(still.gray.shape[::-1]) - 1)  # (n, s, s, 2)
        self._rays = sample_field(still.tangents, patches[..., None, None, :] + subpixel_offsets())
        self._used = disc.distance_px(patches) < disc.radius_px - RIM_PX
        self._levels = still.image[patches[..., 1], patches[..., 0]]
        around = [np.percentile(level[used], BACKGROUND_PERCENTILE, axis=0) for level, used in zip(self._levels, self._used, strict=True)]
        self._background = [to_light(level, spec.response) for level in around]

    def fit(self, spec: SensorSpec) -> tuple[SensorSpec, float]:
        """The specification with LEDs fitted to the reflections, and the sum of squared differences that is left."""
        residual, no_turn = partial(self._misfit, spec), np.zeros(len(self._leds))
        low, high = np.array([*np.log(list(BOUNDS.values())), *[(-MOST_TURN_RAD, MOST_TURN_RAD)] * len(self._leds)]).T
        starts = [np.append(np.log([*start, 1.0]), no_turn) for start in product(START_SIZES_MM, START_RESTS, START_CORES_MM)]
        first = min(starts, key=lambda values: float(np.abs(residual(values)).sum()))
        found = fit_bounded(residual, first, low, high)
        azimuth_deg = np.array(spec.leds.azimuth_deg)
        azimuth_deg[self._leds] = np.degrees(self._azimuth_rad + found[4:])
        fitted = with_changes(spec, leds=self._shape(found) | {"azimuth_deg": tuple((azimuth_deg % 360).tolist())})
        return fitted, float((residual(found) ** 2).sum())

    def _shape(self, values: np.ndarray) -> dict[str, float]:
        """Fields of ``[leds]`` for the fit's first four values."""
        size_mm, rest, core_mm, off = np.exp(values[:4]).tolist()
        return {"radius_mm": self._radius_mm * off, "z_mm": self._z_mm, "size_mm": size_mm, "core_share": 1 - rest, "core_mm": core_mm}

    def _misfit(self, spec: SensorSpec, values: np.ndarray) -> np.ndarray:
        """Differences in gray levels of modelled and real reflections in all squares. Each LED is modelled alone."""
        leds, misses, shape = spec.leds, [], self._shape(values) | {"off": ()}
        for n, k in enumerate(self._leds):
            azimuth_deg = np.degrees(self._azimuth_rad[n] + values[4 + n])
            one = shape | {"azimuth_deg": (azimuth_deg,), "balance": (leds.balance[k],) if leds.balance else ()}
            light = reflections(spec.view, leds.alter(**one), spec.housing, self._rays[n]).mean(axis=(2, 3))
            light = blurred(light + self._background[n], spec.response.blur_sigma_px)
            misses.append(level_misfit(light, self._levels[n], spec.response)[self._used[n]].ravel())
        return np.concatenate(misses)


def _heart_px(still: Still, disc: Disc, azimuth_deg: float) -> np.ndarray | None:
    """Place (2,) px of the bright middle of an LED's reflection just inside the rim; None if there is none."""
    smooth = cv2.GaussianBlur(still.gray, (0, 0), HEART_SMOOTH_PX)
    apart = np.degrees(np.arctan2(still.tangents[..., 1], still.tangents[..., 0])) - azimuth_deg
    y, x = np.mgrid[: still.gray.shape[0], : still.gray.shape[1]]
    out = disc.distance_px(np.stack([x, y], axis=-1))
    sector = (np.abs((apart + 180) % 360 - 180) < SECTOR_DEG) & (out > SECTOR_SHARE * disc.radius_px) & (out < disc.radius_px - RIM_PX)
    if not sector.any():
        return None
    around = np.median(still.gray[sector])
    row, column = np.unravel_index(np.argmax(np.where(sector, smooth, -1)), smooth.shape)
    if smooth[row, column] < around + LEAST_RISE_LEVELS:
        return None
    bright = sector & (np.hypot(x - column, y - row) < HEART_PX) & (still.gray > 0.5 * (around + still.gray[row, column]))
    return np.array([x[bright].mean(), y[bright].mean()])
