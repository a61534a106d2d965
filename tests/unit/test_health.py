"""A sound sensor is reported healthy; each planted fault is named."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from drawn_frames import draw_discs, drawn_frame
from plain_sensor import changed, plain

from hardware.live.examining import examine_sensor
from scenes import load_sensor
from twin.camera.projection import cap_truth
from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS
from twin.evaluation.degradation.shots import CONTACTS, ObjectContact, RenderedSource, pins_under
from twin.frames.forms import blob_spec, frame_size
from twin.frames.images import write_image
from twin.geometry.pins import rest_pins
from twin.mechanics.path import ContactPose
from twin.pins import DetectorSpec
from twin.pins.check import Grade, drift_of, examine
from twin.pins.labelling.reference import nominal_reference
from twin.types import Form, Frame


@lru_cache(maxsize=1)
def sensor():
    return changed(plain(), camera={"channels": "mono"})


def frames(name, severity):
    source = RenderedSource(sensor(), (ObjectContact("none", "plane", ContactPose(0.0)),))
    return [shot.frame for shot in source.render(DegradedCase((CONDITIONS[name],)), severity)]


def verdicts(shown):
    return {found.name: found for found in examine(shown, sensor())}


PLACE = ("shift", "turn", "scale", "stretch", "mirror")


def test_an_undamaged_sensor_has_no_bad_finding():
    found = verdicts(frames("noise", 0.0))
    assert {f.verdict for f in found.values() if f.name != "mirror"} == {Grade.HEALTHY}, found
    assert found["mirror"].verdict is Grade.UNSURE and found["mirror"].remedy, "pins at rest alone do not show a mirror"
    assert set(found) == {"brightness", "saturation", "focus", "glare", "stray light", "layout", "pins", "specks", *PLACE}


@pytest.mark.usefixtures("no_other_layout")
@pytest.mark.parametrize(
    ("name", "severity", "finding"),
    [
        pytest.param("exposure-low", 0.35, "brightness", marks=pytest.mark.slow),
        pytest.param("exposure-high", 0.4, "saturation", marks=pytest.mark.slow),
        pytest.param("defocus", 0.15, "focus", marks=pytest.mark.slow),
        ("glare", 0.4, "glare"),
        pytest.param("room-light", 0.5, "stray light", marks=pytest.mark.slow),
        ("caps-missing", 0.1, "pins"),
        pytest.param("camera-shifted", 0.1, "shift", marks=pytest.mark.slow),
        pytest.param("camera-rolled", 0.08, "turn", marks=pytest.mark.slow),
        pytest.param("camera-zoomed", 0.2, "scale", marks=pytest.mark.slow),
    ],
)
def test_a_planted_fault_is_named(name, severity, finding):
    found = verdicts(frames(name, severity))
    assert found[finding].verdict is not Grade.HEALTHY and found[finding].remedy, found


@pytest.mark.usefixtures("no_other_layout")
def test_a_white_housing_beside_a_pad_is_no_glare_and_a_white_patch_on_it_is():
    pad = load_sensor("pad-rectangular")
    rest = nominal_reference(pad, Form.RAW)
    frame, pitch = drawn_frame(pad, Form.RAW, rest.pins_px), float(rest.spacing_px.mean())
    low, high = (np.rint(end).astype(int) for end in (rest.pins_px.min(axis=0) - 1.5 * pitch, rest.pins_px.max(axis=0) + 1.5 * pitch))
    housed = np.full_like(frame.image, 255)
    housed[low[1] : high[1], low[0] : high[0]] = frame.image[low[1] : high[1], low[0] : high[0]]
    glaring = housed.copy()
    x, y = np.rint(rest.pins_px.mean(axis=0)).astype(int)
    glaring[y - 25 : y + 25, x - 25 : x + 25] = 255
    for image, verdict in ((housed, Grade.HEALTHY), (glaring, Grade.FAILED)):
        found = {each.name: each for each in examine([replace(frame, image=image)], pad)}
        assert found["glare"].verdict is verdict, found["glare"]


def test_a_black_frame_is_bad_and_nothing_crashes():
    found = verdicts([Frame(np.zeros((480, 640), np.uint8), Form.RAW)])
    assert found["pins"].verdict is Grade.FAILED and found["brightness"].verdict is Grade.FAILED and "place" in found


@pytest.mark.usefixtures("no_other_layout")
def test_frames_that_cannot_be_used_are_named():
    spec = load_sensor("mg400-127")
    rest = nominal_reference(spec, Form.PROCESSED).pins_px
    shown = [drawn_frame(spec, Form.PROCESSED, rest, name=f"frame_{k}.png") for k in range(4)]
    shown[2] = replace(shown[2], image=np.zeros_like(shown[2].image))
    found = {each.name: each for each in examine(shown, spec)}["pins"]
    assert "3 of 4 frames are valid; not frame_2.png" in found.text and "no pins" in found.remedy
    assert "frame_" not in {each.name: each for each in examine(shown[:2], spec)}["pins"].text


def test_drift_is_the_planted_similarity():
    reference = nominal_reference(sensor(), Form.RAW)
    rest, rim = reference.pins_px, reference.outmost
    center = rest[rim].mean(axis=0)
    turn = np.radians(3.0)
    turning = 1.05 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    pins = (rest - center) @ turning + center + [4.0, -2.0]
    pins[rim[:10]] = np.nan
    drift = drift_of(pins, rest, rim)
    assert drift.shift_px == pytest.approx([4.0, -2.0]) and drift.turn_deg == pytest.approx(3.0) and drift.scale == pytest.approx(1.05)
    assert drift.contact < 1e-9 and drift.scale_at_rest == pytest.approx(drift.scale)
    flat = drift_of(pins * [1.0, 1.02], rest, rim, bulge=0.0)  # as a contact moves the pins of a pad, whose rim does not grow
    assert flat.contact > 0.003 and flat.scale_at_rest == flat.scale
    pins[rim[: len(rim) // 2 + 1]] = np.nan
    assert drift_of(pins, rest, rim) is None


@pytest.mark.parametrize(
    "contact", [pytest.param(each, id=each.name, marks=[pytest.mark.slow] * (each.name in ("edge", "flat"))) for each in CONTACTS[1:]]
)
def test_a_contact_is_not_taken_for_a_nearer_camera(contact):
    """The gel bulges at the rim by 1 to 4 %; what is left of the scale is within the limit of a well sensor, a zoomed camera is not."""
    spec = load_sensor("mg400-331")
    reference = nominal_reference(spec, Form.RAW)
    seen = cap_truth(spec, rest_pins(spec.geometry), pins_under(spec, contact), Form.RAW).caps_px
    drift = drift_of(seen, reference.pins_px, reference.outmost)
    assert drift.scale > 1.008 and abs(drift.scale_at_rest - 1) < 0.015
    zoomed = drift_of(1.05 * seen, reference.pins_px, reference.outmost)
    assert zoomed.scale_at_rest == pytest.approx(1.05 * drift.scale_at_rest, rel=0.01)


@pytest.mark.usefixtures("no_other_layout")
@pytest.mark.parametrize("shift_px", [0.0, 6.0])
def test_frames_of_the_size_for_which_the_detector_was_tuned_are_checked(tmp_path, shift_px):
    """A recording of another size than the specification's: 'twin tune' takes it, so 'twin check' takes it with what that wrote.

    The pins are compared with the calibrated ones in the other size, not with those of the tuning itself."""
    spec, size_px = load_sensor("mg400-127"), (320, 320)
    scale = np.array(size_px) / frame_size(spec, Form.PROCESSED)
    rest_px = (nominal_reference(spec, Form.PROCESSED).pins_px + 0.5) * scale - 0.5 + [shift_px, 0.0]
    write_image(tmp_path / "a.png", draw_discs(size_px, rest_px, 5.0, level=(0, 255)))
    blob = blob_spec(spec.pipeline, Form.PROCESSED).model_copy(update={"mask_center_px": (159.5, 159.5), "mask_radius_px": 158.0})
    places = tuple(map(tuple, rest_px.tolist()))
    tuned = DetectorSpec(name="mine", method="twin", form=Form.PROCESSED, size_px=size_px, blob=blob, pins_px=places)
    found = {each.name: each for each in examine_sensor(str(tmp_path / "a.png"), spec, detector=tuned).findings}
    assert found["pins"].verdict is Grade.HEALTHY
    assert (found["shift"].verdict is Grade.HEALTHY) == (not shift_px), found
