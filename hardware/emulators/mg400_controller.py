"""The emulated MG400's controller: modes, alarms, frames and the queue of moves. It does not use sockets."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from threading import RLock
from typing import NamedTuple

import numpy as np

from hardware.arms.mg400_wire import MAX_JOINT_DEG_S, MAX_LINEAR_MM_S, ErrorId, Mode
from hardware.arms.motion import MG400, MotionTrack, OutOfReachError, Piece, Speeds, Violation, check_line
from hardware.emulators.faults import Faults
from twin.errors import ErrorsAs

# Largest accelerations. They are chosen for the emulator, because those of a real arm are not known.
MAX_LINEAR_MM_S2, MAX_JOINT_DEG_S2 = 4000.0, 3000.0
# Numbers of alarms (see ``hardware.arms.motion``).
EMERGENCY_STOP, COLLISIONS = 85, (112, -2)
# Joints at the start, far from all limits.
START_JOINTS_DEG = (0.0, 20.0, 40.0, 0.0)
# Step of the search for the end of a jog, in mm or deg.
JOG_STEP = 1.0
# Longest jog, mm or deg. It is longer than every range of motion.
JOG_REACH = 1000.0


class RefusedError(Exception):
    """A request is refused with an error id."""

    def __init__(self, error_id: int) -> None:
        super().__init__(f"refused: {error_id}")
        self.error_id = int(error_id)


def refuse_if(wrong: object, error_id: int = ErrorId.FAILED) -> None:
    """Raise ``RefusedError`` if something is wrong."""
    if wrong:
        raise RefusedError(error_id)


class PlanarFrame(NamedTuple):
    """A user or tool frame of an arm that turns about z only."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    r: float = 0.0

    def __matmul__(self, other: "PlanarFrame") -> "PlanarFrame":
        c, s = np.cos(np.radians(self.r)), np.sin(np.radians(self.r))
        return PlanarFrame(self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, self.z + other.z, self.r + other.r)

    def inverse(self) -> "PlanarFrame":
        c, s = np.cos(np.radians(self.r)), np.sin(np.radians(self.r))
        return PlanarFrame(-c * self.x - s * self.y, s * self.x - c * self.y, -self.z, -self.r)

    @classmethod
    def of_pose(cls, pose: np.ndarray) -> "PlanarFrame":
        """The frame whose origin and turn are those of a pose."""
        return cls(*(float(value) for value in np.asarray(pose)[[0, 1, 2, 5]]))

    @property
    def pose(self) -> np.ndarray:
        return np.array([self.x, self.y, self.z, 0.0, 0.0, self.r])


@dataclass(frozen=True)
class Order:
    """A queued command: a linear move to a pose, a move to joints, or a wait. ``end_s`` is the planned end of the command."""

    end: np.ndarray
    linear: bool
    speeds: Speeds
    jog: bool = False
    end_s: float = np.inf
    outputs: tuple[tuple[float, int, int], ...] = ()  # share of the time at which a digital output is set, its index and level
    wait_s: float | None = None  # time to rest, instead of a move

    def at(self, share: float) -> "Order":
        """The same command at a share of its speed."""
        speeds = replace(self.speeds, linear_mm_s=share * self.speeds.linear_mm_s, angular_deg_s=share * self.speeds.angular_deg_s)
        return replace(self, speeds=speeds)


class Mg400Controller:
    """Executes the commands of the arm. Every method may be called from any thread.

    Parameters
    ----------
    faults : Faults
    joints_deg : (4,) float
        Joints at the start.
    time_scale : float
        Factor by which it moves faster than the real arm.
    """

    def __init__(self, faults: Faults, *, joints_deg: Sequence[float] = START_JOINTS_DEG, time_scale: float = 1.0) -> None:
        self.faults, self.kinematics, self._time_scale = faults, MG400, time_scale
        self.track = MotionTrack(MG400, np.asarray(joints_deg, float))
        self.lock = RLock()
        self.enabled = self.paused = False
        self.alarms: list[int] = []
        self.load = (0.0, 0.0, 0.0, 0.0)
        self.digital_out = 0
        self.dragged = False
        self._outputs: list[tuple[float, int, int]] = []  # time, index and level of outputs that moves will set
        self.percent = {"speedj": 100.0, "speedl": 100.0, "accj": 100.0, "accl": 100.0, "cp": 0.0, "speedfactor": 100.0}
        self.frames = {kind: {0: PlanarFrame()} for kind in ("user", "tool")}
        self.selected = {"user": 0, "tool": 0}  # numbers of the frames
        self._orders: list[Order] = []  # started, or planned on the track
        self._held: list[Order] = []  # waiting for Continue
        self._due: list[tuple[float, tuple[int, ...]]] = []  # future alarms

    def update(self) -> float:
        """Raise the alarms that are due. Returns the present time."""
        now_s = time.monotonic()
        with self.lock:
            for _, index, level in sorted(one for one in self._outputs if one[0] <= now_s):
                self.set_output(index, level)
            self._outputs = [one for one in self._outputs if one[0] > now_s]
            for due_s, alarms in sorted(self._due):
                if due_s <= now_s and not self.alarms:
                    self.raise_alarm(*alarms, time_s=due_s)
        return now_s

    def raise_alarm(self, *alarms: int, time_s: float | None = None) -> None:
        """Stop and raise alarms. The queue is held until ``ClearError`` and ``Continue``."""
        with self.lock:
            self._hold(time.monotonic() if time_s is None else time_s)
            self.alarms += alarms

    def press_emergency_stop(self) -> None:
        """Switch the power off, and raise an alarm."""
        with self.lock:
            self.raise_alarm(EMERGENCY_STOP)
            self._held.clear()
            self.enabled = self.dragged = False

    def mode(self) -> Mode:
        now_s = self.update()
        with self.lock:
            moving = self.track.moving(now_s)
            holds = {Mode.ERROR: self.alarms, Mode.DISABLED: not self.enabled, Mode.BACKDRIVE: self.dragged, Mode.PAUSE: self.paused}
            holds |= {Mode.JOG: moving and self._orders[-1].jog, Mode.RUNNING: moving}
            return next((mode for mode, held in holds.items() if held), Mode.ENABLED)

    def busy(self) -> bool:
        """Whether commands are still in progress or queued (``Sync`` waits for them)."""
        now_s = self.update()
        with self.lock:
            return bool(self._held) or self.track.moving(now_s)

    @property
    def queue_runs(self) -> bool:
        """Whether queued moves are executed."""
        return not (self.alarms or self._held)

    def enable(self) -> None:
        with self.lock:
            refuse_if(self.alarms)
            self.enabled = True

    def disable(self) -> None:
        with self.lock:
            self.reset()
            self.enabled = self.dragged = False

    def clear_error(self) -> None:
        with self.lock:
            self.alarms.clear()

    def reset(self) -> None:
        """Stop and empty the queue."""
        with self.lock:
            self.update()  # so that an alarm that was raised stays
            self._hold(time.monotonic())
            self._held.clear()
            self.paused = False

    def set_output(self, index: int, level: int) -> None:
        """Set a digital output at once."""
        bit = 1 << (index - 1)
        self.digital_out = self.digital_out | bit if level else self.digital_out & ~bit

    def drag(self, begin: bool) -> None:
        """Begin or end the mode in which a person moves the arm by hand. It is possible only while the arm is enabled and without error."""
        with self.lock:
            refuse_if(self.alarms or not self.enabled)
            self.reset()
            self.dragged = begin

    def set_percent(self, name: str, percent: float) -> None:
        """Set a percentage. ``SpeedFactor`` also applies to moves in progress and queued moves."""
        with self.lock:
            now_s, before = self.update(), self.percent[name]
            self.percent[name] = percent
            if name != "speedfactor":
                return
            share = percent / before
            waiting = [one for one in self._orders if one.end_s > now_s]
            self._held = [one.at(share) for one in self._held]
            if not waiting:
                return
            due, self._due = self._due, []
            self._orders = [one for one in self._orders if one.end_s <= now_s]
            self._outputs = []
            self.track.stop(now_s)
            for one in waiting:
                self._plan(one.at(share))
            self._due += [(self.track.end_s, alarms) for _, alarms in due]

    def stop_jog(self) -> None:
        """End a jog. Other moves continue."""
        if self.mode() == Mode.JOG:
            self.reset()

    def pause(self) -> None:
        """Hold the queue until ``Continue``."""
        with self.lock:
            self._hold(time.monotonic())
            self.paused = True

    def resume(self) -> None:
        """``Continue``: execute the held commands."""
        with self.lock:
            refuse_if(self.alarms or not self.enabled)
            self.paused = False
            held, self._held = self._held, []
            for order in held:
                self._plan(order)

    def order(self, order: Order) -> None:
        """Queue a move.

        Raises
        ------
        RefusedError
            The arm is disabled or in error.
        """
        with self.lock:
            self.update()
            refuse_if(self.alarms or self.dragged or not self.enabled)
            if "ignore-moves" in self.faults:
                return
            if self.paused or self._held:
                self._held.append(order)
            else:
                self._plan(order)

    def last_target(self) -> PlanarFrame:
        """Flange frame at the end of the queue."""
        with self.lock:
            last = next((one for one in reversed(self._held) if one.wait_s is None), None)
            if last is None:
                return PlanarFrame.of_pose(self.track.pose(max(self.track.end_s, time.monotonic())))
            return PlanarFrame.of_pose(last.end if last.linear else self.kinematics.forward(last.end))

    def joints_at(self, flange: PlanarFrame) -> np.ndarray:
        """Joints at a flange pose.

        Raises
        ------
        RefusedError
            No joints reach the pose.
        """
        with ErrorsAs(OutOfReachError, lambda error: RefusedError(ErrorId.FAILED)):
            return self.kinematics.inverse(flange.pose)

    def speeds(self, percent: float, acceleration: float) -> Speeds:
        """Speeds at the given percentages."""
        factor = self._time_scale * percent / 100.0 * self.percent["speedfactor"] / 100.0 * self.faults.factor("slow")
        ramp = acceleration / 100.0 * self._time_scale**2
        return Speeds(MAX_LINEAR_MM_S * factor, MAX_JOINT_DEG_S * factor, MAX_LINEAR_MM_S2 * ramp, MAX_JOINT_DEG_S2 * ramp)

    def jog(self, axis: str, *, user: PlanarFrame) -> None:
        """Move along an axis (``J1+``, ``X-``, ...) until a limit, which raises an alarm, or until ``MoveJog()``."""
        sign = {"+": 1.0, "-": -1.0}[axis[-1]]
        with self.lock:
            self.update()
            refuse_if(self.alarms or not self.enabled)
            self.reset()
            joints = self.track.joints_deg(time.monotonic())
            linear = not axis.startswith("j")
            start = self.kinematics.forward(joints) if linear else joints
            step = np.zeros(len(start))
            if linear:
                along = PlanarFrame(r=user.r) @ PlanarFrame(**{axis[0]: sign})
                step = np.array([along.x, along.y, along.z, 0, 0, along.r if axis[0] == "r" else 0.0])
            else:
                step[int(axis[1]) - 1] = sign
            length, violation = 0.0, None
            while violation is None and length < JOG_REACH:
                beyond = start + (length + JOG_STEP) * step
                violation = check_line(self.kinematics, beyond, beyond) if linear else self.kinematics.violation(beyond)
                length += JOG_STEP if violation is None else 0.0
            self._plan(Order(start + length * step, linear, self.speeds(10.0, 100.0), jog=True))
            if violation is not None:
                self._due = [(self.track.end_s, (violation.code,))]

    def _plan(self, order: Order) -> None:
        if order.wait_s is not None:
            planned: Piece | Violation = self.track.dwell(order.wait_s, now_s=time.monotonic())
        else:
            planned = self.track.move(order.end, order.speeds, linear=order.linear, now_s=time.monotonic())
        if isinstance(planned, Violation):
            self._due.append((max(self.track.end_s, time.monotonic()), (planned.code,)))
            return
        waiting = [one for one in self._orders if one.end_s > time.monotonic()]
        self._orders = [*waiting, replace(order, end_s=planned.end_s)]
        self._outputs += [(planned.start_s + share * planned.duration_s, index, level) for share, index, level in order.outputs]
        if planned.duration_s > 0 and (share := self.faults.value("collision")) is not None:
            self._due.append((planned.start_s + share * planned.duration_s, COLLISIONS))
        if planned.duration_s > 0 and (share := self.faults.value("stall")) is not None:
            self.track.stop(planned.start_s + share * planned.duration_s)

    def _hold(self, time_s: float) -> None:
        """Stop and keep the moves that are not finished."""
        self._held = [order for order in self._orders if order.end_s > time_s and not order.jog] + self._held
        self._orders, self._due = [order for order in self._orders if order.end_s <= time_s], []
        self._outputs = [one for one in self._outputs if one[0] <= time_s]
        self.track.stop(time_s)
