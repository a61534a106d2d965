"""Moves an arm towards the newest target of a stream.

The Dobots queue all moves and execute every one of them. If targets came faster than the arm moves, the arm would still execute old ones
long after the stream has ended. So the path to a target is divided into short moves (pieces), and the arm gets the next piece only when it
has nearly reached the end of the present one.
"""

import threading
import time

import numpy as np

from hardware.arms.arm import Arm
from hardware.arms.kinematics import Kinematics, StageKinematics
from hardware.arms.motion import between, way_between
from hardware.errors import DeviceError

# Longest duration of a piece, in s. It is also the longest delay until the arm turns to a newer target.
PIECE_S = 0.2
# The next piece is sent when the arm needs at most this time (s) to reach the end of the present one. So the arm does not stop in between.
AHEAD_S = 0.06
# Interval in s at which the thread reads the arm's state.
LOOK_S = 0.01
# Largest delay in s of an arm that should have reached the end of its piece. A later arm gets a new piece that starts where the arm is.
LATE_S = 0.5
# Distance from a target, in mm and in deg, below which it counts as reached.
REACHED = 0.02


class NewestTarget:
    """Moves an arm towards the newest of many targets. A thread does this between ``start`` and ``end``.

    Parameters
    ----------
    arm : Arm
        Connected and enabled while the thread runs.
    linear_mm_s, angular_deg_s : float
        Speed of the arm.
    """

    def __init__(self, arm: Arm, linear_mm_s: float, angular_deg_s: float) -> None:
        self._arm, self._speed = arm, (linear_mm_s, angular_deg_s)
        self._kinematics: Kinematics = getattr(arm, "kinematics", None) or StageKinematics()
        self._lock, self._wake, self._ended = threading.RLock(), threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._target: np.ndarray | None = None
        self._sent: np.ndarray | None = None  # end of the newest piece
        self._due_s = 0.0  # when the arm should reach the end of the newest piece
        self._error: Exception | None = None

    def start(self) -> None:
        """Start the thread. There is no target yet."""
        self._ended.clear()
        self._target = self._sent = self._error = None
        self._thread = threading.Thread(target=self._run, name="newest target", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Send no further piece. The arm completes a piece that was sent already."""
        self._ended.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None

    def go(self, target: np.ndarray) -> np.ndarray:
        """Take a new target (6,), clipped to the limits of a ``SafeArm``.

        Returns the end (6,) of the newest piece that was sent to the arm: the target, or a pose on the path to it.

        Raises
        ------
        DeviceError
            The arm failed, either now or since the last call. It was stopped.
        """
        with self._lock:
            if self._error is not None:
                error, self._error, self._sent = self._error, None, None
                raise error
            target = self._kinematics.nearest_pose(target)
            clip = getattr(self._arm, "clip_pose", None)  # of a ``SafeArm``
            self._target = target if clip is None else clip(target)
            try:
                self._step()
            except BaseException:
                self._target = None  # so that the thread sends nothing more, also after Ctrl-C
                raise
            self._wake.set()
            return self._arm.state().pose if self._sent is None else self._sent

    def _run(self) -> None:
        while not self._ended.is_set():
            self._wake.wait()
            with self._lock:
                try:
                    self._step()
                except Exception as error:  # also one of an arm of another package
                    self._error, self._target = error, None
                if self._target is None and not self._ended.is_set():
                    self._wake.clear()
            self._ended.wait(LOOK_S)

    def _step(self) -> None:
        """Send the next piece if the arm has nearly reached the end of the present one."""
        if self._target is None:
            return
        state = self._arm.state()
        if state.error:
            raise DeviceError(f"{self._arm.name}: {state.error}")
        here = state.pose
        start = here if self._sent is None else self._sent
        if self._takes_s(here, start) > AHEAD_S:
            if time.monotonic() < self._due_s + LATE_S:
                return
            start = here
        whole_s = self._takes_s(start, self._target)
        if whole_s * max(self._speed) < REACHED:
            self._target = None
            return
        piece = between(self._kinematics, start, self._target, min(1.0, PIECE_S / whole_s), True)
        self._sent = self._arm.move_linear(piece, wait=False)
        self._due_s = time.monotonic() + self._takes_s(here, self._sent)

    def _takes_s(self, start: np.ndarray, end: np.ndarray) -> float:
        """Duration in s of a straight move at full speed."""
        way_mm, turn_deg = way_between(start, end, self._arm.axes)
        return max(way_mm / self._speed[0], turn_deg / self._speed[1])
