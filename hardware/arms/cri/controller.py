"""Arms with the interface of ``cri``'s controllers: poses of the flange in the base frame as quaternions.

``Controller["mg400"]`` gives a class of arms, as ``cri.controller.Controller`` does.
"""

import time
import warnings
from abc import ABC, abstractmethod
from typing import Self

import numpy as np

from hardware.arms.arm import Arm, NewestTarget
from hardware.arms.cri.transforms import Numbers, euler2mat, mat2euler, mat2quat, quat2mat
from hardware.arms.mg400 import MG400
from hardware.arms.mg400_wire import DEFAULT_HOSTS, MAX_JOINT_DEG_S, MAX_LINEAR_MM_S
from hardware.arms.motion import circle, way_between
from hardware.arms.open_arm import open_arm
from hardware.errors import DeviceError, leave, on_error

# Speeds at the start, as in cri: % of the MG400's largest speed, mm/s and deg/s for other arms.
START_SPEED = 20.0
# Time limit of a move: the first number (s), plus the second number times the duration that its path and speed give.
PATIENCE_S, PATIENCE = 10.0, 5.0
NO_POSE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class Closing(ABC):
    """An object that ``cri`` closes at the end of a ``with`` block."""

    def __repr__(self) -> str:
        return f"{type(self).__name__} ({self.info})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object, /) -> None:
        leave(self.close, error)

    @property
    @abstractmethod
    def info(self) -> str:
        """Name of the arm."""

    @abstractmethod
    def close(self) -> None:
        """Release the arm."""


def _speed(name: str, unit: str) -> property:
    """A speed of a ``RobotController``, which tells the arm when it is set."""

    def get(controller: "RobotController") -> float:
        return float(getattr(controller, f"_{name}"))

    def put(controller: "RobotController", speed: float) -> None:
        setattr(controller, f"_{name}", controller._speed_of(name, speed))
        controller._set_speeds()

    return property(get, put, doc=f"{unit}; on the MG400 % of its fastest.")


class RobotController(Closing):
    """An arm with the interface of ``cri``. The constructor connects and enables it.

    Parameters
    ----------
    arm : str or Arm
        A specification for ``open_arm``, or an arm that isn't connected yet.

    Attributes
    ----------
    servo_delay : (float, float) or None
        With a delay, a move does not wait for its end: the arm moves towards the newest pose, and the call returns after the first number
        (s).
    tolerance : float or None
        With a tolerance (mm and deg) a move ends as soon as the arm is that near. Otherwise it ends when the arm is at rest there.
    elbow, commanded_elbow : None
        Arms of four and six axes have no elbow.
    """

    elbow = commanded_elbow = None
    linear_speed, angular_speed = _speed("linear_speed", "mm/s"), _speed("angular_speed", "deg/s")

    def __init__(self, arm: str | Arm) -> None:
        self.arm = open_arm(arm) if isinstance(arm, str) else arm
        self._linear_speed = self._angular_speed = START_SPEED
        self._overall: float | None = None
        self._tilt_deg = np.zeros(2)  # last commanded tilt. It is part of returned poses, because an arm of four axes does not report it
        self._tcp = np.array(NO_POSE)
        self._servo_delay: tuple[float, float] | None = None
        self._newest: NewestTarget | None = None
        self.tolerance: float | None = None
        self.commanded_pose: np.ndarray | None = None
        self.commanded_joint_angles: np.ndarray | None = None
        self.arm.connect()
        with on_error(self.arm.disconnect):
            self.arm.clear_error()
            self.arm.enable()
            self._set_speeds()

    @property
    def info(self) -> str:
        return self.arm.name

    @property
    def tcp(self) -> np.ndarray:
        """The tool frame (7,) on the flange, whose pose is reported and commanded."""
        return self._tcp

    @tcp.setter
    def tcp(self, tcp: Numbers) -> None:
        self._tcp = np.asarray(tcp, float)

    @property
    def speed(self) -> float:
        """Overall speed, %. Before it is set, it is the value that an MG400 reports, and 100 for other arms."""
        if self._overall is not None:
            return self._overall
        return self.arm.overall_percent if isinstance(self.arm, MG400) else 100.0

    @speed.setter
    def speed(self, speed: float) -> None:
        self._overall = _percent("speed", speed)
        self._set_speeds()

    @property
    def servo_delay(self) -> tuple[float, float] | None:
        """Delay after each move that does not wait for its end, s, and its bound; None: moves wait."""
        return self._servo_delay

    @servo_delay.setter
    def servo_delay(self, delay: float | tuple[float, float] | None) -> None:
        self._servo_delay = (float(delay), 0.02) if isinstance(delay, int | float) else delay
        self._end_servo()

    @property
    def blend_radius(self) -> float:
        """0: each move ends before the next begins."""
        return 0.0

    @blend_radius.setter
    def blend_radius(self, blend_radius: float) -> None:
        if blend_radius:
            warnings.warn(f"{self.arm.name}: moves are not blended; blend_radius stays 0", stacklevel=2)

    @property
    def pose(self) -> np.ndarray:
        pose = self.arm.state().pose.copy()
        if self.arm.axes == 4:
            pose[3:5] = self._tilt_deg
        return mat2quat(euler2mat(pose) @ quat2mat(self._tcp))

    @property
    def joint_angles(self) -> np.ndarray:
        """Present joints (J,), deg."""
        return self.arm.state().joints_deg

    def move_joints(self, joint_angles: Numbers) -> None:
        self._end_servo()
        joints = np.asarray(joint_angles, float)
        way_deg = float(np.abs(joints - self.joint_angles).max()) if joints.shape == self.joint_angles.shape else 0.0
        self.commanded_joint_angles = self.arm.move_joints(joints, timeout_s=PATIENCE_S + PATIENCE * way_deg / self._speeds()[1])

    def move_linear(self, pose: Numbers, elbow: float | None = None) -> None:
        """Move the tool straight to a pose (7,). ``elbow`` is ignored, because arms of four and six axes have none."""
        flange = self._flange(pose)
        if self._servo_delay is not None:
            self._follow(flange, self._servo_delay[0])
        else:
            self._go([flange])
        self.commanded_pose, self._tilt_deg = np.asarray(pose, float), flange[3:5]

    def move_circular(self, via_pose: Numbers, end_pose: Numbers, elbow: float | None = None) -> None:
        """Move the tool along the circle through its place, ``via_pose`` and ``end_pose`` (7,), turning evenly from pose to pose."""
        via, end = self._flange(via_pose), self._flange(end_pose)
        start = self.arm.state().pose
        self._go(circle(start, via, end))
        self.commanded_pose, self._tilt_deg = np.asarray(end_pose, float), end[3:5]

    def close(self) -> None:
        self._end_servo()
        self.arm.disconnect()

    def _flange(self, pose: Numbers) -> np.ndarray:
        """The flange's pose (6,) in Euler angles for a pose (7,) of the tool frame."""
        return mat2euler(quat2mat(pose) @ np.linalg.inv(quat2mat(self._tcp)))

    def _go(self, poses: list[np.ndarray]) -> None:
        """Move through poses (6,) without a stop, and wait for the last one."""
        self._end_servo()
        here, time_s = self.arm.state().pose, 0.0
        linear_mm_s, angular_deg_s = self._speeds()
        for pose in poses:
            way_mm, turn_deg = way_between(here, pose, self.arm.axes)
            time_s, here = time_s + way_mm / linear_mm_s + turn_deg / angular_deg_s, pose
        timeout_s = PATIENCE_S + PATIENCE * time_s
        for pose in poses[:-1]:
            self.arm.move_linear(pose, wait=False, timeout_s=timeout_s)
        if self.tolerance is None:
            self.arm.move_linear(poses[-1], timeout_s=timeout_s)
            return
        sent = self.arm.move_linear(poses[-1], wait=False, timeout_s=timeout_s)
        self.arm.wait_settled(sent, tolerance_mm=self.tolerance, tolerance_deg=self.tolerance, timeout_s=timeout_s, at_rest=False)

    def _follow(self, flange: np.ndarray, delay_s: float) -> None:
        """Send the arm towards the flange's newest pose (6,), and return after the delay."""
        if self._newest is None:
            self._newest = NewestTarget(self.arm, *self._speeds())
            self._newest.start()
        with on_error(self.arm.stop), on_error(self._end_servo):
            self._newest.go(flange)
            time.sleep(delay_s)

    def _end_servo(self) -> None:
        if self._newest is not None:
            self._newest.end()
        self._newest = None

    def _speed_of(self, name: str, speed: float) -> float:
        if isinstance(self.arm, MG400):
            return _percent(name, speed)
        if not 0 < speed < np.inf:
            raise DeviceError(f"{name} {speed}: expected a positive number of mm/s or deg/s")
        return float(speed)

    def _speeds(self) -> tuple[float, float]:
        """Speed of a line in mm/s and of turns in deg/s."""
        overall = self.speed / 100.0
        linear, angular = overall * self._linear_speed, overall * self._angular_speed
        if isinstance(self.arm, MG400):
            return linear / 100.0 * MAX_LINEAR_MM_S, min(linear, angular) / 100.0 * MAX_JOINT_DEG_S
        return linear, angular

    def _set_speeds(self) -> None:
        self._end_servo()
        if isinstance(self.arm, MG400):
            self.arm.set_speed_percent(linear=self._linear_speed, angular=self._angular_speed, overall=self._overall)
        else:
            self.arm.set_speed(*self._speeds())


class MG400Controller(RobotController):
    """The MG400 at its address, or at ``ADDRESS:DASHBOARD_PORT``."""

    def __init__(self, ip: str = DEFAULT_HOSTS["LAN1"]) -> None:
        super().__init__(f"mg400:{ip}")


class MagicianController(RobotController):
    """The Magician at a serial port, or the only one that is attached."""

    def __init__(self, port: str = "") -> None:
        super().__init__(f"magician:{port}" if port else "magician")


class DummyController(RobotController):
    """A simulated arm of six axes. The address of a real one may stand there and is not used."""

    def __init__(self, ip: str = "", port: int | str | None = None) -> None:
        super().__init__("simulated")


class _Controllers(dict[str, type[RobotController]]):
    """Classes of arms by cri's names."""

    def __missing__(self, kind: str) -> type[RobotController]:
        raise KeyError(f"no controller '{kind}'; there are: {', '.join(self)}")


Controller = _Controllers(mg400=MG400Controller, magician=MagicianController, dummy=DummyController)


def _percent(name: str, speed: float) -> float:
    if not 1.0 <= speed <= 100.0:
        raise DeviceError(f"{name} {speed}: expected 1 to 100 (% of the fastest)")
    return float(speed)
