"""An arm and a camera with the interfaces that LeRobot expects of a robot and a camera. LeRobot itself is not imported."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hardware.arms.arm import Arm, NewestTarget
from hardware.arms.open_arm import kind_of, open_arm
from hardware.cameras.source import FrameSource, open_camera
from hardware.errors import Connection, DeviceError, StaleDataError, on_error
from hardware.live.doctor import cameras
from hardware.safety.decide import load_limits
from hardware.safety.safe_arm import SafeArm
from scenes import SensorSpec, load_sensor
from twin.errors import ErrorsAs
from twin.frames.forms import frame_size
from twin.types import Form, Frame

_POSE = ("x", "y", "z", "rx", "ry", "rz")
# Largest age in ms of a picture that LeRobot's cameras return.
MAX_AGE_MS = 500.0


class LeRobotCamera(Connection):
    """A frame source with the interface of LeRobot's cameras. Its pictures are (H, W, 3), also those of a gray camera.

    Parameters
    ----------
    source : FrameSource
    fps, width, height : int, optional
        Rate and size of the pictures, for callers that need them before the camera is connected. By default they come from the source and
        its sensor. Without a sensor the size is known only after the first picture.
    """

    def __init__(self, source: FrameSource, *, fps: int | None = None, width: int | None = None, height: int | None = None) -> None:
        self._source = source
        spec: SensorSpec | None = getattr(source, "_spec", None)
        known = frame_size(spec, source.form) if spec is not None else (None, None)
        self.fps = fps if fps is not None else round(getattr(source, "fps", 0.0)) or None
        self.width = width if width is not None else known[0]
        self.height = height if height is not None else known[1]

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
            self._picture(self._source.read(timeout_s=self._source.first_frame_s))

    def read(self) -> np.ndarray:
        """The next image (H, W, 3), uint8 RGB."""
        return self._picture(self._source.read())

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest image that was not read yet; ``TimeoutError`` if none comes in time."""
        return self._picture(self._source.read(timeout_s=timeout_ms / 1e3))

    def read_latest(self, max_age_ms: float = MAX_AGE_MS) -> np.ndarray:
        """The newest image; ``TimeoutError`` if it is older than ``max_age_ms``."""
        with ErrorsAs(StaleDataError, lambda error: TimeoutError(str(error))):
            return self._picture(self._source.read_latest(max_age_s=max_age_ms / 1e3))

    def disconnect(self) -> None:
        """Close the camera."""
        self._source.disconnect()

    def _picture(self, frame: Frame) -> np.ndarray:
        image = frame.image if frame.image.ndim == 3 else np.repeat(frame.image[..., None], 3, axis=2)
        self.height, self.width = image.shape[:2]
        return image


@dataclass(kw_only=True)
class LeRobotArmConfig:
    """The configuration from which LeRobot's scripts make a robot.

    Attributes
    ----------
    arm : str
        As ``open_arm`` takes it.
    limits : str or None
        Name or file of the safety limits to which actions are clipped. None: the limits of this kind of arm.
    cameras : dict of str to str
        For each camera its name, and its specification as ``open_camera`` takes it.
    sensor : str or None
        Name or file of the sensor that the cameras belong to. LeRobot asks for the size of the pictures before it connects a camera, and
        the sensor's specification gives this size.
    max_age_ms : float
        Largest age of a picture in an observation. LeRobot's own limit is the default; slow cameras need more.
    linear_mm_s, angular_deg_s : float
        Speed of the arm. The limits may reduce it.
    id : str or None
        Name that distinguishes robots of the same kind.
    calibration_dir : Path or None
        LeRobot expects this attribute. It is not used, because these arms need no calibration.
    """

    arm: str = "simulated"
    limits: str | None = None
    cameras: dict[str, str] = field(default_factory=dict)
    sensor: str | None = None
    max_age_ms: float = MAX_AGE_MS
    linear_mm_s: float = 100.0
    angular_deg_s: float = 90.0
    id: str | None = None
    calibration_dir: Path | None = None

    @property
    def type(self) -> str:
        """The kind of the robot."""
        return kind_of(self.arm)


class LeRobotArm(Connection):
    """An arm for LeRobot's scripts: observations and actions are dicts of floats, in mm and deg.

    Parameters
    ----------
    arm : Arm or LeRobotArmConfig
        With a ``SafeArm`` or a configuration, actions are clipped to the limits. ``send_action`` returns the action that was really sent.
    id : str, optional
    cameras : mapping of str to LeRobotCamera
        Cameras that are connected and read together with the arm.
    linear_mm_s, angular_deg_s : float
        Speed of the arm. The limits of a ``SafeArm`` may reduce it.
    """

    config_class = LeRobotArmConfig
    name = "twin_arm"

    def __init__(
        self,
        arm: Arm | LeRobotArmConfig,
        *,
        id: str | None = None,
        cameras: Mapping[str, LeRobotCamera] | None = None,
        linear_mm_s: float = 100.0,
        angular_deg_s: float = 90.0,
    ) -> None:
        self._max_age_ms = arm.max_age_ms if isinstance(arm, LeRobotArmConfig) else MAX_AGE_MS
        if isinstance(arm, LeRobotArmConfig):
            config, arm = arm, SafeArm(open_arm(arm.arm), load_limits(arm.limits or kind_of(arm.arm)))
            id, linear_mm_s, angular_deg_s = config.id, config.linear_mm_s, config.angular_deg_s
            spec = None if config.sensor is None else load_sensor(config.sensor)
            cameras = {name: LeRobotCamera(open_camera(text, spec, Form.RAW)) for name, text in config.cameras.items()}
        self.arm, self.id = arm, id
        self.name = self.robot_type = type(arm.arm if isinstance(arm, SafeArm) else arm).__name__.lower()
        self.cameras = dict(cameras or {})
        self.calibration: dict[str, Any] = {}
        self._speed = (linear_mm_s, angular_deg_s)
        if isinstance(arm, SafeArm):
            self._speed = min(linear_mm_s, arm.limits.linear_mm_s), min(angular_deg_s, arm.limits.angular_deg_s)
        self._newest = NewestTarget(arm, *self._speed)
        self._keys = _POSE if arm.axes == 6 else tuple(key for key in _POSE if key not in ("rx", "ry"))

    def __str__(self) -> str:
        return f"{self.id} {type(self).__name__}"

    @property
    def observation_features(self) -> dict[str, Any]:
        """The type of each number, and the shape (H, W, 3) of each camera's pictures."""
        joints: dict[str, Any] = {f"joint_{n}.pos": float for n in range(1, self.arm.axes + 1)}
        return {key: float for key in self._keys} | joints | {name: self._shape(name) for name in self.cameras}

    @property
    def action_features(self) -> dict[str, type]:
        """Name and type of each value of an action."""
        return {key: float for key in self._keys}

    @property
    def is_connected(self) -> bool:
        return self.arm.is_connected and all(camera.is_connected for camera in self.cameras.values())

    @property
    def is_calibrated(self) -> bool:
        """Always true: these arms know the zeros of their joints (a Magician after homing)."""
        return True

    def calibrate(self) -> None:
        """There is nothing to calibrate."""

    def configure(self) -> None:
        """Set the speed."""
        self.arm.set_speed(*self._speed)

    def connect(self, calibrate: bool = True) -> None:
        """Connect and enable the arm, and connect the cameras. ``calibrate`` has no effect."""
        self.arm.connect()
        with on_error(self.disconnect):
            self.arm.enable()
            self.configure()
            for camera in self.cameras.values():
                camera.connect()
        self._newest.start()

    def get_observation(self) -> dict[str, Any]:
        """Pose and joints in mm and deg, and each camera's newest picture."""
        state = self.arm.state()
        pose = dict(zip(_POSE, state.pose.tolist(), strict=True))
        joints = {f"joint_{n}.pos": float(q) for n, q in enumerate(state.joints_deg, start=1)}
        pictures = {name: camera.read_latest(self._max_age_ms) for name, camera in self.cameras.items()}
        return {key: pose[key] for key in self._keys} | joints | pictures

    def send_action(self, action: Mapping[str, Any]) -> dict[str, float]:
        """Send the arm towards a pose, without waiting. A missing key keeps its present value. An observation can serve as an action.

        Only the newest action counts. The arm moves in short pieces, and turns to a newer action after at most 0.2 s without executing the
        older ones. An action beyond the limits of a ``SafeArm`` is clipped to them. Returns the pose that was really sent to the arm: the
        pose of the action, or the end of the present piece on the path to it.
        """
        unknown = set(action) - set(_POSE) - set(self.observation_features)
        if unknown:
            raise KeyError(f"an action has the keys {', '.join(self._keys)}, not {', '.join(sorted(unknown))}")
        asked = {key: float(action[key]) for key in _POSE if key in action}
        pose = dict(zip(_POSE, self.arm.state().pose.tolist(), strict=True)) | asked
        sent = self._newest.go(np.array([pose[key] for key in _POSE], float))
        return {key: float(value) for key, value in zip(_POSE, sent, strict=True) if key in self._keys}

    def disconnect(self) -> None:
        """Stop and disconnect the arm, and disconnect the cameras."""
        self._newest.end()
        try:
            self.arm.disconnect()
        finally:
            for camera in self.cameras.values():
                camera.disconnect()

    def _shape(self, name: str) -> tuple[int, int, int]:
        camera = self.cameras[name]
        if camera.height is None or camera.width is None:
            remedy = "name its sensor, or give its width and height"
            raise DeviceError(f"camera '{name}': its size is not known before it is connected; {remedy}")
        return camera.height, camera.width, 3
