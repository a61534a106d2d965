"""The model ``touch``: what it sees of pins and light, and that it learns from them what they tell."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from drawn_recording import config_of, drawn_dataset

from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models.touch.model import TOUCH, Bases
from training.runs.gaussian_process import fit_smooth_processes
from training.runs.run import train_run

PINS, MODES = 40, 6
ALMOST = 1e-9  # rounding


@pytest.fixture(scope="module")
def learnt():
    rng = np.random.default_rng(0)
    moved = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 2 * PINS))
    light = rng.normal(size=(200, 1)) * np.ones(PINS)
    lost = np.zeros((200, PINS), bool)
    lost[:, 7] = True
    return Bases.learn_bases(moved, light, lost, modes=MODES, light_modes=2), moved, light


def test_a_pin_that_is_mostly_lost_tells_nothing(learnt):
    bases, moved, light = learnt
    other = moved.copy()
    other[:, 14:16] += 5.0
    assert not bases.seen[7] and bases.seen.sum() == PINS - 1
    np.testing.assert_array_equal(bases(other, light), bases(moved, light))


def test_the_relative_modes_of_a_touch_hardly_depend_on_its_depth_and_vanish_with_it(learnt):
    bases, moved, light = learnt
    deep, deeper, none = (bases(scale * moved, light)[:, MODES : 2 * MODES] for scale in (10.0, 20.0, 0.0))
    assert np.abs(deep - deeper).max() < 0.1 * np.abs(deep).max()
    np.testing.assert_allclose(none, none[:1] * np.ones((200, 1)), atol=ALMOST)


def test_modes_that_are_not_there_are_zero(learnt):
    bases, moved, light = learnt
    found = bases(moved, light)
    assert not found[:, 3:MODES].any()  # three ways of moving
    assert found[:, 0].std() == pytest.approx(1.0, rel=1e-6)
    assert found[:, 2 * MODES].std() == pytest.approx(1.0, rel=1e-6) and not found[:, 2 * MODES + 1].any()


def test_a_reflection_in_place_of_a_pin_is_found_out_and_strange_pins_widen_the_intervals(data, tmp_path):
    train_run(config_of("touch", epochs=40, batch=32, members=1), data, tmp_path)
    estimator = PoseEstimator.load(tmp_path)
    spoilt = data.pins.nodes_px.copy()
    spoilt[:, 40] += 6.0  # half a spacing
    rows = np.arange(len(data))
    clean = estimator.predict_rows(data, rows).mean
    other = estimator.predict_rows(replace(data, pins=replace(data.pins, nodes_px=spoilt)), rows).mean
    assert np.abs(other - clean).mean() < 0.1 * np.abs(clean - clean.mean(axis=0)).mean()
    far = replace(data.pins, nodes_px=data.pins.reference.pins_px + 4 * (data.pins.nodes_px - data.pins.reference.pins_px))
    usual, wide = (estimator.predict_rows(replace(data, pins=pins), rows).half_width for pins in (data.pins, far))
    assert (np.median(wide, axis=0) > 3 * np.median(usual, axis=0)).all()  # outside of what was learnt
    error = np.abs(clean - data.targets.corrected).mean(axis=0)
    assert (error < 0.1 * np.ptp(data.targets.corrected, axis=0)).all()


def test_modes_are_no_size_that_can_be_chosen(data):
    with pytest.raises(TrainingError, match="no size modes; there are width, depth"):
        TOUCH.build(data.pins.reference, 2, {"modes": 20})


def test_light_tells_what_pins_do_not(tmp_path):
    data = drawn_dataset(tmp_path)
    told = np.random.default_rng(1).normal(size=len(data))
    targets = replace(data.targets, names=("force_z", "pose_6"), corrected=np.column_stack([told, data.targets.corrected[:, 1]]))
    lit = replace(data, targets=targets, pins=replace(data.pins, light=told[:, None] + np.zeros(data.pins.lost.shape)))
    prepared = TOUCH.prepare(lit, np.arange(len(lit)))
    modes = TOUCH.modes(None, prepared.inputs, torch.arange(len(lit))).inputs
    _, left_out = fit_smooth_processes(modes, told[:, None])
    assert np.abs(left_out[:, 0] - told).mean() < 0.1
    assert not np.array_equal(TOUCH.inputs_seen(lit)[1], TOUCH.inputs_seen(data)[1])
    with pytest.raises(TrainingError, match="which these pins do not contain; give it frames"):
        TOUCH.inputs(data.pins, prepared.learnt, data.pins.reference, together=False)
