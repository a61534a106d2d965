"""The interface of ``cri``, so that scripts written for it drive our arms. Only their imports change:

    from hardware.arms.cri import SyncRobot, MG400Controller as Controller

    with SyncRobot(Controller()) as robot:
        robot.coord_frame = (300, 0, 0, -180, 0, 0)
        robot.move_linear((0, 0, 0, 0, 0, 0))

``cri`` is the robot interface of the group that made the sensor.
"""

from collections.abc import Sequence
from types import TracebackType

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.arm import Arm
from hardware.arms.mg400 import MG400
from hardware.arms.mg400_wire import DEFAULT_HOSTS
from hardware.arms.open_arm import open_arm
from hardware.errors import DeviceError, leave

# Euler axes that cri knows: s for static, r for rotating axes, then their order.
EULER_AXES = tuple(
    frame + order for frame in "sr" for order in ("xyz", "xyx", "xzy", "xzx", "yzx", "yzy", "yxz", "yxy", "zxy", "zxz", "zyx", "zyz")
)


def pose_matrix(pose: np.ndarray, axes: str = "sxyz") -> np.ndarray:
    """(4, 4) of ``x, y, z`` in mm and three Euler angles in deg; axes as ``sxyz``: s static, r rotating."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(_scipy_axes(axes), np.asarray(pose, float)[3:], degrees=True).as_matrix()
    T[:3, 3] = np.asarray(pose, float)[:3]
    return T


def matrix_pose(T: np.ndarray, axes: str = "sxyz") -> np.ndarray:
    """The reverse of ``pose_matrix``."""
    return np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_euler(_scipy_axes(axes), degrees=True)]


def _scipy_axes(axes: str) -> str:
    return axes[1:] if axes[0] == "s" else axes[1:].upper()


class Controller:
    """An arm with the interface of ``cri``. It is connected and enabled when it is made.

    Poses (4, 4) are those of the flange in the base frame.

    Parameters
    ----------
    arm : str or Arm
        A specification for ``open_arm``, or an arm that isn't connected yet.
    """

    def __init__(self, arm: str | Arm = "simulated") -> None:
        self.arm = open_arm(arm) if isinstance(arm, str) else arm
        self._linear, self._angular = 20.0, 20.0
        self._overall: float | None = None
        self._tilt_deg = np.zeros(2)  # last commanded tilt; poses are returned with it, as an arm of four axes does not report it
        self.commanded_pose: np.ndarray | None = None
        self.commanded_joint_angles: np.ndarray | None = None
        self.arm.connect()
        try:
            self.arm.clear_error()
            self.arm.enable()
            self._set_speeds()
        except BaseException:
            self.arm.disconnect()
            raise

    @property
    def info(self) -> str:
        return self.arm.name

    @property
    def linear_speed(self) -> float:
        """mm/s; on the MG400 % of its fastest."""
        return self._linear

    @linear_speed.setter
    def linear_speed(self, speed: float) -> None:
        self._linear = float(speed)
        self._set_speeds()

    @property
    def angular_speed(self) -> float:
        """deg/s; on the MG400 % of its fastest."""
        return self._angular

    @angular_speed.setter
    def angular_speed(self, speed: float) -> None:
        self._angular = float(speed)
        self._set_speeds()

    @property
    def speed(self) -> float | None:
        """% of everything on the MG400; other arms have no such thing."""
        return self._overall

    @speed.setter
    def speed(self, speed: float) -> None:
        if not isinstance(self.arm, MG400):
            raise DeviceError(f"{self.arm.name}: has no overall speed; set linear_speed and angular_speed")
        self.arm.set_speed_percent(overall=speed)
        self._overall = float(speed)

    @property
    def pose(self) -> np.ndarray:
        pose = self.arm.state().pose.copy()
        if self.arm.axes == 4:
            pose[3:5] = self._tilt_deg
        return pose_matrix(pose)

    @property
    def joint_angles(self) -> np.ndarray:
        return self.arm.state().joints_deg

    def move_linear(self, T_base_flange: np.ndarray) -> None:
        pose = matrix_pose(T_base_flange)
        self.arm.move_linear(pose)
        self.commanded_pose, self._tilt_deg = T_base_flange, pose[3:5]

    def move_joints(self, joint_angles: np.ndarray) -> None:
        self.commanded_joint_angles = self.arm.move_joints(np.asarray(joint_angles, float))

    def close(self) -> None:
        self.arm.disconnect()

    def _set_speeds(self) -> None:
        if isinstance(self.arm, MG400):
            self.arm.set_speed_percent(linear=self._linear, angular=self._angular)
        else:
            self.arm.set_speed(self._linear, self._angular)


class MG400Controller(Controller):
    """The MG400 at its address."""

    def __init__(self, ip: str = DEFAULT_HOSTS["LAN1"]) -> None:
        super().__init__(MG400(ip))


class SyncRobot:
    """An arm with a tool and a work frame; poses are 6-tuples in mm and deg.

    As in ``cri``, the flange goes to ``coord_frame * pose * tcp``: ``tcp`` is where the flange sits seen from the tool's tip.
    """

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self._axes = "sxyz"
        self._T_base_work = self._T_tip_flange = np.eye(4)

    def __enter__(self) -> "SyncRobot":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None:
        leave(self.close, error)

    @property
    def info(self) -> str:
        return self.controller.info

    @property
    def axes(self) -> str:
        """Euler axes of all poses, ``sxyz`` unless set."""
        return self._axes

    @axes.setter
    def axes(self, axes: str) -> None:
        if axes not in EULER_AXES:
            raise DeviceError(f"no Euler axes '{axes}'; there are: {', '.join(EULER_AXES)}")
        self._axes = axes

    @property
    def tcp(self) -> np.ndarray:
        return matrix_pose(self._T_tip_flange, self._axes)

    @tcp.setter
    def tcp(self, tcp: Sequence[float]) -> None:
        self._T_tip_flange = self._matrix(tcp)

    @property
    def coord_frame(self) -> np.ndarray:
        return matrix_pose(self._T_base_work, self._axes)

    @coord_frame.setter
    def coord_frame(self, frame: Sequence[float]) -> None:
        self._T_base_work = self._matrix(frame)

    @property
    def linear_speed(self) -> float:
        return self.controller.linear_speed

    @linear_speed.setter
    def linear_speed(self, speed: float) -> None:
        self.controller.linear_speed = speed

    @property
    def angular_speed(self) -> float:
        return self.controller.angular_speed

    @angular_speed.setter
    def angular_speed(self, speed: float) -> None:
        self.controller.angular_speed = speed

    @property
    def speed(self) -> float | None:
        return self.controller.speed

    @speed.setter
    def speed(self, speed: float) -> None:
        self.controller.speed = speed

    @property
    def pose(self) -> np.ndarray:
        return self._seen(self.controller.pose)

    @property
    def target_pose(self) -> np.ndarray | None:
        """The pose last asked for, None if there was none."""
        commanded = self.controller.commanded_pose
        return None if commanded is None else self._seen(commanded)

    @property
    def joint_angles(self) -> np.ndarray:
        return self.controller.joint_angles

    @property
    def target_joint_angles(self) -> np.ndarray | None:
        return self.controller.commanded_joint_angles

    def move_linear(self, pose: Sequence[float]) -> None:
        self.controller.move_linear(self._T_base_work @ self._matrix(pose) @ self._T_tip_flange)

    def move_joints(self, joint_angles: np.ndarray) -> None:
        self.controller.move_joints(joint_angles)

    def close(self) -> None:
        self.controller.close()

    def _matrix(self, pose: Sequence[float]) -> np.ndarray:
        if len(pose) != 6:
            raise DeviceError(f"a pose has 6 numbers (x, y, z in mm and three angles in deg), got {len(pose)}")
        return pose_matrix(np.asarray(pose, float), self._axes)

    def _seen(self, T_base_flange: np.ndarray) -> np.ndarray:
        return matrix_pose(np.linalg.inv(self._T_base_work) @ T_base_flange @ np.linalg.inv(self._T_tip_flange), self._axes)
