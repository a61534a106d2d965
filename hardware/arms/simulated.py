"""A simulated arm with the same protocol as real arms. Its moves take time."""

import time
from collections.abc import Sequence

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S, ArmState, KinematicArm
from hardware.arms.kinematics import MG400, StageKinematics, Violation
from hardware.arms.motion import MotionTrack, Piece, Speeds
from hardware.errors import DeviceError


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
        self.kinematics = StageKinematics() if axes == 6 else MG400
        self.track = MotionTrack(self.kinematics, self.kinematics.inverse(np.asarray(pose, float)))
        self._speeds, self._scale = Speeds(100.0, 100.0, 1000.0, 1000.0), time_scale
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

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        self._require_speeds(linear_mm_s, angular_deg_s)
        self._speeds = Speeds(linear_mm_s, angular_deg_s, self._speeds.linear_mm_s2, self._speeds.angular_deg_s2)

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

    def _begin(self, joints: np.ndarray, pose: np.ndarray | None) -> Piece:
        end, speeds = joints if pose is None else pose, self._speeds.scale_time(self._scale)
        piece = self.track.move(end, speeds, linear=pose is not None, now_s=time.monotonic())
        if isinstance(piece, Violation):
            raise DeviceError(f"{self.name}: refused (alarm {piece.code}): {piece.text}; choose a target within reach and limits")
        return piece
