"""Directions on the whole circle: as sine and cosine, with errors the short way round."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_recording import config_of

from training.data.label_code import LabelCode, goes_round, label_error
from training.data.targets import Targets
from training.estimate.estimator import PoseEstimator
from training.models.part import Prediction
from training.runs.run import train_run
from training.studies.judging import measure_errors

UNITS = ("mm", "deg")


def labels_round_the_circle(count, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-6, 6, count), rng.uniform(-180, 180, count)])


def test_labels_come_back_from_their_numbers():
    labels, code = labels_round_the_circle(50), LabelCode((False, True))
    numbers = code.encode(labels)
    assert numbers.shape == (50, 3) and code.label_of.tolist() == [0, 1, 1]
    values, _ = code.decode(2.5 * numbers, np.ones_like(numbers))  # a direction does not depend on the length of its pair
    assert values[:, 1] == pytest.approx(labels[:, 1], abs=1e-9) and values[:, 0] == pytest.approx(2.5 * labels[:, 0])


def test_the_expected_error_of_a_direction_is_that_of_its_numbers():
    """Equal errors s of sine and cosine turn a unit pair by s rad, in every direction."""
    labels, code = labels_round_the_circle(20), LabelCode((False, True))
    _, errors = code.decode(code.encode(labels), np.full((20, 3), 0.01))
    assert errors[:, 0] == pytest.approx(0.01) and errors[:, 1] == pytest.approx(np.degrees(0.01))


def test_errors_of_angles_go_the_short_way_round():
    made, truth = np.array([[179.0, 179.0], [-359.0, -359.0]]), np.array([[-179.0, -179.0], [0.0, 0.0]])
    assert label_error(made, truth, UNITS).tolist() == [[358.0, -2.0], [-359.0, 1.0]]


def test_only_wide_angles_go_round():
    narrow, wide = np.array([[-200.0, -15.0], [200.0, 15.0]]), np.array([[-6.0, -170.0], [6.0, 170.0]])
    assert goes_round(UNITS, narrow) == (False, False) and goes_round(UNITS, wide) == (False, True)


def test_a_judge_takes_the_short_way_and_so_do_the_intervals():
    truth = np.array([[0.0, 179.5], [0.0, -179.5]])
    targets = Targets(("pose_2", "pose_6"), truth, truth, np.full(2, np.nan), np.zeros((2, 2)))
    data = type("Data", (), {"targets": targets})()
    half = np.full((2, 2), 1.5)
    found = measure_errors(Prediction(-truth, half, half, np.full(2, np.nan)), data, np.arange(2))
    assert found["corrected"]["pose_6"]["mae"] == pytest.approx(1.0) and found["raw"]["pose_6"]["coverage_90"] == 1.0


@pytest.mark.slow
def test_a_model_learns_directions_across_the_jump(data, tmp_path):
    """The frames' angle, stretched to the whole circle: a model of degrees would err by some 10 deg where the circle closes."""
    stretched = data.targets.corrected.copy()
    angle = stretched[:, 1]
    stretched[:, 1] = 358 * (angle - angle.min()) / np.ptp(angle) - 179
    round_data = replace(data, targets=replace(data.targets, raw=stretched, corrected=stretched))
    train_run(config_of("vgnn", epochs=60, batch=16, members=2), round_data, tmp_path)
    estimator = PoseEstimator.load(tmp_path)
    assert estimator.names == data.targets.names and estimator.ensemble.code.circular == (False, True)
    made = estimator.predict_rows(round_data, np.arange(len(data)))
    assert made.mean.shape == stretched.shape == made.half_width.shape
    assert np.abs(made.mean[:, 1]).max() <= 180
    error = np.abs(label_error(made.mean, stretched, data.targets.units))[:, 1]
    assert np.median(error) < 20
