"""The rule for every motion that can end in contact or nearer to an object: it needs fresh frames.

A motion leaves standstill only after a fresh frame, and a thread stops the arm as soon as no fresh frame comes (``FrameSource.blind``). On
the path to a contact the last millimetres are made in pieces. Each piece follows a frame that shows the end of the piece before it.
Therefore no fault leads the sensor farther than one piece, not even the end of this program.
"""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TypeVar

import numpy as np

from hardware.arms.arm import Arm
from hardware.cameras.source import FrameSource
from hardware.errors import DeviceError, StaleDataError
from hardware.safety.watch import work_in_thread

Result = TypeVar("Result")
# Interval, s, at which the thread looks at the frames while the arm moves, and at which a wait for a fresh frame looks.
LOOK_S = 0.01
# Distance, mm, before the first touch at which the pieces begin, and the largest length of a piece.
NEAR_MM, PIECE_MM = 5.0, 0.8
# Travel in contact, mm, after which a picture must have changed, even a picture without noise.
SAME_MM = 1.0


class BlindError(StaleDataError):
    """The camera gives no fresh frame, so the arm may not move towards an object."""


class FreshFrames:
    """Lets an arm move only while a camera gives fresh frames.

    Parameters
    ----------
    arm : Arm
    source : FrameSource
        Connected while the arm moves.
    pose_at, contact_mm : callable, optional
        Give the arm's pose (6,) at a time, and the depth of the contact (negative: the gap) at a pose. With both, an unchanged picture
        counts as frozen after a travel in contact, even if pictures of this source may repeat.
    """

    def __init__(
        self,
        arm: Arm,
        source: FrameSource,
        pose_at: Callable[[float], np.ndarray] | None = None,
        contact_mm: Callable[[np.ndarray], float] | None = None,
    ) -> None:
        self._arm, self._source, self._pose_at, self._contact_mm = arm, source, pose_at, contact_mm
        self._going, self._stopped = False, ""

    def blind(self) -> str:
        """Reason why the arm may not move; "" if it may."""
        why, same_s = self._source.blind(), self._source.same_s
        if why or same_s is None or self._pose_at is None or self._contact_mm is None:
            return why
        before, now = (self._pose_at(time_s) for time_s in same_s)
        gap_mm = max(0.0, -self._contact_mm(before))
        travel_mm = float(np.linalg.norm(now[:3] - before[:3])) - gap_mm
        if self._contact_mm(now) <= 0.0 or travel_mm <= SAME_MM:
            return ""
        return f"the picture stayed the same while the arm moved {travel_mm:.1f} mm in contact"

    def await_frame(self, *, timeout_s: float) -> None:
        """Wait for a fresh frame while the arm stands; ``BlindError`` if none comes in time."""
        deadline = time.monotonic() + timeout_s
        self.stand()
        while why := self.blind():
            if time.monotonic() > deadline:
                raise self._error(why)
            time.sleep(LOOK_S)

    def move(self, act: Callable[[], Result], *, ends: bool = True) -> Result:
        """Send a motion, or wait for its end, while the frames are fresh.

        Parameters
        ----------
        act : callable
            Sends the motion or waits for its end. If the thread stops the arm meanwhile, an error of ``act`` is a ``BlindError``.
        ends : bool
            Whether the arm stands after ``act``. Otherwise the thread keeps looking until ``stand`` is called.

        Raises
        ------
        BlindError
            There is no fresh frame. The arm was stopped.
        """
        self._going = True
        try:
            if not self._stopped and (why := self.blind()):
                self._stop(why)
            if self._stopped:
                raise self._error(self._stopped)
            try:
                result = act()
            except DeviceError as error:
                raise (self._error(self._stopped) if self._stopped else error) from error
            if self._stopped:  # the motion may have been sent after the stop
                self._arm.stop()
                raise self._error(self._stopped)
            return result
        finally:
            self._going = self._going and not ends

    def stand(self) -> None:
        """Note that the arm stands: it was stopped, or came to its end."""
        self._going, self._stopped = False, ""

    def watching(self) -> AbstractContextManager[None]:
        """Context in which the thread looks at the frames."""
        return work_in_thread(self._watch, "eyes")

    def _watch(self, end: threading.Event) -> None:
        while not end.wait(LOOK_S):
            if self._going and not self._stopped and (why := self.blind()):
                self._stop(why)

    def _stop(self, why: str) -> None:
        self._stopped = why  # first, so that a motion that is being sent is stopped by its sender
        try:
            self._arm.stop()
        except DeviceError as error:
            self._stopped = f"{why}; {error}"

    def _error(self, why: str) -> BlindError:
        return BlindError(f"{self._source.name}: {why}; {self._arm.name} moves only with fresh frames")


def pieces_to(start: np.ndarray, target: np.ndarray, near_mm: float) -> list[np.ndarray]:
    """Poses (6,) of a straight path to a target (6,): the last ``near_mm`` are divided into pieces of at most ``PIECE_MM``."""
    way_mm = float(np.linalg.norm(target[:3] - start[:3]))
    near_mm = min(near_mm, way_mm)
    pieces = int(np.ceil(near_mm / PIECE_MM))
    left_mm = near_mm * np.arange(pieces, -1, -1) / max(pieces, 1)
    shares = 1.0 - left_mm / max(way_mm, 1e-9)
    return [start + share * (target - start) for share in shares if share > 0.0] if pieces else [target]
