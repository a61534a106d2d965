"""Which caps the camera can see."""

import numpy as np

from scenes import load_sensor
from twin.camera.projection import cap_truth, find_occluded, segment_distance
from twin.geometry.pins import rest_pins
from twin.types import ContactState, Form


def state_at(base, axis, caps):
    return ContactState.undeformed(np.zeros((0, 3)), base, axis, caps)


def rest_state(spec):
    pins = rest_pins(spec.geometry)
    return state_at(pins.base_mm, pins.axis, pins.caps_mm)


def test_segment_distance_matches_a_fine_sampling():
    rng = np.random.default_rng(0)
    share = np.linspace(0, 1, 201)
    for _ in range(20):
        p0, p1, q0, q1 = rng.normal(size=(4, 3))
        first = p0 + share[:, None] * (p1 - p0)
        second = q0 + share[:, None] * (q1 - q0)
        sampled = np.linalg.norm(first[:, None] - second[None], axis=2).min()
        assert abs(segment_distance(p0, p1, q0, q1) - sampled) < 2e-2


def test_every_cap_is_in_sight_at_rest(sensor):
    assert not find_occluded(sensor.view, 0.5 * sensor.pins.cap_diameter_mm, rest_state(sensor)).any()


def test_a_pin_between_camera_and_cap_hides_it():
    spec = load_sensor("mg400-127")
    pins = rest_pins(spec.geometry)
    eye = np.array([0.0, 0.0, -spec.camera.distance_mm])
    base, caps = pins.base_mm.copy(), pins.caps_mm.copy()
    toward = (eye - caps[0]) / np.linalg.norm(eye - caps[0])
    caps[1] = caps[0] + 3 * toward
    base[1] = caps[1] + [0.5, 0, 0]
    hidden = find_occluded(spec.view, 0.5 * spec.pins.cap_diameter_mm, state_at(base, pins.axis, caps))
    assert hidden[0] and hidden.sum() == 1


def test_caps_outside_the_frame_are_not_visible():
    spec = load_sensor("mg400-331")
    rest = rest_state(spec)
    narrow = spec.model_copy(update={"camera": spec.camera.model_copy(update={"width_px": 330})})
    truth = cap_truth(narrow, rest, rest, Form.RAW)
    assert np.array_equal(truth.visible, (truth.caps_px[:, 0] >= -0.5) & (truth.caps_px[:, 0] <= 329.5))
    assert 0 < truth.visible.sum() < len(truth.visible)
