"""The leak check is made or says why not; it is never left out silently."""

import re
from dataclasses import replace

import numpy as np
import pytest

from training.data.targets import Targets
from training.studies.judging import leak_check

FRAMES = 12


@pytest.fixture
def targets():
    rng = np.random.default_rng(0)
    raw, move = rng.uniform(-5, 5, (FRAMES, 2)), rng.uniform(-5, 5, (FRAMES, 2))
    executed = np.arange(FRAMES) % 2.0
    corrected = raw.copy()
    corrected[:, 1] -= (1 - executed) * move[:, 1]
    return Targets(("pose_2", "pose_6"), raw, corrected, executed, move)


def test_a_model_that_gives_the_published_label_leaks_wholly_and_one_that_gives_the_true_angle_not_at_all(targets):
    assert leak_check(targets.raw, targets).slope == pytest.approx(1.0) and leak_check(targets.raw, targets).reason == ""
    assert leak_check(targets.corrected, targets).slope == pytest.approx(0.0, abs=1e-12)


def test_frames_without_a_prediction_do_not_change_the_leak_check(targets):
    made = targets.raw.copy()
    made[0] = np.nan
    assert leak_check(made, targets).slope == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"names": ("pose_3", "pose_5")}, "needs the angle label pose_6.*pose_3, pose_5"),
        ({"executed": np.full(FRAMES, np.nan)}, "which moves were executed.*twin audit"),
        ({"executed": np.r_[0.0, 0.0, np.ones(FRAMES - 2)]}, "2 frames .*3 are needed"),
        ({"move": np.ones((FRAMES, 2))}, "move_6 is the same"),
        ({"move": np.full((FRAMES, 2), np.nan)}, "0 frames"),
    ],
)
def test_a_leak_check_that_is_impossible_states_the_reason(targets, change, why):
    found = leak_check(targets.raw, replace(targets, **change))
    assert found.slope is None
    assert re.search(why, found.reason)
