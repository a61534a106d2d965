"""The rule for every motion that can end in contact or nearer to an object: it needs fresh frames.

A motion leaves standstill only after a fresh frame, and a thread stops the arm as soon as no fresh frame comes (``FrameSource.blind``). On
the path to a contact the last millimetres are made in pieces. Each piece follows a frame that shows the end of the piece before it.
Therefore no fault leads the sensor farther than one piece, not even the end of this program.

Another thread watches the arm while a program works with it (``ArmWatch``). It asks the arm for its state many times a second. If the arm
no longer answers, the thread stops it and reports this at once, even while the program waits for something else. It also reports what the
program waits for if the wait takes long.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TypeVar

import numpy as np

from hardware.arms.arm import Arm, ArmState
from hardware.arms.awake import awake_s
from hardware.cameras.source import FrameSource
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError, on_error
from twin.types import Frame

LOG = logging.getLogger(__name__)
# Number of the arm's states that are kept. At 20 ms each they cover 5 s, ten times the age of the oldest frame that a servo accepts.
KEPT_STATES = 256
# Interval in s at which the thread asks the arm for its state.
WATCH_S = 0.02
# Pause between two requests, as a multiple of the time that a request takes. So other commands get through on a slow connection.
IDLE_SHARE = 2.0
# Interval in s at which a wait for a frame checks whether the arm still answers.
ARM_LOOK_S = 1.0
# Waiting time in s after which the thread first reports what the program waits for. It reports again whenever that time has doubled.
WORD_S = 1.5
Result = TypeVar("Result")
PoseAt = Callable[[float], np.ndarray]
ContactAt = Callable[[np.ndarray], float]
# Interval, s, at which the thread looks at the frames while the arm moves, and at which a wait for a fresh frame looks.
LOOK_S = 0.01
# Distance, mm, before the first touch at which the pieces begin, and the largest length of a piece.
NEAR_MM, PIECE_MM = 5.0, 0.8
# Travel in contact, mm, after which a picture must have changed, even a picture without noise.
SAME_MM = 1.0


@contextmanager
def work_in_thread(work: Callable[[threading.Event], None], name: str) -> Iterator[None]:
    """Context in which a thread does ``work``, which ends when the event that it is given is set."""
    end = threading.Event()
    thread = threading.Thread(target=work, args=(end,), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()


class ArmWatch:
    """Keeps the newest states of an arm, and stops the arm if it no longer answers.

    Parameters
    ----------
    arm : Arm
    report : callable
        Called with each message that a person should see at once. By default the message is logged, and so goes to stderr.
    """

    def __init__(self, arm: Arm, *, report: Callable[[str], None] = LOG.warning) -> None:
        self._arm, self._report = arm, report
        self._states: deque[ArmState] = deque(maxlen=KEPT_STATES)
        self._lost, self._looking = "", threading.Lock()
        self._doing: tuple[str, float] | None = None  # what the program waits for, and since when

    def add(self, state: ArmState) -> None:
        """Keep a state."""
        self._states.append(state)

    @property
    def newest(self) -> ArmState | None:
        """The newest kept state, without a request to the arm; None before the first one."""
        return self._states[-1] if self._states else None

    def pose_at(self, time_s: float) -> np.ndarray:
        """Pose (6,) of the arm at a ``time.monotonic()``, interpolated between the kept states. Its turn about z is unwrapped."""
        states = sorted(self._states.copy(), key=lambda state: state.time_s)
        times = np.array([state.time_s for state in states])
        poses = np.array([state.pose for state in states])
        poses[:, 5] = np.unwrap(poses[:, 5], period=360.0)
        return np.array([np.interp(time_s, times, column) for column in poses.T])

    def require(self) -> None:
        """Raise ``DeviceError`` if the arm no longer answers. A program that waits for something else calls this from time to time."""
        if self._lost:
            raise DeviceError(self._lost)

    def watching(self) -> AbstractContextManager[None]:
        """Context in which the thread runs."""
        return work_in_thread(self._watch, "arm watch")

    def alert(self) -> AbstractContextManager[None]:
        """Context of the work with the arm. After an error the arm's state is read once more, so that a lost arm is reported first."""
        return on_error(self._look)

    @contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Context of an action that may take long. The thread reports the action while it lasts."""
        around, self._doing = self._doing, (what, time.monotonic())
        try:
            yield
        finally:
            self._doing = around

    def frame_after(self, source: FrameSource, time_s: float, *, timeout_s: float) -> Frame:
        """The first frame that a camera exposed after ``time_s``; ``TimeoutError`` if none comes. The wait also ends if the arm is lost."""
        deadline = time.monotonic() + timeout_s
        with self.doing("waiting for a frame"):
            while True:
                self.require()
                left_s = deadline - time.monotonic()
                try:
                    return source.read_after(time_s, timeout_s=max(0.0, min(ARM_LOOK_S, left_s)))
                except TimeoutError as error:
                    if left_s <= ARM_LOOK_S:
                        raise TimeoutError(f"{source.name}: no frame exposed since then within {timeout_s:g} s") from error

    def _watch(self, end: threading.Event) -> None:
        said: tuple[tuple[str, float], float] | None = None  # the newest report, and when to repeat it
        pause_s = WATCH_S
        while not end.wait(pause_s):
            begun_s = awake_s()
            self._look()
            pause_s = max(WATCH_S, IDLE_SHARE * (awake_s() - begun_s))
            doing = self._doing
            if doing is None:
                continue
            if said is None or said[0] is not doing:
                said = doing, doing[1] + WORD_S
            if time.monotonic() > said[1]:
                waited_s = time.monotonic() - doing[1]
                self._report(f"{self._arm.name}: {doing[0]}, {waited_s:.0f} s so far")
                said = doing, time.monotonic() + waited_s

    def _look(self) -> None:
        """Ask the arm for its state. If it does not answer, stop it and report this, once only."""
        with self._looking:
            try:
                if not self._lost:
                    self.add(self._arm.state())
            except (StaleDataError, DeviceNotConnectedError) as error:
                self._lose(error)
            except DeviceError:  # the caller that moves the arm gets the same error
                pass

    def _lose(self, error: DeviceError) -> None:
        """Stop an arm that no longer answers. It is reported before and after the stop, because a stop may take some time."""
        self._lost = str(error)
        self._report(f"{error}. Stopping the arm: press its emergency stop if it moves")
        try:
            self._arm.stop()
        except DeviceError as failed:
            self._lost += f"; {failed}"
            self._report(str(failed))
        else:
            self._report(f"{self._arm.name}: stopped")


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

    def __init__(self, arm: Arm, source: FrameSource, pose_at: PoseAt | None = None, contact_mm: ContactAt | None = None) -> None:
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
        rule = f"{self._arm.name} moves only with fresh frames; check the camera, and what else this computer does"
        return BlindError(f"{self._source.name}: {why}; {rule}")


def pieces_to(start: np.ndarray, target: np.ndarray, near_mm: float) -> list[np.ndarray]:
    """Poses (6,) of a straight path to a target (6,): the last ``near_mm`` are divided into pieces of at most ``PIECE_MM``."""
    way_mm = float(np.linalg.norm(target[:3] - start[:3]))
    near_mm = min(near_mm, way_mm)
    pieces = int(np.ceil(near_mm / PIECE_MM))
    left_mm = near_mm * np.arange(pieces, -1, -1) / max(pieces, 1)
    shares = 1.0 - left_mm / max(way_mm, 1e-9)
    return [start + share * (target - start) for share in shares if share > 0.0] if pieces else [target]
