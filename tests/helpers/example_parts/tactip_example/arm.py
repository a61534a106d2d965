"""An arm that stands at once where it is sent."""

import time

import numpy as np

from twin.extend import FEEDBACK_AGE_S, ArmState, BaseArm


class ExampleArm(BaseArm):
    """A stage of six axes."""

    axes = 6

    def __init__(self, address: str) -> None:
        self.name, self._pose, self._open, self._enabled = f"example arm at {address}", np.array([300.0, 0, 0, 0, 0, 0]), False, False

    @property
    def is_connected(self) -> bool:
        return self._open

    def connect(self) -> None:
        self._require_disconnected()
        self._open = True

    def disconnect(self) -> None:
        self._open = self._enabled = False

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def clear_error(self) -> None:
        self._require_connected()

    def stop(self) -> None:
        self._require_connected()

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        self._require_connected()
        return ArmState(self._pose, self._pose, time.monotonic(), self._enabled, False)

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        self._require_connected()

    def move_linear(self, pose, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        self._pose = np.array(pose, float)
        return self._pose

    def move_joints(self, joints_deg, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        return self.move_linear(joints_deg)


def open_example(address: str) -> ExampleArm:
    """The arm of ``example:ADDRESS``."""
    return ExampleArm(address)
