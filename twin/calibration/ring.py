"""The bright ring and wall around the disc: their light, from the still picture."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import GelSpec, HousingSpec, SensorSpec
from twin.calibration.aligned import revised, to_light
from twin.calibration.misfit import ROBUST_LEVELS, fit_bounded, level_misfit
from twin.calibration.still import Still
from twin.camera import hazed, vignetted
from twin.optics.static_layer import housing_light
from twin.realism.disc import lens_disc

# One pixel in this many, in both directions, is compared: the ring's light is smooth.
EVERY = 6
# Pixels this close to the disc's edge are left out, px: the edge itself is blurred.
RIM_PX = 3.0
# Least and largest value of what is fitted, as logarithms. ``glow_radius_mm`` is relative to the opening's radius; ``red`` and ``blue``
# are the wall's reflectance relative to green.
BOUNDS = {
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
# Starting values of the lip's width, mm. The step at the lip makes local optima: each start is tried, and the best one is refined.
START_LIPS_MM = (0.4, 1.0, 2.0, 3.5)
# Steps of the fit from each of these starts, and of the fit without a step at the lip.
TRIAL_STEPS, SMOOTH_STEPS = 8, 40
# A step at the lip must lower the misfit by this share against the fit without one: else there is none.
LEAST_STEP_GAIN = 0.05
# A starting value is at least this large, because its logarithm is taken.
LEAST_START = 1e-3


@dataclass(frozen=True)
class _Wall:
    """Pixels of the still picture that are compared, thinned out, and what lies behind their light.

    Attributes
    ----------
    at_mm : (h, w, 2) float
        Where each pixel's ray meets the housing's plane.
    wall, compared : (h, w) bool
        Pixels that show the wall; those whose misfit counts.
    levels, inside : (h, w, 3) float
        Gray levels; their light, which stays as it is inside the disc.
    loss : (h, w, 1) float
        Vignetting.
    haze : GelSpec
        Haze, its width in thinned-out pixels.
    """

    at_mm: np.ndarray
    wall: np.ndarray
    compared: np.ndarray
    levels: np.ndarray
    inside: np.ndarray
    loss: np.ndarray
    haze: GelSpec


def fit_ring(spec: SensorSpec, still: Still) -> SensorSpec:
    """The specification with the light of ring and wall outside the disc.

    Only the product of ``housing.albedo`` and light is seen, so the albedo's largest channel stays as it is.
    """
    seen, start, names = _thinned(spec, still), _start_values(spec.housing), list(BOUNDS)
    low, high = np.log(np.array(list(BOUNDS.values())).T)

    def residual(values: np.ndarray) -> np.ndarray:
        trial = spec.model_copy(update={"housing": spec.housing.model_copy(update=_housing_values(spec.housing, values))})
        light = seen.inside.copy()
        light[seen.wall] = housing_light(trial.leds, trial.housing, seen.at_mm[seen.wall])
        return level_misfit(hazed(light, seen.haze) * seen.loss, seen.levels, spec.response)[seen.compared].ravel()

    def fitted(changed: dict[str, float], least: np.ndarray, most_steps: int) -> tuple[float, np.ndarray]:
        """Misfit and values from one start."""
        first = np.log(np.maximum(list((start | changed).values()), LEAST_START))
        found = fit_bounded(residual, first, least, high, most_steps=most_steps)
        return float(np.sum(np.log1p((residual(found) / ROBUST_LEVELS) ** 2))), found

    without_step = low.copy()
    without_step[names.index("wall_fraction")] = -1e-6  # logarithm: the wall is as bright as the lip
    smooth_misfit, smooth = fitted({"wall_fraction": 1.0}, without_step, SMOOTH_STEPS)
    tried = [fitted({"lip_width_mm": width_mm}, low, TRIAL_STEPS) for width_mm in START_LIPS_MM]
    step_misfit, stepped = min(tried, key=lambda fit: fit[0])
    if step_misfit > (1 - LEAST_STEP_GAIN) * smooth_misfit:
        no_lip = {"lip_width_mm": spec.housing.lip_width_mm, "wall_fraction": 1.0}
        return revised(spec, housing=_housing_values(spec.housing, smooth) | no_lip)
    return revised(spec, housing=_housing_values(spec.housing, fit_bounded(residual, stepped, low, high)))


def _thinned(spec: SensorSpec, still: Still) -> _Wall:
    """What is compared of the still picture."""
    ring, few = spec.housing, (slice(None, None, EVERY),) * 2
    at_mm = still.tangents[few] * (ring.z_mm + spec.camera.distance_mm)
    margin_mm = RIM_PX * ring.aperture_radius_mm / lens_disc(spec).radius_px
    beyond_mm = np.linalg.norm(at_mm - ring.center_mm, axis=-1) - ring.aperture_radius_mm
    return _Wall(
        at_mm=at_mm,
        wall=beyond_mm >= 0,
        compared=beyond_mm > margin_mm,
        levels=still.image[few],
        inside=to_light(still.image, spec.response)[few].astype(np.float32),
        loss=vignetted(np.ones((*still.gray.shape, 1), np.float32), spec.camera)[few],
        haze=spec.gel.model_copy(update={"haze_sigma_px": spec.gel.haze_sigma_px / EVERY}),
    )


def _start_values(ring: HousingSpec) -> dict[str, float]:
    """The specification's values of what is fitted, in the order of ``BOUNDS``."""
    red, green, blue = ring.albedo
    start = {name: getattr(ring, name) for name in BOUNDS if hasattr(ring, name)} | {"red": red / green, "blue": blue / green}
    return start | {"glow_radius_mm": start["glow_radius_mm"] / ring.aperture_radius_mm}


def _housing_values(ring: HousingSpec, values: np.ndarray) -> dict[str, float | tuple[float, ...]]:
    """Fields of ``[housing]`` for the fit's values, which are logarithms."""
    found = dict(zip(BOUNDS, np.exp(values).tolist(), strict=True))
    colour = np.array([found.pop("red"), 1.0, found.pop("blue")])
    found["glow_radius_mm"] *= ring.aperture_radius_mm
    return {**found, "albedo": tuple((colour * max(ring.albedo) / colour.max()).tolist())}
