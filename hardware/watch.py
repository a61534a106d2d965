"""Watching an arm while a program works with it: where it was, and that it still answers.

A thread asks the arm for its state many times a second. When the arm answers no more, the thread stops it and says so at once, whatever the
program waits for at that moment. It also says what the program waits for if that takes long.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from hardware.arms.arm import Arm, ArmState
from hardware.cameras.source import FrameSource
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError
from twin.types import Frame

LOG = logging.getLogger(__name__)
# States of the arm that are kept: 256 states of 20 ms are 5 s, ten times the oldest frame that a servo accepts.
KEPT_STATES = 256
# Interval in s at which the thread asks the arm for its state.
WATCH_S = 0.02
# The thread leaves a slow connection free for this number of times as long as a state takes.
IDLE_SHARE = 2.0
# Interval in s at which a wait for a frame looks whether the arm still answers.
LOOK_S = 1.0
# First time in s after which the thread says what the program waits for. Each further time is twice as long.
WORD_S = 1.5


class ArmWatch:
    """Keeps the newest states of an arm, and stops the arm when it answers no more.

    Parameters
    ----------
    arm : Arm
    tell : callable
        Called with each line that a person should see at once. By default the line is logged, which writes it to stderr.
    """

    def __init__(self, arm: Arm, *, tell: Callable[[str], None] = LOG.warning) -> None:
        self._arm, self._tell = arm, tell
        self._states: deque[ArmState] = deque(maxlen=KEPT_STATES)
        self._lost, self._looking = "", threading.Lock()
        self._doing: tuple[str, float] | None = None  # what the program waits for, and since when

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

    def require(self) -> None:
        """Raise ``DeviceError`` if the arm has been lost. A program that waits for something else calls this from time to time."""
        if self._lost:
            raise DeviceError(self._lost)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Context in which the thread runs."""
        end = threading.Event()
        thread = threading.Thread(target=self._watch, args=(end,), name="arm watch", daemon=True)
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()

    @contextmanager
    def alert(self) -> Iterator[None]:
        """Context of the work. After an error in it the arm is looked at once more, so that a lost arm is told first."""
        try:
            yield
        except BaseException:
            self._look()
            raise

    @contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Context of something that may take long. What it is will be said while it lasts."""
        around, self._doing = self._doing, (what, time.monotonic())
        try:
            yield
        finally:
            self._doing = around

    def frame_after(self, source: FrameSource, time_s: float, *, timeout_s: float) -> Frame:
        """The first frame of a camera that was exposed after a time; ``TimeoutError``. The wait ends when the arm is lost."""
        deadline = time.monotonic() + timeout_s
        with self.doing("waiting for a frame"):
            while True:
                self.require()
                left_s = deadline - time.monotonic()
                try:
                    return source.read_after(time_s, timeout_s=max(0.0, min(LOOK_S, left_s)))
                except TimeoutError as error:
                    if left_s <= LOOK_S:
                        raise TimeoutError(f"{source.name}: no frame exposed since then within {timeout_s:g} s") from error

    def _watch(self, end: threading.Event) -> None:
        said: tuple[tuple[str, float], float] | None = None  # what was said last, and when to say it again
        pause_s = WATCH_S
        while not end.wait(pause_s):
            begun_s = time.monotonic()
            self._look()
            pause_s = max(WATCH_S, IDLE_SHARE * (time.monotonic() - begun_s))
            doing = self._doing
            if doing is None:
                continue
            if said is None or said[0] is not doing:
                said = doing, doing[1] + WORD_S
            if time.monotonic() > said[1]:
                waited_s = time.monotonic() - doing[1]
                self._tell(f"{self._arm.name}: {doing[0]}, {waited_s:.0f} s so far")
                said = doing, time.monotonic() + waited_s

    def _look(self) -> None:
        """Ask the arm for its state; if it does not answer, stop it and say so, once."""
        with self._looking:
            try:
                if not self._lost:
                    self.add(self._arm.state())
            except (StaleDataError, DeviceNotConnectedError) as error:
                self._lose(error)
            except DeviceError:  # the caller that moves the arm gets the same error
                pass

    def _lose(self, error: DeviceError) -> None:
        """Stop an arm that answers no more. Say it before and after, as a stop may take its time."""
        self._lost = str(error)
        self._tell(f"{error}. Stopping the arm: press its emergency stop if it moves")
        try:
            self._arm.stop()
        except DeviceError as failed:
            self._lost += f"; {failed}"
            self._tell(str(failed))
        else:
            self._tell(f"{self._arm.name}: stopped")
