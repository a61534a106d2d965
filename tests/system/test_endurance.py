"""The streamed loop goes on through random faults: each round ends whole or with an error in words, no arm moves on, nothing grows.

``TACTIP_ENDURANCE_S`` sets how long it is tried.
"""

import os

import pytest
from endurance import LONGEST_ROUND_S, LOUD, endure

from hardware.servo.loop import Decided
from training.estimate.estimator import PoseEstimator

SECONDS = float(os.environ.get("TACTIP_ENDURANCE_S", "90"))
GROWTH = 1.15  # of the memory, from the third round to the last: allocators keep what they once had
FEW = 2  # threads or files more at the end than at the beginning


@pytest.mark.slow
def test_the_streamed_loop_goes_on_through_random_faults():
    found = endure(PoseEstimator.load("mg400-331"), SECONDS, seed=3, report=print)
    print("\n".join(found.lines()))
    assert found.whole >= 1 and found.faults
    for one in found.rounds:
        assert one.steps == one.wanted or one.told, "a round that ended early says why"
        assert one.seconds < LONGEST_ROUND_S
        assert one.decided[Decided.MOVE] == one.steps, "each move is a step, and each step a move"
        assert not one.moves_on or any(word in one.told for word in LOUD), f"the arm moves on: {one.told}"
    own = [each[0] for each in found.memory_mb]
    assert own[-1] < GROWTH * own[min(2, len(own) - 1)]
    assert found.threads[-1] <= found.threads[0] + FEW and found.files[-1] <= found.files[0] + FEW
