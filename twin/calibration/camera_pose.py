"""Fit of camera and pin pattern to the pins of one no-contact frame, and detection of parameters that such a frame does not determine.

A camera that looks along the axis of a dome sees rings of pins, and nearly all information is in the rings' radii. A longer focal length,
a greater distance, a wider pattern and a stronger distortion change these radii in similar ways. Only parameters that the pins determine
are fitted.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from scenes.sensor import SensorSpec
from twin.camera.projection import project
from twin.errors import FrameError
from twin.evaluation.pictures.aligned import with_changes
from twin.geometry.pins import rest_pins

# Rms error, px, of any model of dome and camera for real pins at rest; all pins of a ring have a similar error. A parameter that moves
# the pins by less is not determined.
MODEL_PX = 0.4
# Ratio of a parameter's standard deviation to its plausible range above which it is not determined.
UNSURE = 1 / 3
# Absolute correlation of two parameters above which only one of them is determined.
CORRELATED = 0.99
# A parameter is not held if the rms distance without it is this many times as large, or this many times MODEL_PX.
WORSE = 2.0
# Residual, px, beyond which a pin counts less (soft L1).
ROBUST_PX = 1.0
# Step of the numerical derivatives, as a share of the plausible range.
STEP = 1e-4
# Most steps of a fit.
MOST_STEPS = 20
# Fewest pins that a camera is fitted to.
LEAST_PINS = 20
# Least distance of the pupil behind the window's back, mm.
BEHIND_WINDOW_MM = 0.5


@dataclass(frozen=True)
class CameraParameter:
    """A parameter that pins at rest may determine.

    Attributes
    ----------
    section : str
        Section of the specification that holds it.
    plausible : float
        Standard deviation of its plausible values, in the parameter's unit; relative to its value if ``relative``.
    relative : bool
        Whether ``plausible`` is a share of the parameter's value.
    bounds : (float, float)
        Smallest and largest value of a fit.
    instead : str
        Data that determine the parameter if the pins do not.
    """

    section: str
    plausible: float
    relative: bool
    bounds: tuple[float, float]
    instead: str


CONTACT = "contact frames, or a fixed value"
BOARD = "frames of a chequerboard without the tip, or a fixed value"
# If the pins can't determine several of them separately, parameters are held in this order.
PARAMETERS = {
    "max_polar_deg": CameraParameter("pins", 5.0, False, (10.0, 88.0), f"{CONTACT} from the tip's drawing"),
    "distance_mm": CameraParameter("camera", 0.1, True, (1.0, 1000.0), f"{CONTACT} measured with a ruler"),
    "k2": CameraParameter("camera", 0.1, False, (-2.0, 2.0), BOARD),
    "tilt_x_deg": CameraParameter("camera", 3.0, False, (-30.0, 30.0), BOARD),
    "tilt_y_deg": CameraParameter("camera", 3.0, False, (-30.0, 30.0), BOARD),
    "k1": CameraParameter("camera", 0.2, False, (-2.0, 2.0), BOARD),
    "fx_px": CameraParameter("camera", 0.1, True, (5.0, 20000.0), BOARD),
    "cx_px": CameraParameter("camera", 10.0, False, (-1e4, 1e4), BOARD),
    "cy_px": CameraParameter("camera", 10.0, False, (-1e4, 1e4), BOARD),
    "phase_deg": CameraParameter("pins", 2.0, False, (-360.0, 360.0), "a frame with more pins found"),
}
FREE = ("fx_px", "cx_px", "cy_px", "k1", "tilt_x_deg", "tilt_y_deg", "phase_deg")


@dataclass(frozen=True)
class CameraReport:
    """Result of a camera fit: its error, and which parameters were determined.

    Attributes
    ----------
    rms_px : float
        Rms distance between pins and projected caps, raw-frame px.
    pins : int
        Number of pins that were used.
    sd : dict of str to float
        Standard deviation of each fitted parameter, in its own unit, from the Jacobian and the residuals.
    held : dict of str to str
        Requested parameters that are not determined: the reason, and what data are needed. They keep the specification's value.
    """

    rms_px: float
    pins: int
    sd: dict[str, float]
    held: dict[str, str]


def fit_camera(spec: SensorSpec, pins_px: np.ndarray, *, free: tuple[str, ...] = FREE) -> tuple[SensorSpec, CameraReport]:
    """Least squares of camera and pin pattern on the caps' projections through the window.

    Parameters
    ----------
    spec : SensorSpec
        The start of the fit, and the values of all parameters that are not free. The ratio of ``fy_px`` to ``fx_px`` is kept.
    pins_px : (N, 2) float
        Raw-frame px of a no-contact frame, in the specification's order; NaN where not found.
    free : tuple of str
        Of ``PARAMETERS``.

    Returns
    -------
    spec : SensorSpec
    report : CameraReport

    Raises
    ------
    FrameError
        There are too few pins.
    """
    count = int(np.isfinite(pins_px).all(axis=1).sum())
    if count < LEAST_PINS:
        raise FrameError(f"{count} of {spec.pins.count} pins found; {LEAST_PINS} or more are needed: give another no-contact frame")
    names, held = [name for name in PARAMETERS if name in free], {}
    found, residual, slopes = _fit_camera(spec, pins_px, names)
    needed: set[str] = set()
    while True:
        sd, correlation = _certainty(residual, slopes)
        rings = len(spec.pins.shape.ring_ends()) - 1
        rings = rings if rings > 1 else np.sqrt(count / 3)  # as many as rings of so many pins
        alike = np.sqrt(count / rings)  # the pins of a ring share one error
        doubtful = _list_undetermined(_values(spec, names), sd * alike * max(MODEL_PX / max(_rms(residual), 1e-9), 1), correlation)
        name = next((name for name in names if name in doubtful and name not in needed), None)
        if name is None:
            break
        others = [other for other in names if other != name]
        without = _fit_camera(spec, pins_px, others) if others else None
        if without is None or _rms(without[1]) > WORSE * max(_rms(residual), MODEL_PX):
            needed.add(name)  # its value is uncertain, but the specification's is far off
            continue
        held[name] = doubtful[name]
        names, (found, residual, slopes) = others, without
    fitted = _with(spec, dict(zip(names, found.tolist(), strict=True)))
    spec = with_changes(spec, camera=fitted.camera.model_dump(), pins=fitted.pins.model_dump())
    return spec, CameraReport(_rms(residual), count, dict(zip(names, sd.tolist(), strict=True)), held)


def _with(spec: SensorSpec, values: dict[str, float]) -> SensorSpec:
    """A copy with other values of ``PARAMETERS``. It is not validated."""
    sections: dict[str, dict[str, Any]] = {"camera": {}, "pins": {}}
    for name, value in values.items():
        sections[PARAMETERS[name].section][name] = value
    if "fx_px" in values:
        sections["camera"]["fy_px"] = spec.camera.fy_px * values["fx_px"] / spec.camera.fx_px
    return spec.alter(**sections)


def _values(spec: SensorSpec, names: list[str]) -> dict[str, float]:
    """The specification's values of ``PARAMETERS``."""
    return {name: getattr(getattr(spec, PARAMETERS[name].section), name) for name in names}


def _range(name: str, value: float) -> float:
    """Plausible range of a parameter, in its unit, about the specification's value."""
    parameter = PARAMETERS[name]
    return parameter.plausible * (value if parameter.relative else 1.0)


def _fit_camera(spec: SensorSpec, pins_px: np.ndarray, names: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values (p,) fitted to the pins (N, 2), residual (2 n,) px of the n found ones, and its derivatives (2 n, p) by the values."""
    known = _values(spec, names)
    ranges = np.array([_range(name, value) for name, value in known.items()])
    low, high = np.array([PARAMETERS[name].bounds for name in names]).T.copy()
    if "distance_mm" in names:
        low[names.index("distance_mm")] = -spec.lens.back_mm + BEHIND_WINDOW_MM
    seen = np.isfinite(pins_px).all(axis=1)

    def residual(values: np.ndarray) -> np.ndarray:
        trial = _with(spec, dict(zip(names, values.tolist(), strict=True)))
        return (project(trial.view, rest_pins(trial.geometry).caps_mm) - pins_px)[seen].ravel()

    def slopes(values: np.ndarray) -> np.ndarray:
        steps = STEP * ranges * np.eye(len(ranges))
        return np.column_stack([(residual(values + d) - residual(values - d)) / (2 * np.abs(d).max()) for d in steps])

    start = np.clip(list(known.values()), low, high)
    values = least_squares(residual, start, slopes, (low, high), x_scale=ranges, loss="soft_l1", f_scale=ROBUST_PX, max_nfev=MOST_STEPS).x
    return values, residual(values), slopes(values)


def _rms(residual: np.ndarray) -> float:
    """Rms of the distances (n,) whose components (2 n,) are given."""
    return float(np.sqrt(2 * np.mean(residual**2)))


def _certainty(residual: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (p,) and correlations (p, p) of the values, from ``s^2 (J^T J)^-1``. Without any effect they are inf and 1."""
    scale = np.linalg.norm(slopes, axis=0)
    _, size, axes = np.linalg.svd(slopes / np.maximum(scale, 1e-300), full_matrices=False)
    covariance = (axes.T / np.maximum(size, 1e-9) ** 2) @ axes
    unit = np.sqrt(np.diag(covariance))
    freedom = max(len(residual) - slopes.shape[1], 1)
    return unit / np.maximum(scale, 1e-300) * np.sqrt(np.sum(residual**2) / freedom), covariance / np.outer(unit, unit)


def _list_undetermined(known: dict[str, float], sd: np.ndarray, correlation: np.ndarray) -> dict[str, str]:
    """Parameters that the pins do not determine, with the reasons in words; ``known`` holds the specification's values."""
    doubtful: dict[str, str] = {}
    names = list(known)
    for k, (name, value) in enumerate(known.items()):
        plausible = _range(name, value)
        twins = [f"{names[j]} ({correlation[k, j]:+.3f})" for j in range(len(names)) if j != k and abs(correlation[k, j]) > CORRELATED]
        why = [f"its effect is that of {', '.join(twins)} (correlation)"] if twins else []
        if sd[k] > UNSURE * plausible:
            why.append(f"its standard deviation would be {sd[k]:.2g}, of a plausible range of {plausible:.2g}")
        if why:
            doubtful[name] = (
                f"{name} is not determined by this no-contact frame: {'; '.join(why)}. "
                f"It keeps the specification's {value:g}; to determine it, also give {PARAMETERS[name].instead}"
            )
    return doubtful
