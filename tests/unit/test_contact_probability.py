"""Whether anything is touched is distinguished from noise and from a camera that moved, and a frame without contact gives no pose."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from scenes import load_object, load_sensor
from training.estimate.estimator import PoseEstimator
from training.models import part
from training.models.part import Unseen
from training.models.touch.model import TOUCH
from training.touch.contact_probability import TouchAnswer
from twin.camera.projection import cap_truth
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins import nominal_reference
from twin.types import Form, Frame

NOISE_PX = 0.1
FRAMES = 500
LIGHT_MM = 0.6  # a plate this deep presses an MG400's sensor with 0.2 N
TOLD = 0.99


class Seeing:
    """A pipeline that sees the same in every frame."""

    def __init__(self, seen, **known):
        self.seen = seen
        self.__dict__.update(known)

    def __call__(self, frame):
        return self.seen


def answer_of(name):
    reference = nominal_reference(load_sensor(name), Form.PROCESSED)
    return reference, TouchAnswer(reference), np.zeros(len(reference.pins_px), bool)


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
def test_noise_and_a_moved_camera_are_no_contact(name):
    reference, answer, none = answer_of(name)
    rng = np.random.default_rng(0)
    middle = reference.pins_px.mean(axis=0)
    turn = 0.01 * np.array([[0.0, -1.0], [1.0, 0.0]]) + 1.01 * np.eye(2)
    moved = (reference.pins_px - middle) @ turn.T + middle + [3.0, -2.0]
    for places in (reference.pins_px, moved):
        said = [answer(places + NOISE_PX * rng.normal(size=places.shape), none) for _ in range(FRAMES)]
        assert np.mean(np.array(said) < 0.5) >= TOLD


@pytest.mark.parametrize("name", ["mg400-331", "mg400-127"])
@pytest.mark.parametrize("touched", ["plane", "ball-40", "edge"])
def test_a_light_touch_is_told(name, touched):
    spec = load_sensor(name)
    reference, answer, none = answer_of(name)
    solver = SkinSolver(spec, resolution=Resolution(10))
    rest, state = solver.rest(), solver.press(load_object(touched), ContactPose(LIGHT_MM))
    truth = cap_truth(spec, rest, state, Form.PROCESSED)
    assert np.linalg.norm(state.force_n) < 0.5
    rng = np.random.default_rng(1)
    places = reference.pins_px + truth.caps_px - truth.rest_px
    said = [answer(places + NOISE_PX * rng.normal(size=places.shape), none) for _ in range(FRAMES // 5)]
    assert np.mean(np.array(said) > 0.5) >= TOLD


def test_lost_pins_do_not_count():
    reference, answer, none = answer_of("mg400-127")
    lost = none.copy()
    lost[[3, 50]] = True
    wild = reference.pins_px.copy()
    wild[lost] += 30.0
    assert answer(wild, lost) < 0.5 < answer(wild, none)


def test_a_frame_without_contact_gives_no_pose_and_says_why():
    estimator = PoseEstimator.load("mg400-127")
    reference, answer, none = answer_of("mg400-127")
    frame = Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED, "f")
    seen = SimpleNamespace(
        valid=True,
        graph=SimpleNamespace(nodes_px=reference.pins_px, area_px2=reference.area_px2),
        pins_px=reference.pins_px,
        reason="",
        found=127,
        expected=127,
    )
    pipeline = SimpleNamespace(form=Form.PROCESSED, reference=reference)
    trained = replace(estimator._trained, pipeline=Seeing(seen, **vars(pipeline)), touched=answer)
    found = estimator.part.estimate_frame(trained, frame)
    assert isinstance(found, Unseen) and found.touched < 0.5
    assert "no contact" in found.reason
    unsure = estimator.part.estimate_frame(replace(trained, touched=None), frame)
    assert np.isfinite(unsure.mean).all() and np.isnan(unsure.touched)


def test_what_only_some_models_use_is_computed_for_them_alone_and_once(monkeypatch):
    estimator = PoseEstimator.load("mg400-127")
    reference, _, _ = answer_of("mg400-127")
    graph = SimpleNamespace(nodes_px=reference.pins_px, area_px2=reference.area_px2)
    seen = SimpleNamespace(valid=True, graph=graph, pins_px=reference.pins_px, reason="", found=127, expected=127)
    asked = []
    monkeypatch.setattr(part, "cap_light", lambda frame, nodes_px, reference: asked.append("light") or np.zeros(len(nodes_px)))
    trained = replace(
        estimator._trained,
        pipeline=Seeing(seen, form=Form.PROCESSED, reference=reference),
        touched=lambda nodes_px, lost: asked.append("touched") or 0.9,
    )
    frame = Frame(np.zeros((256, 256), np.uint8), Form.PROCESSED, "f")
    assert estimator.part.estimate_frame(trained, frame).touched == 0.9
    assert asked == ["touched"]
    TOUCH.pins_in(trained, frame)
    assert asked == ["touched", "touched", "light"]
