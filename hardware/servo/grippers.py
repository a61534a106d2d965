"""Parallel grippers behind one small protocol: at a digital output, behind ROS 2, in a scene, or of another package."""

import time
from typing import Protocol

import numpy as np

from hardware.arms.arm import POLL_S, Arm
from hardware.arms.mg400 import MG400
from hardware.arms.ros2 import CONNECT_S, topic_in
from hardware.errors import DeviceError
from hardware.ros2.dds import Participant, Writer
from hardware.safety.safe_arm import SafeArm
from scenes.files import quote
from scenes.plugins import others
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs
from twin.records import ros2_messages as ros

POSITIONS = "std_msgs/Float64MultiArray"
GRIPPER_FORMS = "output:N,OPEN_MM,CLOSED_MM (a digital output of an MG400), ros2:TOPIC[,JOINTS]"


class Gripper(Protocol):
    """A parallel gripper. It is connected with the arm."""

    name: str

    @property
    def width_mm(self) -> float:
        """The width that was commanded last."""

    def move(self, width_mm: float) -> None:
        """Open or close to a width, as near to it as the gripper can. It returns at once."""


class OutputGripper:
    """A gripper that is open or closed, at a digital output of an MG400.

    Parameters
    ----------
    arm : MG400 or SafeArm
    output : int
        Number of the output; its level is 1 while the gripper is closed.
    open_mm, closed_mm : float
        Its two widths. A width nearer to ``closed_mm`` closes it.
    """

    def __init__(self, arm: Arm, output: int, *, open_mm: float, closed_mm: float) -> None:
        device = arm.arm if isinstance(arm, SafeArm) else arm
        if not isinstance(device, MG400):
            raise DeviceError(f"{arm.name}: has no digital outputs for a gripper; give an MG400")
        self.name, self.width_mm = f"gripper at output {output} of {arm.name}", open_mm
        self._arm, self._output, self._widths = device, output, (open_mm, closed_mm)

    def move(self, width_mm: float) -> None:
        self.width_mm = min(self._widths, key=lambda width: abs(width - width_mm))
        self._arm.set_output(self._output, self.width_mm == self._widths[1])


class Ros2Gripper:
    """A gripper whose controller takes positions of its joints from a topic, as ``forward_command_controller`` does. It connects at a move.

    Parameters
    ----------
    topic : str
        Topic of ``std_msgs/Float64MultiArray``.
    joints : int
        Number of joints, m, that share the width equally: 1 if the controller takes the width itself, 2 for two fingers.
    """

    def __init__(self, topic: str, joints: int = 1) -> None:
        self._topic, self._joints, self.width_mm = topic_in("", topic), joints, float("nan")
        self.name = f"ROS 2 gripper at {self._topic}"
        self._writer: Writer | None = None

    def move(self, width_mm: float) -> None:
        self._writer = self._writer or Participant().writer(self._topic, POSITIONS)
        until_s = time.monotonic() + CONNECT_S
        while not self._writer.heard:
            if time.monotonic() > until_s:
                raise DeviceError(f"{self.name}: nobody takes {POSITIONS} there; start its controller, or name its topic of commands")
            time.sleep(POLL_S)
        self._writer.write(ros.encode(POSITIONS, {"data": np.full(self._joints, width_mm / ros.MM_PER_M / self._joints)}), time.time_ns())
        self.width_mm = width_mm


def open_gripper(text: str, arm: Arm, sensor: SensorSpec) -> Gripper:
    """A gripper from its specification: one of ``GRIPPER_FORMS``, or ``NAME:REST`` of a plug-in (``scenes.plugins``).

    Raises
    ------
    DeviceError
        The specification is not understood, or the arm has no outputs.
    """
    kind, _, rest = text.partition(":")
    if kind in (there := others("grippers", ("output", "ros2"))):
        gripper: Gripper = there[kind](rest, sensor)
        return gripper
    first, *numbers = rest.split(",")
    with ErrorsAs(ValueError, lambda _: DeviceError(f"no gripper '{quote(text)}'; there are: {', '.join((GRIPPER_FORMS, *there))}")):
        if kind == "output":
            open_mm, closed_mm = map(float, numbers)
            return OutputGripper(arm, int(first), open_mm=open_mm, closed_mm=closed_mm)
        if kind == "ros2":
            (joints,) = map(int, numbers or ["1"])
            return Ros2Gripper(first, joints)
        raise ValueError(kind)
