"""The commands of the emulated MG400 for each of its ports, with their parameters and replies."""

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import astuple, replace

import numpy as np

from hardware.arms.mg400_wire import ErrorId
from hardware.arms.motion import Speeds, circle
from hardware.emulators.mg400_controller import Mg400Controller, Order, PlanarFrame
from hardware.emulators.mg400_grammar import NUMBER, Parameter, RefusedError, Request, keyword_number, read_numbers, read_table, refuse_if

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
# Number of a digital input.
INPUT = Parameter(integer=True, low=1, high=16)
# Number of an input or output at the tool.
TOOL_PORT = Parameter(integer=True, low=1, high=2)
# Level of a digital output.
BIT = Parameter(integer=True, low=0, high=1)
# Number of whole circles.
LAPS = Parameter(integer=True, low=1, high=999)
# Distance of the load's centre from the flange's axis, mm.
CENTRE_MM = Parameter(low=-500.0, high=500.0)
# Time that the queue waits, ms.
WAIT_MS = Parameter(integer=True, low=1, high=3_600_000)
# Parameters of commands that have no effect here.
CHECKED = {"arch": INDEX, "limz": NUMBER, "loadswitch": BIT, "di": INPUT, "tooldi": TOOL_PORT} | {
    name: Parameter(integer=True, low=low, high=high) for name, low, high in (("setcollisionlevel", 0, 5), ("setarmorientation", -1, 1))
}
# Number of a joint.
JOINT = Parameter(integer=True, low=1, high=4)
# Numbers of Modbus slaves, of their registers, and of the values in one request. Slave 0 is the controller itself.
SLAVE, ADDRESS, VALUES = (Parameter(integer=True, low=low, high=high) for low, high in ((0, 4), (0, 65535), (1, 16)))
# Registers that a value of a type takes.
REGISTERS = {"U32": 2, "F32": 2, "F64": 4}
# Names of the directions of a jog.
AXES = {f"{axis}{sign}" for axis in ("j1", "j2", "j3", "j4", "x", "y", "z", "r") for sign in "+-"}
# Number of servos. GetErrorID replies with the controller's alarms, followed by those of each servo.
SERVOS_N = 4

Command = Callable[[Request], str | None]
"""A command, which returns the values of its reply; None if it has none."""


class Mg400Commands:
    """Commands of the dashboard port and of the motion port, for one version of the firmware.

    Parameters
    ----------
    controller : Mg400Controller
    firmware : tuple of int
    """

    def __init__(self, controller: Mg400Controller, firmware: tuple[int, ...]) -> None:
        self.arm, self.firmware = controller, firmware
        self._slaves: dict[int, dict[tuple[str, int], float]] = {0: {}}  # what each Modbus slave holds, by table and address
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
            "user": self._select,
            "tool": self._select,
            "positivesolution": self._forward,
            "inversesolution": self._inverse,
            **dict.fromkeys(("do", "doexecute", "dogroup"), self._output),
            **dict.fromkeys(("tooldo", "tooldoexecute"), self._tool_output),
            **dict.fromkeys(("setpayload", "payload"), self._payload),
            **dict.fromkeys(CHECKED, self._only_check),
            "startdrag": self._plain(lambda: arm.drag(True)),
            "stopdrag": self._plain(lambda: arm.drag(False)),
            **dict.fromkeys(arm.percent, self._percentage),
            "brakecontrol": self._brake,
            "runscript": self._run_script,
            **dict.fromkeys(("stopscript", "pausescript", "continuescript"), self._plain(lambda: None)),  # no project runs
            "modbuscreate": self._create_slave,
            "modbusclose": self._close_slave,
            **dict.fromkeys(("getcoils", "getinbits", "getinregs", "getholdregs", "setcoils", "setholdregs"), self._registers),
        }
        if firmware >= (1, 5, 9):
            self.dashboard["wait"] = self._wait
        if firmware >= (1, 6):
            self.dashboard |= {"setuser": self._define, "settool": self._define, "calcuser": self._calculate, "calctool": self._calculate}
        self.motion: dict[str, Command] = {
            **dict.fromkeys(("movj", "movl", "movlio", "movjio"), self._to_pose),
            "arc": self._arc,
            "circle": self._circle,
            **dict.fromkeys(("jointmovj", "reljointmovj"), self._to_joints),
            "movejog": self._jog,
            **{f"relmov{kind}{frame}": self._relative for kind in "jl" for frame in ("user", "tool", "")},
            "sync": self._plain(lambda: None),  # the server sends the reply when the queue is empty
            "syncall": self._plain(lambda: None),
        }

    def _plain(self, action: Callable[[], str | None]) -> Command:
        def run(request: Request) -> str | None:
            read_numbers(request, (), (0,))
            return action()

        return run

    def _enable(self, request: Request) -> None:
        load = read_numbers(request, (LOAD_KG, CENTRE_MM, CENTRE_MM, CENTRE_MM), (0, 1, 4))
        self.arm.enable()
        kg, x_mm, y_mm, z_mm = load + [0.0] * (4 - len(load))
        self.arm.load = kg, x_mm, y_mm, z_mm

    def _percentage(self, request: Request) -> None:
        (percent,) = read_numbers(request, (RATIO if request.name == "cp" else PERCENT,), (1,))
        if request.name == "speedfactor":
            self.arm.set_speed_factor(percent)
        else:
            self.arm.percent[request.name] = percent

    def _only_check(self, request: Request) -> str:
        counts = (1, 4) if request.name == "setarmorientation" else (1,)
        read_numbers(request, (CHECKED[request.name],) * counts[-1], counts)
        return "0" if request.name in ("di", "tooldi") else ""  # nothing is attached, so no input has a signal

    def _brake(self, request: Request) -> None:
        """The brakes of an enabled arm are not switched. An emulated arm does not sink, so a brake has no effect."""
        read_numbers(request, (JOINT, BIT), (2,))
        refuse_if(self.arm.enabled)

    def _run_script(self, request: Request) -> None:
        """There is no project on this controller."""
        raise RefusedError(ErrorId.FAILED if len(request.values) == 1 else ErrorId.PARAMETER_COUNT)

    def _create_slave(self, request: Request) -> str:
        """``ModbusCreate(ip,port,slave[,isRTU])``. Every address has a slave, which holds what is written to it."""
        refuse_if(len(request.values) not in (3, 4), ErrorId.PARAMETER_COUNT)
        free = [index for index in range(int(SLAVE.high) + 1) if index not in self._slaves]
        refuse_if(not free)
        self._slaves[free[0]] = {}
        return str(free[0])

    def _close_slave(self, request: Request) -> None:
        (index,) = read_numbers(request, (SLAVE,), (1,))
        refuse_if(self._slaves.pop(int(index), None) is None)

    def _registers(self, request: Request) -> str:
        """``GetHoldRegs(index,address,count[,type])``, ``SetHoldRegs(index,address,count,{values}[,type])``, and those of other tables."""
        writes, table = request.name[0] == "s", request.name[3:]
        refuse_if(len(request.values) - writes not in (3, 4), ErrorId.PARAMETER_COUNT)
        index, address, count = map(int, read_numbers(replace(request, values=request.values[:3]), (SLAVE, ADDRESS, VALUES), (3,)))
        refuse_if(index not in self._slaves)
        width = REGISTERS.get(request.values[-1].strip("{}'\"").upper(), 1)
        places = [(table, address + width * n) for n in range(count)]
        if writes:
            self._slaves[index] |= dict(zip(places, read_table(request.values[3], (count,), 4, most=np.inf), strict=True))
            return ""
        return ",".join(f"{self._slaves[index].get(place, 0.0):.15g}" for place in places)

    def _select(self, request: Request) -> None:
        (index,) = read_numbers(request, (INDEX,), (1,))
        self._frame(self._frames_named(request), index)
        setattr(self.arm, request.name, int(index))

    def _frames_named(self, request: Request) -> dict[int, PlanarFrame]:
        """The user or the tool frames, whichever a command is about."""
        return self.arm.users if request.name.endswith("user") else self.arm.tools

    def _frame_of(self, request: Request, first: int) -> PlanarFrame:
        """The frame ``{x,y,z,r}`` that begins at a parameter; its braces may be missing."""
        text, n = ",".join(request.values[first:]), first + 1
        values = read_table(text, (4, 6), n)
        x, y, z = values[:3]
        return PlanarFrame(x, y, z, values[3] if len(values) == 4 else values[5])

    def _define(self, request: Request) -> None:
        refuse_if(len(request.values) not in (2, 5, 7), ErrorId.PARAMETER_COUNT)
        frame = self._frame_of(request, 1)
        self._frames_named(request)[request.whole(0, INDEX)] = frame

    def _calculate(self, request: Request) -> str:
        """A frame after an offset along the base's axes (1) or along its own (0)."""
        refuse_if(len(request.values) not in (3, 6, 8), ErrorId.PARAMETER_COUNT)
        frame, offset = self._frame(self._frames_named(request), request.whole(0, INDEX)), self._frame_of(request, 2)
        along_base = request.whole(1, BIT)
        return _text(np.add(astuple(frame), astuple(offset)) if along_base else astuple(frame @ offset))

    def _payload(self, request: Request) -> None:
        kg = read_numbers(request, (LOAD_KG, NUMBER), (1, 2))[0]
        self.arm.load = kg, *self.arm.load[1:]

    def _wait(self, request: Request) -> None:
        times_ms = read_numbers(request, (WAIT_MS,), (0, 1))
        self.arm.order(Order(np.zeros(6), True, self.arm.speeds(100.0, 100.0), wait_s=(times_ms[0] if times_ms else 0.0) / 1000.0))

    def _output(self, request: Request) -> None:
        """``DO(index,level)``, which waits in the queue, ``DOExecute(index,level)`` and ``DOGroup(index,level,index,level,...)``."""
        count = len(request.values)
        refuse_if(count != 2 and (request.name != "dogroup" or not count or count % 2), ErrorId.PARAMETER_COUNT)
        values = [int(value) for value in read_numbers(request, (OUTPUT, BIT) * (count // 2), (count,))]
        if request.name == "do" and self.arm.busy():
            self.arm.order(Order(np.zeros(6), True, self.arm.speeds(100.0, 100.0), outputs=((0.0, values[0], values[1]),), wait_s=0.0))
            return
        for index, level in zip(values[::2], values[1::2], strict=True):
            self.arm.set_output(index, level)

    def _tool_output(self, request: Request) -> None:
        index, level = (int(value) for value in read_numbers(request, (TOOL_PORT, BIT), (2,)))
        bit = 1 << (index - 1)
        self.arm.tool_out = self.arm.tool_out | bit if level else self.arm.tool_out & ~bit

    def _error_ids(self) -> str:
        self.arm.update()
        groups = int(self.arm.faults.value("error-groups") or 1 + SERVOS_N)
        return "[" + ",".join([str(self.arm.alarms).replace(" ", ""), *["[]"] * (groups - 1)]) + "]"

    def _joints(self) -> np.ndarray:
        return self.arm.track.joints_deg(self.arm.update())

    def _get_pose(self, request: Request) -> str:
        read_numbers(request, (), (0,))
        refuse_if(request.keywords and self.firmware >= (1, 7), ErrorId.PARAMETER_TYPE - 1)
        pose = self._tool_in_user_frame(PlanarFrame.of_pose(self.arm.track.pose(self.arm.update())), *self._frames(request))
        return _text([*pose, 0.0, 0.0] if "six-value-pose" in self.arm.faults else pose)

    def _forward(self, request: Request) -> str:
        *joints, user, tool = read_numbers(request, (NUMBER,) * 4 + (INDEX,) * 2, (6,))
        refuse_if(self.arm.kinematics.violation(np.array(joints)))
        flange = PlanarFrame.of_pose(self.arm.kinematics.forward(np.array(joints)))
        return _text(self._tool_in_user_frame(flange, self._frame(self.arm.users, user), self._frame(self.arm.tools, tool)))

    def _inverse(self, request: Request) -> str:
        refuse_if(
            len(request.values) not in (6, 7, 8), ErrorId.PARAMETER_COUNT
        )  # two optional parameters select the solution near given joints; here there is only one
        *pose, user, tool = read_numbers(Request(request.name, request.values[:6], {}, request.text), (NUMBER,) * 4 + (INDEX,) * 2, (6,))
        joints = self.arm.joints_at(self._flange(pose, self._frame(self.arm.users, user), self._frame(self.arm.tools, tool)))
        refuse_if(self.arm.kinematics.violation(joints))
        return _text(joints)

    def _to_pose(self, request: Request) -> None:
        place, groups = self._split_outputs(request)
        pose = read_numbers(place, (NUMBER,) * 4, (4,))
        flange = self._flange(pose, *self._frames(request))
        length_mm = float(np.linalg.norm(flange.pose[:3] - self.arm.last_target().pose[:3]))
        outputs = tuple(self._on_the_way(text, n, length_mm) for n, text in enumerate(groups, start=5))
        self._order(flange, request, linear=request.name.startswith("movl"), outputs=outputs)

    @staticmethod
    def _split_outputs(request: Request) -> tuple[Request, tuple[str, ...]]:
        """A move and the outputs ``{Mode,Distance,Index,Status}`` that it sets on its path. Only moves with IO have outputs."""
        if not request.name.endswith("io"):
            return request, ()
        groups = tuple(value for value in request.values if value[0] in "{(")
        refuse_if(not groups, ErrorId.PARAMETER_COUNT)
        return replace(request, values=request.values[: len(request.values) - len(groups)]), groups

    @staticmethod
    def _on_the_way(text: str, n: int, length_mm: float) -> tuple[float, int, int]:
        """Share of the path at which an output is set, its index and its level."""
        mode, distance, index, level = read_table(text, (4,), n)
        share = distance / 100.0 if mode == 0 else distance / max(length_mm, 1e-9)
        refuse_if(
            mode not in (0, 1) or not -1.0 <= share <= 1.0 or not OUTPUT.low <= index <= OUTPUT.high or level not in (0, 1),
            ErrorId.PARAMETER_RANGE - n,
        )
        return share if share >= 0 else 1.0 + share, int(index), int(level)

    def _arc(self, request: Request) -> None:
        """``Arc(X1,Y1,Z1,R1,X2,Y2,Z2,R2)``: move along the circle through the present place and two others."""
        self._go_round(request, read_numbers(request, (NUMBER,) * 8, (8,)), laps=0)

    def _circle(self, request: Request) -> None:
        """``Circle(count,{X1,Y1,Z1,R1},{X2,Y2,Z2,R2})``, or in the form of the vendor's client: eight numbers and the count."""
        if len(request.values) == 3:
            laps = request.whole(0, LAPS)
            numbers = read_table(request.values[1], (4,), 2) + read_table(request.values[2], (4,), 3)
        else:
            *numbers, count = read_numbers(request, (NUMBER,) * 8 + (LAPS,), (9,))
            laps = int(count)
        self._go_round(request, numbers, laps=laps)

    def _go_round(self, request: Request, numbers: list[float], *, laps: int) -> None:
        """Queue the lines of an arc, or of whole circles. Places on one straight line are refused."""
        via, end = (self._flange(part, *self._frames(request)).pose for part in (numbers[:4], numbers[4:]))
        start = self.arm.last_target().pose
        poses = circle(start, via, end, whole=laps > 0)
        refuse_if(len(poses) == 2)
        speeds = replace(self._speeds(request, "l"), linear_mm_s2=np.inf, angular_deg_s2=np.inf)  # no stop between the lines
        for pose in poses * max(laps, 1):
            self.arm.order(Order(pose, True, speeds))

    def _relative(self, request: Request) -> None:
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

    def _order(self, flange: PlanarFrame, request: Request, *, linear: bool, outputs: tuple[tuple[float, int, int], ...] = ()) -> None:
        order = Order(flange.pose, True, self._speeds(request, "l" if linear else "j"), outputs=outputs)
        if not linear:
            with suppress(RefusedError):  # planning raises the alarm if the target is out of reach
                order = replace(order, end=self.arm.joints_at(flange), linear=False)
        self.arm.order(order)

    def _to_joints(self, request: Request) -> None:
        joints = np.array(read_numbers(request, (NUMBER,) * 4, (4,)))
        if request.name == "reljointmovj":
            joints = joints + self.arm.joints_at(self.arm.last_target())
        self.arm.order(Order(joints, False, self._speeds(request, "j")))

    def _jog(self, request: Request) -> None:
        if not request.values:
            self.arm.reset()
        elif (axis := request.values[0].lower().replace(" ", "")) not in AXES:  # the vendor's document: any other text stops a jog
            self.arm.stop_jog()
        else:
            self.arm.jog(axis, user=self._frames(request)[0])

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
        refuse_if(int(index) not in frames)
        return frames[int(index)]

    @staticmethod
    def _flange(pose: list[float], user: PlanarFrame, tool: PlanarFrame) -> PlanarFrame:
        return user @ PlanarFrame(*pose) @ tool.inverse()

    @staticmethod
    def _tool_in_user_frame(flange: PlanarFrame, user: PlanarFrame, tool: PlanarFrame) -> list[float]:
        return list((user.inverse() @ flange @ tool).pose[[0, 1, 2, 5]])


def _text(values: Iterable[float]) -> str:
    return ",".join(f"{value:.6f}" for value in values)


def parse_firmware(text: str) -> tuple[int, ...]:
    """``1.7.0`` as (1, 7, 0); ``ValueError`` if it is no version."""
    if not re.fullmatch(r"\d+(\.\d+)*", text):
        raise ValueError(f"'{text}' is no firmware version; for example 1.7.0")
    return tuple(int(part) for part in text.split("."))
