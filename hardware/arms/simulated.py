"""A simulated arm with the same protocol as real arms. Its moves take time, and faults can be switched on."""

import time
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S, ArmState, BaseArm
from hardware.arms.kinematics import MG400, Kinematics, StageKinematics, Violation, finite_numbers, joint_target
from hardware.arms.motion import MotionTrack, Speeds
from hardware.errors import DeviceError, StaleDataError

STALL_AFTER = 0.5  # share of a move's time after which a stalling arm stands still
SLOW_FACTOR = 0.1


class SimulatedFault(StrEnum):
    """Faults of a simulated arm."""

    SLOW = "slow"  # moves at a tenth of the speed
    STALL = "stall"  # stops halfway and says that it is at rest
    IGNORE = "ignore"  # accepts a move and does not execute it
    COLLIDE = "collide"  # stops halfway with an error
    SILENT = "silent"  # feedback no longer arrives


class SimulatedArm(BaseArm):
    """A simulated arm of six axes (an ideal stage) or four (the MG400's linkage).

    Parameters
    ----------
    axes : {4, 6}
    pose : (6,) float
        Pose at the start.
    speeds : Speeds
        Speeds until ``set_speed`` is called; without acceleration the speed is constant.
    time_scale : float
        Factor by which it moves faster than a real arm (``inf``: instantly).
    faults : iterable of SimulatedFault
        ``faults`` is a set that can be changed at any time. A change applies to later moves; SILENT applies at once.
    """

    def __init__(
        self,
        *,
        axes: int = 6,
        pose: Sequence[float] | np.ndarray = (300.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        speeds: Speeds = Speeds(100.0, 100.0, 1000.0, 1000.0),  # noqa: B008  (frozen)
        time_scale: float = 1.0,
        faults: tuple[SimulatedFault, ...] = (),
        name: str = "simulated arm",
    ) -> None:
        kinematics: Kinematics = StageKinematics() if axes == 6 else MG400
        if axes not in (4, 6):
            raise DeviceError(f"a simulated arm has 4 or 6 axes, not {axes}")
        self.name, self.axes, self.kinematics = name, axes, kinematics
        self.track = MotionTrack(kinematics, kinematics.inverse(np.asarray(pose, float)))
        self.faults = {SimulatedFault(fault) for fault in faults}
        self._speeds, self._scale = speeds, time_scale
        self._connected = self._enabled = False
        self._errors: list[tuple[float, str]] = []  # (from when, what)
        self._silent_since: float | None = None

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
        if error := self._error(time.monotonic()):
            raise DeviceError(f"{self.name}: {error}; call clear_error() first")
        self._enabled = True

    def disable(self) -> None:
        self._require_connected()
        self.track.stop(time.monotonic())
        self._enabled = False

    def clear_error(self) -> None:
        self._require_connected()
        self._errors.clear()

    def stop(self) -> None:
        self._require_connected()
        now_s = time.monotonic()
        self.track.stop(now_s)
        self._errors = [(since, text) for since, text in self._errors if since <= now_s]

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        self._require_connected()
        now_s = time.monotonic()
        told_s = self._newest_feedback_s(now_s)
        if now_s - told_s > max_age_s:
            raise StaleDataError(
                f"{self.name}: newest feedback is {now_s - told_s:.2f} s old (allowed {max_age_s:g} s); stop, then reconnect the arm"
            )
        return ArmState(
            self.track.pose(told_s), self.track.joints_deg(told_s), told_s, self._enabled, self.track.moving(told_s), self._error(told_s)
        )

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        self._require_speeds(linear_mm_s, angular_deg_s)
        self._speeds = Speeds(linear_mm_s, angular_deg_s, self._speeds.linear_mm_s2, self._speeds.angular_deg_s2)

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        with self._watch_move():
            sent = self.kinematics.nearest_pose(finite_numbers(f"{self.name}: the pose", pose, 6))
            self._move(sent, linear=True, wait=wait, settled=sent, timeout_s=timeout_s)
        return sent

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        with self._watch_move():
            sent = joint_target(self.name, joints_deg, self.axes)
            self._move(sent, linear=False, wait=wait, settled=self.kinematics.forward(sent), timeout_s=timeout_s)
        return sent

    def _move(self, end: np.ndarray, *, linear: bool, wait: bool, settled: np.ndarray, timeout_s: float) -> None:
        self._require_connected()
        now_s = time.monotonic()
        if error := self._error(now_s):
            raise DeviceError(f"{self.name}: {error}; call clear_error(), then enable()")
        if not self._enabled:
            raise DeviceError(f"{self.name}: not enabled; call enable() first")
        if SimulatedFault.IGNORE not in self.faults:
            self._begin(end, linear, now_s)
        if wait:
            self._wait_until_settled(settled, timeout_s=timeout_s)

    def _begin(self, end: np.ndarray, linear: bool, now_s: float) -> None:
        factor = self._scale * (SLOW_FACTOR if SimulatedFault.SLOW in self.faults else 1.0)
        piece = self.track.move(end, self._speeds.scale_time(factor), linear=linear, now_s=now_s)
        if isinstance(piece, Violation):
            raise DeviceError(f"{self.name}: refused (alarm {piece.code}): {piece.text}; choose a target within reach and limits")
        halfway_s = piece.start_s + STALL_AFTER * piece.duration_s
        if self.faults & {SimulatedFault.STALL, SimulatedFault.COLLIDE}:
            self.track.stop(halfway_s)
        if SimulatedFault.COLLIDE in self.faults:
            self._errors.append((halfway_s, "collision (alarm 112); free the arm"))

    def _error(self, time_s: float) -> str:
        return next((text for since, text in self._errors if since <= time_s), "")

    def _newest_feedback_s(self, now_s: float) -> float:
        """Time of the newest feedback: now, unless the fault SILENT is on."""
        self._silent_since = (self._silent_since or now_s) if SimulatedFault.SILENT in self.faults else None
        return self._silent_since or now_s
