"""Every condition: severity 0 changes nothing, bit for bit, and more of it changes more of what it acts on."""

from functools import lru_cache

import numpy as np
import pytest
from plain_sensor import changed, plain

from scenes import load_sensor
from twin.camera.capture import expose
from twin.camera.projection import project
from twin.errors import TwinError
from twin.evaluation.degradation.condition import DegradedCase, PictureView
from twin.evaluation.degradation.conditions import CONDITIONS, condition
from twin.evaluation.degradation.shots import CONTACTS, RenderedSource, degraded_state, pins_under
from twin.geometry.pins import rest_pins
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Preview
from twin.pins import shipped_detector
from twin.pins.labelling.reference import nominal_reference
from twin.types import Form

LADDER = (0.0, 0.1, 0.3, 0.6, 1.0)
SLACK = 1e-3  # relative: change that rounding to gray levels may take back
# what each condition that changes the specification acts on: a figure that must fall or rise as it grows
ACTS_ON = {
    "leds-dim": lambda s: -s.leds.power,
    "leds-dead": lambda s: -sum(s.leds.balance or (1.0,) * len(s.leds.azimuth_deg)),
    "leds-red": lambda s: -s.leds.color[2],
    "gel-bubbles": lambda s: sum(p.opacity for p in s.appearance.specks),
    "gel-haze": lambda s: s.gel.haze,
    "gel-yellow": lambda s: s.gel.absorption_per_mm[2],
    "gel-soft": lambda s: -s.gel.young_modulus_mpa,
    "caps-missing": lambda s: sum(level < 1e-3 for level in s.appearance.cap_levels),
    "caps-broken": lambda s: sum(shape[0] < -0.4 for shape in s.appearance.cap_shapes),
    "caps-faded": lambda s: -s.appearance.cap_albedo[2],
    "caps-uneven": lambda s: float(np.std(np.log(s.appearance.cap_levels or (1.0,)))),
    "skin-pale": lambda s: s.appearance.skin_albedo[2],
    "skin-swollen": lambda s: s.skin.outer_radius_mm,
    "camera-shifted": lambda s: float(np.linalg.norm(project(s.view, np.array([0.0, 0.0, 10.0])))),
    "camera-tilted": lambda s: s.camera.tilt_x_deg,
    "camera-zoomed": lambda s: spread(s),
    "camera-distorted": lambda s: -spread(s),
    "vignetting": lambda s: s.camera.vignetting,
    "exposure-low": lambda s: -s.response.exposure,
    "exposure-high": lambda s: s.response.exposure,
    "noise": lambda s: s.response.read_noise,
}  # fmt: skip


def spread(spec):
    """Distance of the outermost pins on the film."""
    px = project(spec.view, rest_pins(spec.geometry).caps_mm)
    return float(np.linalg.norm(px[-60:] - px[0], axis=1).mean())


@lru_cache(maxsize=1)
def sensor():
    """A small one-channel view of the laboratory's sensor: fast to draw."""
    spec = plain()
    camera = {"width_px": 240, "height_px": 180, "channels": "mono"}
    camera |= {name: getattr(spec.camera, name) * 0.375 for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return changed(spec, camera=camera)


@lru_cache(maxsize=1)
def view():
    return PictureView.of(sensor(), project(sensor().view, rest_pins(sensor().geometry).caps_mm))


@lru_cache(maxsize=1)
def light():
    return Preview(sensor()).render()


@lru_cache(maxsize=1)
def image():
    return expose(light(), sensor().capture)


def hooks(name):
    return {hook for hook in ("spec", "light", "frame", "moves", "hides", "setting") if getattr(CONDITIONS[name], hook) is not None}


def those_with(hook):
    return [name for name in CONDITIONS if hook in hooks(name)]


def test_there_are_many_conditions_and_each_acts_somewhere():
    assert len(CONDITIONS) >= 25
    assert all(hooks(name) for name in CONDITIONS)
    assert set(those_with("spec")) == set(ACTS_ON)


@pytest.mark.parametrize("name", CONDITIONS)
def test_severity_zero_changes_nothing(name):
    case = DegradedCase((CONDITIONS[name],))
    assert case.on_spec(sensor(), 0.0) == sensor()
    assert np.array_equal(case.on_light(light(), 0.0, view(), 0), light())
    assert np.array_equal(case.on_frame(image(), 0.0, view(), 0), image())
    assert np.array_equal(case.on_points(view().caps_px, 0.0, view()), view().caps_px)
    assert not case.missing_caps(0.0, view()).any()
    assert case.on_setting(detector(), 0.0) == detector()


@pytest.mark.parametrize("name", ACTS_ON)
def test_a_degraded_specification_is_valid_and_grows(name):
    case = DegradedCase((CONDITIONS[name],))
    specs = [case.on_spec(sensor(), severity) for severity in LADDER]
    for spec in specs:
        type(spec).model_validate(spec.model_dump())
    figures = [ACTS_ON[name](spec) for spec in specs]
    assert all(later > earlier for earlier, later in zip(figures, figures[1:], strict=False)), figures


@pytest.mark.parametrize("name", those_with("light"))
def test_degraded_light_departs_further_and_stays_light(name):
    case = DegradedCase((CONDITIONS[name],))
    away = []
    for severity in LADDER:
        degraded = case.on_light(light(), severity, view(), 0)
        assert degraded.shape == light().shape and degraded.dtype == np.float32 and np.isfinite(degraded).all()
        away.append(float(np.abs(np.minimum(degraded, 1) - light()).mean()))
    if name == "camera-rolled":  # a turn by 60 deg brings a layout of 6-fold symmetry back onto itself
        away = away[:3]
    assert all(later > earlier for earlier, later in zip(away, away[1:], strict=False)), away


@pytest.mark.parametrize("name", those_with("frame"))
def test_degraded_frames_depart_further_and_stay_frames(name):
    case = DegradedCase((CONDITIONS[name],))
    away = []
    for severity in LADDER:
        degraded = case.on_frame(image(), severity, view(), 0)
        assert degraded.shape == image().shape and degraded.dtype == np.uint8
        moved = np.abs(case.on_points(view().caps_px, severity, view()) - view().caps_px)
        away.append(float(moved.mean() if "moves" in hooks(name) else np.abs(degraded.astype(float) - image()).mean()))
    assert all(later >= earlier * (1 - SLACK) for earlier, later in zip(away, away[1:], strict=False)) and away[1] > 0, away


@pytest.mark.parametrize("name", those_with("moves"))
def test_points_go_where_the_picture_goes(name):
    """A single bright spot's centroid is where the truth says."""
    case, at = DegradedCase((CONDITIONS[name],)), view().center_px + [10.0, 25.0]
    y, x = np.mgrid[: light().shape[0], : light().shape[1]]
    spot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 8).astype(np.float32)
    for severity in (0.05, 0.2):
        moved = case.on_frame((255 * case.on_light(spot, severity, view(), 0)).clip(0, 255).astype(np.uint8), severity, view(), 0)
        weight = moved.astype(float)
        centroid = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        assert np.linalg.norm(centroid - case.on_points(at[None], severity, view())[0]) < 0.1


@pytest.mark.parametrize("name", those_with("hides"))
def test_more_caps_are_gone_and_none_comes_back(name):
    gone = [DegradedCase((CONDITIONS[name],)).missing_caps(severity, view()) for severity in LADDER]
    assert all((later >= earlier).all() and later.sum() > earlier.sum() for earlier, later in zip(gone, gone[1:], strict=False))


def test_caps_that_have_come_off_are_dark():
    case = DegradedCase((CONDITIONS["caps-missing"],))
    spec = case.on_spec(sensor(), 0.5)
    levels, gone = np.array(spec.appearance.cap_levels), case.missing_caps(0.5, view())
    assert (levels[gone] < 1e-3).all() and (levels[~gone] > 0.1).all()


@pytest.mark.parametrize("name", those_with("setting"))
def test_a_wrong_setting_becomes_worse_with_severity(name):
    thresholds = [DegradedCase((CONDITIONS[name],)).on_setting(detector(), severity).blob.threshold for severity in LADDER]
    steps = np.diff(thresholds)
    assert (steps > 0).all() or (steps < 0).all()


def test_mechanics_conditions_move_the_pins():
    rest = SkinSolver(sensor()).rest()
    for name in ("gel-soft", "skin-swollen"):
        assert CONDITIONS[name].solves
    swollen = SkinSolver(DegradedCase((CONDITIONS["skin-swollen"],)).on_spec(sensor(), 0.5)).rest()
    assert np.linalg.norm(swollen.caps_mm, axis=1).mean() > np.linalg.norm(rest.caps_mm, axis=1).mean() + 0.5


def test_a_pair_acts_as_one_after_the_other():
    a, b = CONDITIONS["room-light"], CONDITIONS["noise"]
    pair = DegradedCase((a, b))
    assert pair.name == "room-light+noise"
    assert pair.on_spec(sensor(), 0.4) == DegradedCase((b,)).on_spec(sensor(), 0.4)
    assert np.array_equal(pair.on_light(light(), 0.4, view(), 1), DegradedCase((a,)).on_light(light(), 0.4, view(), 1))


def test_an_unknown_condition_names_the_nearest():
    with pytest.raises(TwinError, match="did you mean 'defocus'"):
        condition("defocuss")


def detector():
    return shipped_detector(sensor(), Form.RAW)


def test_px_per_mm_is_the_projection_s_scale():
    reference = nominal_reference(sensor(), Form.RAW)
    caps = rest_pins(sensor().geometry).caps_mm
    apart_mm = np.linalg.norm(caps - caps[0], axis=1)[1:7]
    apart_px = np.linalg.norm(reference.pins_px - reference.pins_px[0], axis=1)[1:7]
    assert view().px_per_mm == pytest.approx((apart_px / apart_mm).mean(), rel=0.1)


@pytest.mark.parametrize("name", ["defocus", "caps-missing", "camera-rolled", "noise"])
def test_a_state_is_degraded_as_a_contact_of_a_sweep(name):
    spec, contact, case = load_sensor("mg400-127"), CONTACTS[0], DegradedCase((condition(name),))
    swept = RenderedSource(spec, (contact,)).render(case, 0.5)[0]
    alone = degraded_state(spec, pins_under(spec, contact), [(case, 0.5)], touched=False)
    assert np.array_equal(alone.frame.image, swept.frame.image) and np.array_equal(alone.visible, swept.visible)
    np.testing.assert_array_equal(alone.caps_px, swept.caps_px)


def test_two_cases_act_each_at_its_own_severity():
    spec, contact = load_sensor("mg400-127"), CONTACTS[0]
    one, other = (DegradedCase((condition(name),)) for name in ("defocus", "noise"))
    state = pins_under(spec, contact)
    both = degraded_state(spec, state, [(one, 0.3), (other, 0.0)])
    assert np.array_equal(both.frame.image, degraded_state(spec, state, [(one, 0.3)]).frame.image)
    with pytest.raises(TwinError, match="changes the mechanics.*use 'twin robustness'"):
        degraded_state(spec, state, [(DegradedCase((next(c for c in CONDITIONS.values() if c.solves),)), 0.1)])
