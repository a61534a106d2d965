"""Robots with the interface of ``cri``: an arm with a tool and a work frame, poses in Euler angles.

``SyncRobot`` waits for each move; ``AsyncRobot`` has moves that go on while the program does something else.
"""

from collections.abc import Callable
from operator import attrgetter
from threading import Thread

import numpy as np

from hardware.arms.cri import transforms
from hardware.arms.cri.controller import NO_POSE, Closing, RobotController
from hardware.arms.cri.transforms import EULER_AXES, Numbers
from hardware.errors import DeviceError

# Numbers of joints that arms have.
FEWEST_JOINTS, MOST_JOINTS = 4, 7


class InvalidJointAngles(DeviceError, ValueError):  # noqa: N818  (cri's name)
    """No arm has that number of joints."""


class AsyncBusy(DeviceError):  # noqa: N818  (cri's name)
    """A move is in progress; call ``async_result`` first."""


class AsyncNotBusy(DeviceError):  # noqa: N818  (cri's name)
    """No move was started."""


def _of_controller(name: str) -> property:
    """A property of a robot that is its controller's property of this name."""
    return property(attrgetter(f"controller.{name}"), lambda robot, value: setattr(robot.controller, name, value))


class SyncRobot(Closing):
    """An arm with a tool and a work frame; poses are 6-tuples in mm and deg.

    As in ``cri``, the flange moves to ``coord_frame * pose * tcp``: ``tcp`` is the flange's pose in the frame of the tool's tip.

    Attributes
    ----------
    elbow, target_elbow : None
        Arms of four and six axes have no elbow.
    """

    EULER_AXES = EULER_AXES
    info = _of_controller("info")
    elbow = target_elbow = None

    def __init__(self, controller: RobotController) -> None:
        self.controller = controller
        self._axes = "sxyz"
        self._T_base_work = self._T_tip_flange = np.eye(4)

    @property
    def axes(self) -> str:
        """Euler axes of all poses, ``sxyz`` unless set."""
        return self._axes

    @axes.setter
    def axes(self, axes: str) -> None:
        transforms.require_axes(axes)
        self._axes = axes

    @property
    def tcp(self) -> np.ndarray:
        return transforms.mat2euler(self._T_tip_flange, self._axes)

    @tcp.setter
    def tcp(self, tcp: Numbers) -> None:
        self._T_tip_flange = transforms.euler2mat(tcp, self._axes)
        self.controller.tcp = np.array(NO_POSE)

    @property
    def tcp_controller(self) -> np.ndarray:
        """The controller's own tool (6,), whose pose the controller reports and commands."""
        return transforms.quat2euler(self.controller.tcp, self._axes)

    @tcp_controller.setter
    def tcp_controller(self, tcp: Numbers) -> None:
        self.controller.tcp = transforms.euler2quat(tcp, self._axes)

    @property
    def coord_frame(self) -> np.ndarray:
        """The work frame in the base frame (6,)."""
        return transforms.mat2euler(self._T_base_work, self._axes)

    @coord_frame.setter
    def coord_frame(self, frame: Numbers) -> None:
        self._T_base_work = transforms.euler2mat(frame, self._axes)

    linear_speed, angular_speed = _of_controller("linear_speed"), _of_controller("angular_speed")
    speed, blend_radius = _of_controller("speed"), _of_controller("blend_radius")
    # joints (J,), deg: the present ones, and those that were commanded last (None before the first move)
    joint_angles, target_joint_angles = _of_controller("joint_angles"), _of_controller("commanded_joint_angles")

    @property
    def pose(self) -> np.ndarray:
        return self._from_controller(self.controller.pose)

    @property
    def target_pose(self) -> np.ndarray | None:
        """The last requested pose; None before the first one."""
        commanded = self.controller.commanded_pose
        return None if commanded is None else self._from_controller(commanded)

    def move_joints(self, joint_angles: Numbers) -> None:
        if not FEWEST_JOINTS <= len(joint_angles) <= MOST_JOINTS:
            raise InvalidJointAngles(f"{len(joint_angles)} joint angles; expected as many as the arm has joints")
        self.controller.move_joints(joint_angles)

    def move_linear(self, pose: Numbers, elbow: float | None = None) -> None:
        self.controller.move_linear(self._to_controller(pose), elbow)

    def move_circular(self, via_pose: Numbers, end_pose: Numbers, elbow: float | None = None) -> None:
        """Along the circle through the present place, that of ``via_pose`` and that of ``end_pose``."""
        self.controller.move_circular(self._to_controller(via_pose), self._to_controller(end_pose), elbow)

    def close(self) -> None:
        self.controller.close()

    def _to_controller(self, pose: Numbers) -> np.ndarray:
        """The controller's pose (7,) for one (6,) in the work frame."""
        return transforms.mat2quat(self._T_base_work @ transforms.euler2mat(pose, self._axes) @ self._T_tip_flange)

    def _from_controller(self, pose: np.ndarray) -> np.ndarray:
        """The reverse of ``_to_controller``."""
        T = np.linalg.inv(self._T_base_work) @ transforms.quat2mat(pose) @ np.linalg.inv(self._T_tip_flange)
        return transforms.mat2euler(T, self._axes)


class AsyncRobot(SyncRobot):
    """A ``SyncRobot`` whose moves run while the program does something else: start a move, then ask for its result.

    Parameters
    ----------
    sync_robot : SyncRobot
        Its frames, tool and axes are used. It must not be used on its own any more.
    """

    def __init__(self, sync_robot: SyncRobot) -> None:
        super().__init__(sync_robot.controller)
        self.sync_robot = sync_robot
        self._axes, self._T_base_work, self._T_tip_flange = sync_robot._axes, sync_robot._T_base_work, sync_robot._T_tip_flange
        self._worker: Thread | None = None
        self._error: BaseException | None = None

    def async_move_joints(self, joint_angles: Numbers) -> None:
        """As `move_joints`, without waiting for the end."""
        self._begin(lambda: self.move_joints(joint_angles))

    def async_move_linear(self, pose: Numbers, elbow: float | None = None) -> None:
        """As `move_linear`, without waiting for the end."""
        self._begin(lambda: self.move_linear(pose, elbow))

    def async_move_circular(self, via_pose: Numbers, end_pose: Numbers, elbow: float | None = None) -> None:
        """As `move_circular`, without waiting for the end."""
        self._begin(lambda: self.move_circular(via_pose, end_pose, elbow))

    def async_result(self) -> None:
        """Wait for the end of the move; its error is raised here.

        Raises
        ------
        AsyncNotBusy
            No move was started.
        """
        self._require_move().join()
        self._worker, error = None, self._error
        if error is not None:
            raise error

    def async_done(self) -> bool:
        """Whether the move has ended; ``AsyncNotBusy`` if none was started."""
        return not self._require_move().is_alive()

    def close(self) -> None:
        """Stop the present move, and disconnect."""
        if self._worker is not None and self._worker.is_alive():
            self.controller.arm.stop()
            self._worker.join()
        super().close()

    def _require_move(self) -> Thread:
        if self._worker is None:
            raise AsyncNotBusy("no move was begun; call async_move_linear or its like first")
        return self._worker

    def _begin(self, move: Callable[[], None]) -> None:
        if self._worker is not None:
            raise AsyncBusy("a move goes on; call async_result first")
        self._error = None

        def work() -> None:
            try:
                move()
            except BaseException as error:
                self._error = error

        self._worker = Thread(target=work, name="cri move", daemon=True)
        self._worker.start()
