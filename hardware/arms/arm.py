"""The interface of an arm for a loop (``Arm``, ``ArmState``), the common part of all drivers (``BaseArm``), and a simulated arm.

``NewestTarget`` moves an arm towards the newest target of a stream. The Dobots queue all moves and execute every one of them. If targets
came faster than the arm moves, the arm would still execute old ones long after the stream has ended. So the path to a target is divided
into short moves (pieces), and the arm gets the next piece only when it has nearly reached the end of the present one.

Units are mm and degrees; times are ``time.monotonic()`` seconds.
"""

import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from hardware.arms import motion
from hardware.errors import Connection, DeviceError, StaleDataError, undo
from twin.errors import ErrorsAs

# Interval in s at which feedback is read. It is shorter than the 8 ms period of the fastest feedback.
POLL_S = 0.005
# Largest age, s, of feedback that is used. Therefore a lost or frozen arm is stopped and reported within a second.
FEEDBACK_AGE_S = 0.8
# Longest time, s, until a commanded move shows in feedback. An arm that rests elsewhere for longer does not execute the move.
BELIEVE_REST_S = 0.15
# Longest rest, s, of an arm in a wait with a long time limit. The arm may rest for a tenth of the limit, but not longer than this, before
# it is an error.
MOST_REST_S = 1.5


@dataclass(frozen=True)
class ArmState:
    """One report of an arm about itself.

    Attributes
    ----------
    pose : (6,) float
        ``x, y, z, rx, ry, rz`` of the tool in the base frame, mm and deg, static xyz Euler angles.
        An arm of four axes has ``rx = ry = 0`` and its turn R as ``rz``.
    joints_deg : (J,) float
    time_s : float
        ``time.monotonic()`` when the state arrived.
    enabled, moving : bool
    error : str
        The arm's error in words; "" if there is none.
    """

    pose: np.ndarray
    joints_deg: np.ndarray
    time_s: float
    enabled: bool
    moving: bool
    error: str = ""


class Arm(Protocol):
    """A robot arm. Nothing moves or opens in a constructor; nothing moves before ``enable``.

    Every method but ``connect`` raises ``DeviceNotConnectedError`` if the arm is not connected, and ``DeviceError`` if the arm refuses or
    fails.
    ``stop``, ``emergency_stop``, ``disable`` and ``clear_error`` are never refused by safety checks.

    If a move or a wait raises an exception (Ctrl-C included), the arm is stopped first, earlier moves too, so that it does not move on. If
    the stop fails, the message says that the arm may move, and that its emergency stop must be pressed.
    """

    name: str
    axes: int  # 4 for the Dobots, 6 where tilt can be commanded

    @property
    def is_connected(self) -> bool:
        """Whether the connection is open."""

    def connect(self) -> None:
        """Open the connection; nothing moves."""

    def disconnect(self) -> None:
        """Stop the arm and close the connection. It has no effect when the arm is not connected.

        Raises
        ------
        DeviceError
            The arm could not be stopped, and no earlier call has reported this. The connection is closed nevertheless.
        """

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None: ...

    def enable(self) -> None:
        """Switch the motors on. The arm does not move before this call."""

    def disable(self) -> None:
        """Switch the motors off."""

    def clear_error(self) -> None:
        """Acknowledge alarms, so that the arm can be enabled again."""

    def stop(self) -> None:
        """End the motion at once and empty the queue."""

    def emergency_stop(self) -> None:
        """Stop and cut the motors' power, if the arm has a command for it. ``clear_error`` and ``enable`` make the arm usable again."""

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        """The newest state; ``StaleDataError`` if it is older than ``max_age_s``."""

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        """Set the speeds of the moves that follow."""

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """Move the tool straight to ``pose`` (6,). Returns the pose that was really commanded (clamped to the arm's abilities).

        With ``wait`` it returns only when feedback shows the arm at rest there, and raises ``DeviceError`` otherwise. Without ``wait`` it
        returns when the arm has accepted the move.
        """

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """Move to joints (J,), deg; otherwise as `move_linear`. Returns the pose that was commanded."""

    def wait_settled(
        self, pose: np.ndarray, *, tolerance_mm: float = 0.1, tolerance_deg: float = 0.1, timeout_s: float = 10.0, at_rest: bool = True
    ) -> ArmState:
        """Wait for feedback of the arm at rest at ``pose``, and return this state. Without ``at_rest`` the arm may still move there.

        Raises
        ------
        DeviceError
            The arm did not get there in time, or reports an error.
        """


def happens(condition: Callable[[], object], within_s: float) -> bool:
    """Whether a condition becomes true in time. It is looked at every ``POLL_S``."""
    until_s = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > until_s:
            return False
        time.sleep(POLL_S)
    return True


class BaseArm(Connection):
    """Base class of the arms; see ``hardware.arms.arm.Arm`` for the methods."""

    axes: int
    _unstopped = False  # whether the newest stop failed and this was reported
    _speeds = motion.Speeds(50.0, 30.0)  # until ``set_speed``

    @abstractmethod
    def stop(self) -> None: ...

    @abstractmethod
    def disable(self) -> None: ...

    def emergency_stop(self) -> None:
        """Stop and disable; see ``Arm``."""
        self.stop()
        self.disable()

    @abstractmethod
    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState: ...

    def wait_settled(self, pose: np.ndarray, **options: Any) -> ArmState:
        """Wait for feedback of the arm at rest at ``pose``; see ``Arm``."""
        with self._watch_move():
            return self._wait_until_settled(pose, **options)

    def _wait_until_settled(
        self, pose: np.ndarray, *, tolerance_mm: float = 0.1, tolerance_deg: float = 0.1, timeout_s: float = 10.0, at_rest: bool = True
    ) -> ArmState:
        """As ``wait_settled``, for callers that stop the arm after an error themselves."""
        deadline = time.monotonic() + timeout_s
        asked_s, rest_since = time.monotonic(), None
        while True:
            state = self.state()
            if state.error:
                raise DeviceError(f"{self.name}: {state.error}")
            off_mm, off_deg = motion.way_between(state.pose, np.asarray(pose, float), 6)  # R may differ by full turns
            known, near = state.time_s >= asked_s, off_mm <= tolerance_mm and off_deg <= tolerance_deg
            if known and near and not (at_rest and state.moving):
                return state
            rest_since = (rest_since or state.time_s) if known and not state.moving else None
            if rest_since is not None and state.time_s - rest_since > min(max(BELIEVE_REST_S, 0.1 * timeout_s), MOST_REST_S):
                rests = f"at rest {off_mm:.2f} mm and {off_deg:.2f} deg from the commanded pose; the move was not executed"
                remedy = "Check for a stop button, a brake or an obstacle, call clear_error(), then move again"
                raise DeviceError(f"{self.name}: {rests}. {remedy}")
            if time.monotonic() > deadline:
                late = f"not there after {timeout_s:g} s ({off_mm:.2f} mm and {off_deg:.2f} deg left) and stopped"
                raise DeviceError(f"{self.name}: {late}; allow more time or more speed")
            time.sleep(POLL_S)

    @contextmanager
    def _watch_move(self) -> Iterator[None]:
        """Context in which a move is sent and waited for. After any error, Ctrl-C included, the arm is stopped, earlier moves too."""
        try:
            yield
        except BaseException as error:
            if self._may_move():
                undo(self.stop, error)
            raise

    def _require_possible(self, pose: np.ndarray) -> None:
        """Raise ``StaleDataError`` if a reported pose (6,) is impossible, because the arm's real pose is then unknown."""
        if not (np.abs(pose) < motion.FARTHEST).all():  # also true for NaN
            raise StaleDataError(f"{self.name}: reports the pose {pose}, which no arm reaches; stop it, then restart it")

    def _may_move(self) -> bool:
        """Whether a move that was sent may still be in progress."""
        return self.is_connected

    def _disconnect(self, *acts: Callable[[], None], close: Callable[[], None]) -> None:
        """Call ``stop`` and further actions, then ``close``. The error of a failed stop is raised, unless an earlier stop reported it."""
        told, failed = self._unstopped, None
        for act in (self.stop, *acts):
            try:
                act()
            except DeviceError as error:
                failed = failed or (error if act == self.stop else None)
        close()
        if failed is not None and not told:
            raise failed

    def _require_on_way(self, state: ArmState, deadline: float, timeout_s: float) -> None:
        """Raise ``DeviceError`` if a state reports an error, or if the move has lasted too long."""
        if state.error:
            raise DeviceError(f"{self.name}: stopped on the way: {state.error}")
        if time.monotonic() > deadline:
            remedy = "allow more time or more speed, or look for an obstacle"
            raise DeviceError(f"{self.name}: the move did not end within {timeout_s:g} s and was stopped; {remedy}")

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        """Keep the speeds of the moves that follow; see ``Arm``."""
        self._require_connected()
        if not (0 < linear_mm_s < np.inf and 0 < angular_deg_s < np.inf):
            raise DeviceError(f"{self.name}: speeds of {linear_mm_s} mm/s and {angular_deg_s} deg/s; both must be positive")
        self._speeds = replace(self._speeds, linear_mm_s=linear_mm_s, angular_deg_s=angular_deg_s)


class KinematicArm(BaseArm):
    """Base class of arms whose kinematics are known from the start. Each target is checked by them before it is sent."""

    kinematics: motion.Kinematics

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        with self._watch_move():
            sent = self.kinematics.nearest_pose(motion.finite_numbers(f"{self.name}: the pose", pose, 6))
            self._move(self._joints_at(sent), sent, wait=wait, timeout_s=timeout_s)
        return sent

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        with self._watch_move():
            sent = motion.finite_numbers(f"{self.name}: the joint angles", joints_deg, self.axes)
            self._move(sent, None, wait=wait, timeout_s=timeout_s)
        return sent

    @abstractmethod
    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        """Move along a line to ``pose`` (6,), where the joints (J,) are these, or, without a pose, move the joints there."""

    def _joints_at(self, pose: np.ndarray) -> np.ndarray:
        """Joints (J,) at a pose (6,); ``DeviceError`` if it is out of reach."""
        with ErrorsAs(motion.OutOfReachError, lambda error: DeviceError(f"{self.name}: {error}; nothing was sent")):
            return self.kinematics.inverse(pose)

    def _require_within(self, joints_deg: np.ndarray) -> None:
        """Raise ``DeviceError`` unless the joints (J,) are within the limits."""
        if violation := self.kinematics.violation(joints_deg):
            raise DeviceError(f"{self.name}: {violation.text}; nothing was sent. Choose a target within reach and limits")


class SimulatedArm(KinematicArm):
    """A simulated arm of six axes (an ideal stage) or four (the MG400's linkage).

    Parameters
    ----------
    axes : {4, 6}
    pose : (6,) float
        Pose at the start.
    time_scale : float
        Factor by which it moves faster than a real arm (``inf``: instantly).
    """

    def __init__(
        self, *, axes: int = 6, pose: Sequence[float] | np.ndarray = (300.0, 0.0, 0.0, 0.0, 0.0, 0.0), time_scale: float = 1.0
    ) -> None:
        if axes not in (4, 6):
            raise DeviceError(f"a simulated arm has 4 or 6 axes, not {axes}")
        self.name, self.axes = f"simulated arm of {axes} axes", axes
        self.kinematics = motion.StageKinematics() if axes == 6 else motion.MG400
        self.track = motion.MotionTrack(self.kinematics, self.kinematics.inverse(np.asarray(pose, float)))
        self._speeds, self._scale = motion.Speeds(100.0, 100.0, 1000.0, 1000.0), time_scale
        self._connected = self._enabled = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self) -> None:
        self._require_disconnected()
        self._connected = True

    def disconnect(self) -> None:
        if self._connected:
            self.stop()
            self._connected = self._enabled = False

    def enable(self) -> None:
        self._require_connected()
        self._enabled = True

    def disable(self) -> None:
        self._require_connected()
        self.track.stop(time.monotonic())
        self._enabled = False

    def clear_error(self) -> None:
        self._require_connected()

    def stop(self) -> None:
        self._require_connected()
        self.track.stop(time.monotonic())

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        return self._state_at(time.monotonic())

    def _state_at(self, time_s: float) -> ArmState:
        self._require_connected()
        return ArmState(self.track.pose(time_s), self.track.joints_deg(time_s), time_s, self._enabled, self.track.moving(time_s))

    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        self._require_connected()
        if not self._enabled:
            raise DeviceError(f"{self.name}: not enabled; call enable() first")
        self._begin(joints, pose)
        if wait:
            self._wait_until_settled(self.kinematics.forward(joints) if pose is None else pose, timeout_s=timeout_s)

    def _begin(self, joints: np.ndarray, pose: np.ndarray | None) -> motion.Piece:
        end, speeds = joints if pose is None else pose, self._speeds.scale_time(self._scale)
        piece = self.track.move(end, speeds, linear=pose is not None, now_s=time.monotonic())
        if isinstance(piece, motion.Violation):
            raise DeviceError(f"{self.name}: refused (alarm {piece.code}): {piece.text}; choose a target within reach and limits")
        return piece


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
        self._kinematics: motion.Kinematics = getattr(arm, "kinematics", None) or motion.StageKinematics()
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
        piece = motion.between(self._kinematics, start, self._target, min(1.0, PIECE_S / whole_s), True)
        self._sent = self._arm.move_linear(piece, wait=False)
        self._due_s = time.monotonic() + self._takes_s(here, self._sent)

    def _takes_s(self, start: np.ndarray, end: np.ndarray) -> float:
        """Duration in s of a straight move at full speed."""
        way_mm, turn_deg = motion.way_between(start, end, self._arm.axes)
        return max(way_mm / self._speed[0], turn_deg / self._speed[1])
