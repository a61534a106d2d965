"""An arm and a camera with the interfaces that LeRobot expects of a robot and a camera. LeRobot itself is not imported."""

from functools import cached_property

import numpy as np

from hardware.arms.arm import Arm
from hardware.cameras.source import FrameSource
from hardware.doctor import cameras
from hardware.errors import StaleDataError
from hardware.newest import NewestTarget
from hardware.safe_arm import SafeArm

_POSE = ("x", "y", "z", "rx", "ry", "rz")


class LeRobotArm:
    """An arm for LeRobot's scripts: observations and actions are dicts of floats, in mm and deg.

    Parameters
    ----------
    arm : Arm
        Give a ``SafeArm`` to have actions clipped; ``send_action`` tells what was really sent.
    linear_mm_s, angular_deg_s : float
        Speed of the arm. The limits of a ``SafeArm`` may reduce it.
    """

    def __init__(self, arm: Arm, *, linear_mm_s: float = 100.0, angular_deg_s: float = 90.0) -> None:
        self.arm, self.name = arm, arm.name
        limits = arm.limits if isinstance(arm, SafeArm) else None
        self._speed = (linear_mm_s, angular_deg_s)
        if limits is not None:
            self._speed = min(linear_mm_s, limits.linear_mm_s), min(angular_deg_s, limits.angular_deg_s)
        self._newest = NewestTarget(arm, *self._speed)

    @cached_property
    def _keys(self) -> tuple[str, ...]:
        return _POSE if self.arm.axes == 6 else tuple(key for key in _POSE if key not in ("rx", "ry"))

    @property
    def observation_features(self) -> dict[str, type]:
        joints: dict[str, type] = {f"joint_{n}.pos": float for n in range(1, self.arm.axes + 1)}
        return {key: float for key in self._keys} | joints

    @property
    def action_features(self) -> dict[str, type]:
        return {key: float for key in self._keys}

    @property
    def is_connected(self) -> bool:
        return self.arm.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Always true: these arms know their joints' zeros (a Magician after it was homed)."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Connect and enable; there is nothing to calibrate."""
        self.arm.connect()
        try:
            self.arm.enable()
            self.arm.set_speed(*self._speed)
        except BaseException:
            self.arm.disconnect()
            raise
        self._newest.start()

    def get_observation(self) -> dict[str, float]:
        state = self.arm.state()
        pose = dict(zip(_POSE, state.pose.tolist(), strict=True))
        return {key: pose[key] for key in self._keys} | {f"joint_{n}.pos": float(q) for n, q in enumerate(state.joints_deg, start=1)}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Send the arm towards a pose and do not wait. A missing key keeps its present value.

        The newest action wins: the arm goes in short pieces and turns to a newer action after at most 0.2 s, without replaying older ones.
        An action beyond the limits of a ``SafeArm`` is clipped to them. Returns what was really sent to the arm: the pose of the action,
        or the end of the present piece on the way to it.
        """
        unknown = set(action) - set(_POSE)
        if unknown:
            raise KeyError(f"an action has the keys {', '.join(self._keys)}, not {', '.join(sorted(unknown))}")
        pose = dict(zip(_POSE, self.arm.state().pose.tolist(), strict=True)) | action
        sent = self._newest.go(np.array([pose[key] for key in _POSE], float))
        return {key: float(value) for key, value in zip(_POSE, sent, strict=True) if key in self._keys}

    def disconnect(self) -> None:
        self._newest.end()
        self.arm.disconnect()


class LeRobotCamera:
    """A frame source with ``connect``, ``read``, ``async_read``, ``read_latest`` and ``disconnect`` of LeRobot's cameras.

    Parameters
    ----------
    source : FrameSource
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source

    @property
    def is_connected(self) -> bool:
        return self._source.is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, str]]:
        """USB cameras of this machine."""
        return [{"type": "OpenCV", "id": device.node, "name": device.description} for device in cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera. With ``warmup`` wait for the first frame."""
        self._source.connect()
        if warmup:
            self._source.read(timeout_s=self._source.first_frame_s)

    def read(self) -> np.ndarray:
        """The next image (H, W) or (H, W, 3), uint8 RGB."""
        return self._source.read().image

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest image not read yet; ``TimeoutError``."""
        return self._source.read(timeout_s=timeout_ms / 1e3).image

    def read_latest(self, max_age_ms: float = 500) -> np.ndarray:
        """The newest image; ``TimeoutError`` if it is older."""
        try:
            return self._source.read_latest(max_age_s=max_age_ms / 1e3).image
        except StaleDataError as error:
            raise TimeoutError(str(error)) from error

    def disconnect(self) -> None:
        """Close the camera."""
        self._source.disconnect()
