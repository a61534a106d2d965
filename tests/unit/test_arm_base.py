"""Waiting for an arm at rest believes only feedback that came after the question."""

import time

import numpy as np
import pytest

from hardware.arms.arm import ArmState, BaseArm
from hardware.errors import DeviceError

TARGET = np.array([300.0, 0, 0, 0, 0, 179.0])
ELSEWHERE = TARGET + [1.0, 0, 0, 0, 0, 0]


class ToldArm(BaseArm):
    """Tells the given (age in s, pose, moving, error) one after another, then the last for ever."""

    name, axes, is_connected = "told arm", 4, True

    def __init__(self, *told):
        self.told = list(told)

    def connect(self): ...

    def disconnect(self): ...

    def stop(self):
        self.stopped = True

    def disable(self): ...

    def state(self, *, max_age_s=1.0):
        age_s, pose, moving, error = self.told.pop(0) if len(self.told) > 1 else self.told[0]
        return ArmState(pose, np.zeros(4), time.monotonic() - age_s, True, moving, error)


def test_old_feedback_of_rest_at_the_target_is_not_believed():
    arm = ToldArm((0.5, TARGET, False, ""), (0, ELSEWHERE, True, ""), (0, TARGET, True, ""), (0, TARGET, False, ""))
    asked = time.monotonic()
    state = arm.wait_settled(TARGET)
    assert state.time_s >= asked and not state.moving and len(arm.told) == 1


def test_turns_are_compared_around_the_circle():
    assert ToldArm((0, TARGET - [0, 0, 0, 0, 0, 360.0], False, "")).wait_settled(TARGET)
    with pytest.raises(DeviceError, match="not executed"):
        ToldArm((0, TARGET + [0, 0, 0, 0, 0, 0.2], False, "")).wait_settled(TARGET, timeout_s=1.0)


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ((0, ELSEWHERE, False, ""), "1.00 mm .* not executed"),
        ((0, ELSEWHERE, True, ""), "not there after 0.3 s"),
        ((0, TARGET, False, "alarm 17"), "alarm 17"),
        ((0.5, TARGET, False, ""), "not there after"),  # silent since before
    ],
)
def test_what_does_not_come_to_rest_there_is_an_error(told, says):
    with pytest.raises(DeviceError, match=says):
        ToldArm(told).wait_settled(TARGET, timeout_s=0.3)


def test_a_watched_move_that_fails_stops_the_arm_and_a_good_one_does_not():
    good, bad = ToldArm((0, TARGET, False, "")), ToldArm((0, TARGET, False, ""))
    with good._watch_move():
        pass
    with pytest.raises(KeyboardInterrupt), bad._watch_move():
        raise KeyboardInterrupt
    assert bad.stopped and not hasattr(good, "stopped")
