"""The interface of ``cri``, with which scripts written for ``cri`` drive our arms. Only their imports change:

    from hardware.arms.cri import SyncRobot, MG400Controller as Controller

    with SyncRobot(Controller()) as robot:
        robot.coord_frame = (300, 0, 0, -180, 0, 0)
        robot.move_linear((0, 0, 0, 0, 0, 0))

``cri`` is the robot interface of the group that made the sensor. Its modules ``cri.robot``, ``cri.controller`` and ``cri.transforms`` have
the same names here.
"""

from hardware.arms.cri.controller import Controller, DummyController, MagicianController, MG400Controller, RobotController
from hardware.arms.cri.robot import AsyncBusy, AsyncNotBusy, AsyncRobot, InvalidJointAngles, SyncRobot
from hardware.arms.cri.transforms import EULER_AXES, InvalidEulerAxes, InvalidEulerPose
