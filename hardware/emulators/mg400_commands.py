"""The commands of the emulated MG400 for each of its ports, with their parameters and replies."""

import math
import re
from collections.abc import Callable, Iterable

import numpy as np

from hardware.arms.mg400_wire import ErrorId
from hardware.arms.motion import Speeds
from hardware.emulators.mg400_controller import Mg400Controller, Order, PlanarFrame
from hardware.emulators.mg400_grammar import Parameter, RefusedError, Request, keyword_number, read_numbers

# A coordinate or an angle of any size.
NUMBER = Parameter()
# A speed or an acceleration, percent.
PERCENT = Parameter(integer=True, low=1, high=100)
# Ratio of continuous-path blending, percent.
RATIO = Parameter(integer=True, low=0, high=100)
# Number of a user or tool frame.
INDEX = Parameter(integer=True, low=0, high=9)
# Mass at the tool, kg.
LOAD_KG = Parameter(low=0.0, high=0.5)
# Number of a digital output.
OUTPUT = Parameter(integer=True, low=1, high=24)
# Level of a digital output.
BIT = Parameter(integer=True, low=0, high=1)
# Names of the directions of a jog.
AXES = {f"{axis}{sign}" for axis in ("j1", "j2", "j3", "j4", "x", "y", "z", "r") for sign in "+-"}
# Number of servos. GetErrorID replies with the controller's alarms, followed by those of each servo.
SERVOS_N = 4

Command = Callable[[Request], str]


class Mg400Commands:
    """Commands of the dashboard port and of the motion port, for one version of the firmware.

    Parameters
    ----------
    controller : Mg400Controller
    firmware : tuple of int
    """

    def __init__(self, controller: Mg400Controller, firmware: tuple[int, ...]) -> None:
        self.arm, self.firmware = controller, firmware
        arm = controller
        self.dashboard: dict[str, Command] = {
            "enablerobot": self._enable,
            "disablerobot": self._plain(arm.disable),
            "clearerror": self._plain(arm.clear_error),
            "resetrobot": self._plain(arm.reset),
            "pause": self._plain(arm.pause),
            "continue": self._plain(arm.resume),
            "emergencystop": self._plain(arm.press_emergency_stop),
            "robotmode": self._plain(lambda: str(int(arm.mode()))),
            "getangle": self._plain(lambda: _text(self._joints())),
            "getpose": self._get_pose,
            "geterrorid": self._plain(self._error_ids),
            "setcollisionlevel": lambda request: self._only_check(request, Parameter(integer=True, low=0, high=5)),
            "user": lambda request: self._select(request, "user", arm.users),
            "tool": lambda request: self._select(request, "tool", arm.tools),
            "positivesolution": self._forward,
            "inversesolution": self._inverse,
            "do": self._output,
            "doexecute": self._output,
            **{key: self._percentage for key in arm.percent},
        }
        if firmware >= (1, 6):
            self.dashboard["setuser"] = lambda request: self._define(request, arm.users)
            self.dashboard["settool"] = lambda request: self._define(request, arm.tools)
        self.motion: dict[str, Command] = {
            "movj": lambda request: self._to_pose(request, linear=False),
            "movl": lambda request: self._to_pose(request, linear=True),
            "jointmovj": lambda request: self._to_joints(request, relative=False),
            "reljointmovj": lambda request: self._to_joints(request, relative=True),
            "movejog": self._jog,
            **{f"relmov{kind}{frame}": self._relative for kind in "jl" for frame in ("user", "tool", "")},
            "sync": self._plain(lambda: ""),  # the server sends the reply when the queue is empty
            "syncall": self._plain(lambda: ""),
        }

    def _plain(self, action: Callable[[], str | None]) -> Command:
        def run(request: Request) -> str:
            read_numbers(request, (), (0,))
            return action() or ""

        return run

    def _enable(self, request: Request) -> str:
        load = read_numbers(request, (LOAD_KG, NUMBER, NUMBER, NUMBER), (0, 1, 4))
        self.arm.enable()
        kg, x_mm, y_mm, z_mm = load + [0.0] * (4 - len(load))
        self.arm.load = kg, x_mm, y_mm, z_mm
        return ""

    def _percentage(self, request: Request) -> str:
        (self.arm.percent[request.name],) = read_numbers(request, (RATIO if request.name == "cp" else PERCENT,), (1,))
        return ""

    def _only_check(self, request: Request, parameter: Parameter) -> str:
        read_numbers(request, (parameter,), (1,))
        return ""

    def _select(self, request: Request, attribute: str, frames: dict) -> str:
        (index,) = read_numbers(request, (INDEX,), (1,))
        self._frame(frames, index)
        setattr(self.arm, attribute, int(index))
        return ""

    def _define(self, request: Request, frames: dict) -> str:
        if len(request.values) != 2:
            raise RefusedError(ErrorId.PARAMETER_COUNT)
        try:
            index, values = int(request.values[0]), [float(text) for text in request.values[1].strip("{}").split(",")]
        except ValueError as error:
            raise RefusedError(ErrorId.PARAMETER_TYPE - 2) from error
        whole = len(values) in (4, 6) and all(map(math.isfinite, values))
        if not 1 <= index <= 9 or not whole:  # frame 0 cannot be changed
            raise RefusedError(ErrorId.PARAMETER_RANGE - (1 if whole else 2))
        x, y, z = values[:3]
        frames[index] = PlanarFrame(x, y, z, values[3] if len(values) == 4 else values[5])
        return ""

    def _output(self, request: Request) -> str:
        index, level = (int(value) for value in read_numbers(request, (OUTPUT, BIT), (2,)))
        bit = 1 << (index - 1)
        self.arm.digital_out = self.arm.digital_out | bit if level else self.arm.digital_out & ~bit
        return ""

    def _error_ids(self) -> str:
        self.arm.update()
        groups = int(self.arm.faults.value("error-groups") or 1 + SERVOS_N)
        return "[" + ",".join([str(self.arm.alarms).replace(" ", ""), *["[]"] * (groups - 1)]) + "]"

    def _joints(self) -> np.ndarray:
        return self.arm.track.joints_deg(self.arm.update())

    def _get_pose(self, request: Request) -> str:
        read_numbers(request, (), (0,))
        if request.keywords and self.firmware >= (1, 7):
            raise RefusedError(ErrorId.PARAMETER_TYPE - 1)
        pose = self._seen(PlanarFrame.of_pose(self.arm.track.pose(self.arm.update())), *self._frames(request))
        return _text([*pose, 0.0, 0.0] if "six-value-pose" in self.arm.faults else pose)

    def _forward(self, request: Request) -> str:
        *joints, user, tool = read_numbers(request, (NUMBER,) * 4 + (INDEX,) * 2, (6,))
        if self.arm.kinematics.violation(np.array(joints)):
            raise RefusedError(ErrorId.FAILED)
        flange = PlanarFrame.of_pose(self.arm.kinematics.forward(np.array(joints)))
        return _text(self._seen(flange, self._frame(self.arm.users, user), self._frame(self.arm.tools, tool)))

    def _inverse(self, request: Request) -> str:
        if len(request.values) not in (6, 7, 8):  # two optional parameters select the solution near given joints; here there is only one
            raise RefusedError(ErrorId.PARAMETER_COUNT)
        *pose, user, tool = read_numbers(Request(request.name, request.values[:6], {}, request.text), (NUMBER,) * 4 + (INDEX,) * 2, (6,))
        joints = self.arm.joints_at(self._flange(pose, self._frame(self.arm.users, user), self._frame(self.arm.tools, tool)))
        if self.arm.kinematics.violation(joints):
            raise RefusedError(ErrorId.FAILED)
        return _text(joints)

    def _to_pose(self, request: Request, *, linear: bool) -> str:
        pose = read_numbers(request, (NUMBER,) * 4, (4,))
        self._order(self._flange(pose, *self._frames(request)), request, linear=linear)
        return ""

    def _relative(self, request: Request) -> str:
        """``RelMovLUser(dx, dy, dz, dr, user)`` and similar commands. The offset is along the axes of the user or tool frame."""
        values = read_numbers(request, (NUMBER,) * 4 + (INDEX,), (4, 5))
        offset, index = PlanarFrame(*values[:4]), int(values[4]) if len(values) == 5 else None
        last = self.arm.last_target()
        if request.name.endswith("tool"):
            tool = self._frame(self.arm.tools, self.arm.tool if index is None else index)
            end = last @ tool @ offset @ tool.inverse()
        else:
            turn = PlanarFrame(r=self._frame(self.arm.users, self.arm.user if index is None else index).r)
            along = turn @ offset
            end = PlanarFrame(last.x + along.x, last.y + along.y, last.z + along.z, last.r + offset.r)
        self._order(end, request, linear=request.name[6] == "l")
        return ""

    def _order(self, flange: PlanarFrame, request: Request, *, linear: bool) -> None:
        speeds = self._speeds(request, "l" if linear else "j")
        if linear:
            self.arm.order(Order(flange.pose, True, speeds))
            return
        try:
            self.arm.order(Order(self.arm.joints_at(flange), False, speeds))
        except RefusedError:
            self.arm.order(Order(flange.pose, True, speeds))  # the target is out of reach, and planning raises the alarm

    def _to_joints(self, request: Request, *, relative: bool) -> str:
        joints = np.array(read_numbers(request, (NUMBER,) * 4, (4,)))
        if relative:
            joints = joints + self.arm.last_joints_deg()
        self.arm.order(Order(joints, False, self._speeds(request, "j")))
        return ""

    def _jog(self, request: Request) -> str:
        if not request.values:
            self.arm.reset()
            return ""
        axis = request.values[0].lower().replace(" ", "")
        if axis not in AXES:
            raise RefusedError(ErrorId.PARAMETER_RANGE - 1)
        self.arm.jog(axis, user=self._frames(request)[0])
        return ""

    def _speeds(self, request: Request, kind: str) -> Speeds:
        speed = keyword_number(request, f"speed{kind}", PERCENT, self.arm.percent[f"speed{kind}"])
        acceleration = keyword_number(request, f"acc{kind}", PERCENT, self.arm.percent[f"acc{kind}"])
        keyword_number(request, "cp", RATIO, self.arm.percent["cp"])  # only the value is checked: the emulator does not blend moves
        return self.arm.speeds(speed, acceleration)

    def _frames(self, request: Request) -> tuple[PlanarFrame, PlanarFrame]:
        user = keyword_number(request, "user", INDEX, self.arm.user)
        tool = keyword_number(request, "tool", INDEX, self.arm.tool)
        return self._frame(self.arm.users, user), self._frame(self.arm.tools, tool)

    @staticmethod
    def _frame(frames: dict, index: float) -> PlanarFrame:
        if int(index) not in frames:
            raise RefusedError(ErrorId.FAILED)
        return frames[int(index)]

    @staticmethod
    def _flange(pose: list[float], user: PlanarFrame, tool: PlanarFrame) -> PlanarFrame:
        return user @ PlanarFrame(*pose) @ tool.inverse()

    @staticmethod
    def _seen(flange: PlanarFrame, user: PlanarFrame, tool: PlanarFrame) -> list[float]:
        return list((user.inverse() @ flange @ tool).pose[[0, 1, 2, 5]])


def _text(values: Iterable[float]) -> str:
    return ",".join(f"{value:.6f}" for value in values)


def parse_firmware(text: str) -> tuple[int, ...]:
    """``1.7.0`` as (1, 7, 0); ``ValueError`` if it is no version."""
    if not re.fullmatch(r"\d+(\.\d+)*", text):
        raise ValueError(f"'{text}' is no firmware version; for example 1.7.0")
    return tuple(int(part) for part in text.split("."))
