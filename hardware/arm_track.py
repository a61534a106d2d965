"""Where an arm was at a given time, from the states that it reported."""

import threading
from collections import deque
from contextlib import contextmanager, suppress

import numpy as np

from hardware.arms.arm import Arm, ArmState
from twin.errors import TwinError

KEPT_STATES = 256
WATCH_S = 0.02


class ArmTrack:
    """Keeps the newest states of an arm.

    Parameters
    ----------
    arm : Arm
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._states: deque[ArmState] = deque(maxlen=KEPT_STATES)

    def add(self, state: ArmState) -> None:
        """Remember a state."""
        self._states.append(state)

    def pose_at(self, time_s: float) -> np.ndarray:
        """Pose (6,) of the arm at a ``time.monotonic()``, interpolated between known states. Its turn about z is unwrapped."""
        states = sorted(self._states.copy(), key=lambda state: state.time_s)
        times = np.array([state.time_s for state in states])
        poses = np.array([state.pose for state in states])
        poses[:, 5] = np.unwrap(poses[:, 5], period=360.0)
        return np.array([np.interp(time_s, times, column) for column in poses.T])

    @contextmanager
    def watched(self):
        """Context in which a thread asks the arm for its state many times a step: frames are exposed while the arm moves."""
        end = threading.Event()

        def watch() -> None:
            while not end.wait(WATCH_S):
                with suppress(TwinError):  # the caller that moves the arm gets the same error
                    self.add(self._arm.state())

        thread = threading.Thread(target=watch, name="arm watch", daemon=True)
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()
