"""The camera's fit to pins at rest: known cameras are found again, and what the pins cannot determine is held and named."""

import numpy as np
import pytest

from twin.calibration.camera_pose import PARAMETERS, fit_camera
from twin.camera.projection import project
from twin.errors import FrameError
from twin.geometry.pins import rest_pins

NOISE_PX = 0.05
MOST_SD = 3.5  # some twenty parameters are looked at: one beyond 3 sd is not rare
SAME_PX = 1e-8  # rms after a fit to exact pins; measured: 5e-9
DEGENERATE_PX = 0.51  # rms with a wrong polar angle, if the other parameters are fitted; measured: 0.46


def changed(spec, *, camera=None, pins=None):
    return spec.model_copy(update={"camera": spec.camera.model_copy(update=camera or {}), "pins": spec.pins.model_copy(update=pins or {})})


def seen(spec, rng, noise_px=NOISE_PX):
    """Pins of a frame at rest."""
    caps = project(spec.view, rest_pins(spec.geometry).caps_mm)
    return caps + rng.normal(0, noise_px, caps.shape)


def perturbed(spec):
    c = spec.camera
    focal = {"fx_px": 1.03 * c.fx_px, "fy_px": 1.03 * c.fy_px}
    return changed(
        spec, camera=focal | {"cx_px": c.cx_px + 6, "cy_px": c.cy_px - 4, "k1": c.k1 + 0.02}, pins={"phase_deg": spec.pins.phase_deg + 2}
    )


def test_a_known_camera_is_found_again_within_its_standard_deviations(sensor):
    pins_px = seen(sensor, np.random.default_rng(1))
    found, report = fit_camera(perturbed(sensor), pins_px)
    assert report.pins == sensor.pins.count
    assert report.rms_px == pytest.approx(np.sqrt(2) * NOISE_PX, rel=0.107)  # two components
    assert {"fx_px", "cx_px", "cy_px", "k1", "phase_deg"} <= set(report.sd)
    for name, sd in report.sd.items():
        section = PARAMETERS[name].section
        miss = getattr(getattr(found, section), name) - getattr(getattr(sensor, section), name)
        assert abs(miss) < MOST_SD * sd, f"{name} misses by {miss:.3g}, sd {sd:.3g}"
    assert found.camera.fy_px / found.camera.fx_px == pytest.approx(sensor.camera.fy_px / sensor.camera.fx_px)


def test_pins_at_rest_determine_neither_distance_nor_polar_angle(sensor):
    """They are held at the specification's values, and the report names data that determine them."""
    pins_px = seen(sensor, np.random.default_rng(2))
    found, report = fit_camera(sensor, pins_px, free=tuple(PARAMETERS))
    for name in ("distance_mm", "max_polar_deg"):
        assert name not in report.sd
        assert name in report.held[name] and "contact frames" in report.held[name]
    assert found.camera.distance_mm == sensor.camera.distance_mm
    assert found.pins.max_polar_deg == sensor.pins.max_polar_deg


def test_a_wrong_value_of_a_held_parameter_is_compensated_by_the_others(sensor):
    """With a wrong polar angle the other parameters still fit the pins at rest, nearly as well as any model fits real pins."""
    pins_px = seen(sensor, np.random.default_rng(3))
    wrong = changed(sensor, pins={"max_polar_deg": sensor.pins.max_polar_deg + 4})
    _, report = fit_camera(wrong, pins_px)
    assert report.rms_px < DEGENERATE_PX


def test_an_exact_frame_is_met_exactly_and_some_pins_may_be_missing(sensor):
    pins_px = project(sensor.view, rest_pins(sensor.geometry).caps_mm)
    pins_px[3::17] = np.nan
    _, report = fit_camera(perturbed(sensor), pins_px, free=("fx_px", "cx_px", "cy_px", "k1", "phase_deg"))
    assert report.rms_px < SAME_PX and report.pins == np.isfinite(pins_px).all(axis=1).sum()


def test_too_few_pins_are_refused(sensor):
    pins_px = project(sensor.view, rest_pins(sensor.geometry).caps_mm)
    with pytest.raises(FrameError, match="5 of"):
        fit_camera(sensor, np.where(np.arange(len(pins_px))[:, None] < 5, pins_px, np.nan))
