"""The emulated MG400's requests, ``Name(p1,p2,Key=v)``, which are found in a stream, and its commands with their parameters and replies."""

import math
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hardware.arms.mg400_wire import ErrorId
from hardware.arms.motion import Speeds, circle
from hardware.emulators.faults import Range
from hardware.emulators.mg400_controller import Mg400Controller, Order, PlanarFrame, RefusedError, refuse_if
from twin.errors import ErrorsAs

# Most characters of a request that is not complete. No command of the arm is nearly as long.
LONGEST_REQUEST = 4096
# Largest coordinate, mm, and angle, deg. A larger one counts as this one: no arm gets there either, and sums and products stay finite.
FARTHEST = 1e5
# A coordinate or an angle of any size.
NUMBER = Range(-np.inf, np.inf)
# A speed or an acceleration, and the ratio of continuous-path blending, percent.
PERCENT, RATIO = Range(1, 100, whole=True), Range(0, 100, whole=True)
# Numbers of a user or tool frame and of a joint.
INDEX, JOINT = Range(0, 9, whole=True), Range(1, 4, whole=True)
# Mass at the tool, kg, and distance of its centre from the flange's axis, mm.
LOAD_KG, CENTRE_MM = Range(0.0, 0.5), Range(-500.0, 500.0)
# Numbers of a digital output, of a digital input, and of those at the tool; and a level.
OUTPUT, INPUT, TOOL_PORT, BIT = (Range(low, high, whole=True) for low, high in ((1, 24), (1, 16), (1, 2), (0, 1)))
# Number of whole circles, and time that the queue waits, ms.
LAPS, WAIT_MS = Range(1, 999, whole=True), Range(1, 3_600_000, whole=True)
# A collision level, and a part of an arm's orientation.
LEVEL, SIDE = Range(0, 5, whole=True), Range(-1, 1, whole=True)
# A place with R, and the numbers of a user and a tool frame.
PLACE, PLACE_IN_FRAMES = (NUMBER,) * 4, (NUMBER,) * 4 + (INDEX,) * 2
# Numbers of Modbus slaves, of their registers, and of the values in one request. Slave 0 is the controller itself.
SLAVE, ADDRESS, VALUES = (Range(low, high, whole=True) for low, high in ((0, 4), (0, 65535), (1, 16)))
# Registers that a value of a type takes.
REGISTERS = {"U32": 2, "F32": 2, "F64": 4}
# Names of the directions of a jog.
AXES = {f"{axis}{sign}" for axis in ("j1", "j2", "j3", "j4", "x", "y", "z", "r") for sign in "+-"}
# Number of servos. GetErrorID replies with the controller's alarms, followed by those of each servo.
SERVOS_N = 4


@dataclass(frozen=True)
class Request:
    """One request: name in lower case, parameters, keywords in lower case, and the received text.

    A malformed request has no name, so it is no command.
    """

    name: str
    values: tuple[str, ...]
    keywords: dict
    text: str

    def whole(self, n: int, parameter: Range) -> int:
        """The whole number at a position of the values, from 0; raises as ``read_numbers``."""
        return int(_number(self.values[n], parameter, n + 1))


def take_request(buffer: str) -> tuple[Request | None, str]:
    """The first request in the received text (None if there is none), and the rest of the text.

    A request ends at its closing ``)``. It needs no newline. A request that is not closed ends at a newline, or when it is longer than
    ``LONGEST_REQUEST``. It is malformed, so that it is refused and what follows it is understood.
    """
    depth = begin = 0
    for n, letter in enumerate(buffer):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if letter == ")" and depth <= 0:
            return _parse(_bare(buffer[begin : n + 1])), buffer[n + 1 :]
        if letter == "\n":
            if text := _bare(buffer[begin:n]):
                return _malformed_request(text), buffer[n + 1 :]
            begin = n + 1
    rest = buffer[begin:]
    return (_malformed_request(_bare(rest)), "") if len(rest) > LONGEST_REQUEST else (None, rest)


def _bare(text: str) -> str:
    """The text without what may separate requests."""
    return text.strip(" \r\n\t;")


def _malformed_request(text: str) -> Request:
    return Request("", (), {}, text)


def _parse(text: str) -> Request:
    name, _, inside = text.partition("(")
    values, keywords = [], {}
    for part in re.split(r",(?![^{(]*[})])", inside[:-1]):  # not at commas within braces or parentheses
        key, equals, value = part.partition("=")
        if equals:
            keywords[key.strip().lower()] = value.strip()
        elif part.strip():  # some clients send a comma at the end
            values.append(part.strip())
    return Request(name.strip().lower(), tuple(values), keywords, text)


def read_numbers(request: Request, parameters: tuple[Range, ...], counts: tuple[int, ...]) -> list[float]:
    """The request's values as numbers.

    Raises
    ------
    RefusedError
        The number of values is wrong (-20000), or the type (-3000n) or the range (-4000n) of the n-th value.
    """
    refuse_if(len(request.values) not in counts, ErrorId.PARAMETER_COUNT)
    return [_number(text, parameter, n) for n, (text, parameter) in enumerate(zip(request.values, parameters, strict=False), start=1)]


def read_table(text: str, counts: tuple[int, ...], n: int, most: float = FARTHEST) -> list[float]:
    """Numbers of the n-th parameter, ``{x,y,z,r}`` or ``(x,y,z,r)``. A number whose size is above ``most`` counts as that size.

    Raises
    ------
    RefusedError
        The values are not numbers (-3000n), or are not finite or have the wrong count (-4000n).
    """
    with ErrorsAs(ValueError, lambda error: RefusedError(ErrorId.PARAMETER_TYPE - n)):
        numbers = [float(part) for part in text.strip("{}() '\"").split(",")]
    refuse_if(len(numbers) not in counts or not all(map(math.isfinite, numbers)), ErrorId.PARAMETER_RANGE - n)
    return [max(-most, min(number, most)) for number in numbers]


def keyword_number(request: Request, key: str, parameter: Range, default: float) -> float:
    """The value of a keyword, or the default. In error ids, keywords are numbered after the values."""
    if key not in request.keywords:
        return default
    return _number(request.keywords[key], parameter, len(request.values) + 1 + list(request.keywords).index(key))


def _number(text: str, parameter: Range, n: int) -> float:
    with ErrorsAs(ValueError, lambda error: RefusedError(ErrorId.PARAMETER_TYPE - n)):
        number = int(text) if parameter.whole else float(text)
    # the range comes first, because a whole number may be too large for isfinite
    refuse_if(number not in parameter or not math.isfinite(number), ErrorId.PARAMETER_RANGE - n)
    return max(-FARTHEST, min(number, FARTHEST)) if parameter is NUMBER else number


Command = Callable[[Request], str | None]
"""A command, which returns the values of its reply; None if it has none."""


def command_of(act: Callable[..., str | None], *parameters: Range, counts: tuple[int, ...] = ()) -> Command:
    """A command that is a function of the numbers in its request, of which there are as many as parameters, or one of ``counts``."""
    return lambda request: act(*read_numbers(request, parameters, counts or (len(parameters),)))


def _nothing(*_: float) -> None:
    """Have no effect."""


def _no_signal(*_: float) -> str:
    """An input to which nothing is attached."""
    return "0"


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
            "enablerobot": command_of(self._enable, LOAD_KG, CENTRE_MM, CENTRE_MM, CENTRE_MM, counts=(0, 1, 4)),
            "disablerobot": command_of(arm.disable),
            "clearerror": command_of(arm.clear_error),
            "resetrobot": command_of(arm.reset),
            "pause": command_of(arm.pause),
            "continue": command_of(arm.resume),
            "emergencystop": command_of(arm.press_emergency_stop),
            "robotmode": command_of(lambda: str(int(arm.mode()))),
            "getangle": command_of(lambda: _text(arm.track.joints_deg(arm.update()))),
            "getpose": self._get_pose,
            "geterrorid": command_of(self._error_ids),
            **{kind: command_of(partial(self._select, kind), INDEX) for kind in ("user", "tool")},
            "positivesolution": command_of(self._forward, *PLACE_IN_FRAMES),
            "inversesolution": self._inverse,
            **dict.fromkeys(("do", "doexecute", "dogroup"), self._output),
            **dict.fromkeys(("tooldo", "tooldoexecute"), command_of(_nothing, TOOL_PORT, BIT)),
            **dict.fromkeys(("setpayload", "payload"), command_of(self._payload, LOAD_KG, NUMBER, counts=(1, 2))),
            "di": command_of(_no_signal, INPUT),
            "tooldi": command_of(_no_signal, TOOL_PORT),
            "arch": command_of(_nothing, INDEX),
            "limz": command_of(_nothing, NUMBER),
            "loadswitch": command_of(_nothing, BIT),
            "setcollisionlevel": command_of(_nothing, LEVEL),
            "setarmorientation": command_of(_nothing, SIDE, SIDE, SIDE, SIDE, counts=(1, 4)),
            "startdrag": command_of(lambda: arm.drag(True)),
            "stopdrag": command_of(lambda: arm.drag(False)),
            **{name: command_of(partial(arm.set_percent, name), RATIO if name == "cp" else PERCENT) for name in arm.percent},
            # Those of an enabled arm are not switched. An emulated arm does not sink, so a brake has no effect.
            "brakecontrol": command_of(lambda joint, on: refuse_if(arm.enabled), JOINT, BIT),
            "runscript": self._run_script,
            **dict.fromkeys(("stopscript", "pausescript", "continuescript"), command_of(_nothing)),  # no project runs
            "modbuscreate": self._create_slave,
            "modbusclose": command_of(self._close_slave, SLAVE),
            **dict.fromkeys(("getcoils", "getinbits", "getinregs", "getholdregs", "setcoils", "setholdregs"), self._registers),
        }
        if firmware >= (1, 5, 9):
            self.dashboard["wait"] = command_of(self._wait, WAIT_MS, counts=(0, 1))
        if firmware >= (1, 6):
            self.dashboard |= {"setuser": self._define, "settool": self._define, "calcuser": self._calculate, "calctool": self._calculate}
        self.motion: dict[str, Command] = {
            **dict.fromkeys(("movj", "movl", "movlio", "movjio"), self._to_pose),
            "arc": self._arc,
            "circle": self._circle,
            **dict.fromkeys(("jointmovj", "reljointmovj"), self._to_joints),
            "movejog": self._jog,
            **{f"relmov{kind}{frame}": self._relative for kind in "jl" for frame in ("user", "tool", "")},
            **dict.fromkeys(("sync", "syncall"), command_of(_nothing)),  # the server sends the reply when the queue is empty
        }

    def _enable(self, kg: float = 0.0, x_mm: float = 0.0, y_mm: float = 0.0, z_mm: float = 0.0) -> None:
        self.arm.enable()
        self.arm.load = kg, x_mm, y_mm, z_mm

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

    def _close_slave(self, index: int) -> None:
        refuse_if(self._slaves.pop(index, None) is None)

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

    def _select(self, kind: str, index: int) -> None:
        self._frame(kind, index)
        self.arm.selected[kind] = index

    def _frame_in(self, request: Request, first: int) -> PlanarFrame:
        """The frame ``{x,y,z,r}`` that begins at a parameter; its braces may be missing."""
        x, y, z, *turns = read_table(",".join(request.values[first:]), (4, 6), first + 1)
        return PlanarFrame(x, y, z, turns[-1])

    def _define(self, request: Request) -> None:
        refuse_if(len(request.values) not in (2, 5, 7), ErrorId.PARAMETER_COUNT)
        frame = self._frame_in(request, 1)
        self.arm.frames[request.name.removeprefix("set")][request.whole(0, INDEX)] = frame

    def _calculate(self, request: Request) -> str:
        """A frame after an offset along the base's axes (1) or along its own (0)."""
        refuse_if(len(request.values) not in (3, 6, 8), ErrorId.PARAMETER_COUNT)
        frame, offset = self._frame(request.name.removeprefix("calc"), request.whole(0, INDEX)), self._frame_in(request, 2)
        along_base = request.whole(1, BIT)
        return _text(np.add(frame, offset) if along_base else frame @ offset)

    def _payload(self, kg: float, inertia: float = 0.0) -> None:
        self.arm.load = kg, *self.arm.load[1:]

    def _wait(self, time_ms: float = 0.0) -> None:
        self.arm.order(Order(np.zeros(6), True, self.arm.speeds(100.0, 100.0), wait_s=time_ms / 1000.0))

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

    def _error_ids(self) -> str:
        self.arm.update()
        groups = int(self.arm.faults.value("error-groups") or 1 + SERVOS_N)
        return "[" + ",".join([str(self.arm.alarms).replace(" ", ""), *["[]"] * (groups - 1)]) + "]"

    def _get_pose(self, request: Request) -> str:
        read_numbers(request, (), (0,))
        refuse_if(request.keywords and self.firmware >= (1, 7), ErrorId.PARAMETER_TYPE - 1)
        user, tool = self._frames(request)
        pose = user.inverse() @ PlanarFrame.of_pose(self.arm.track.pose(self.arm.update())) @ tool
        return _text([*pose, 0.0, 0.0] if "six-value-pose" in self.arm.faults else pose)

    def _forward(self, *joints_and_frames: float) -> str:
        *joints, user, tool = joints_and_frames
        refuse_if(self.arm.kinematics.violation(np.array(joints)))
        flange = PlanarFrame.of_pose(self.arm.kinematics.forward(np.array(joints)))
        return _text(self._frame("user", user).inverse() @ flange @ self._frame("tool", tool))

    def _inverse(self, request: Request) -> str:
        # two optional parameters select the solution near given joints; here there is only one
        refuse_if(len(request.values) not in (6, 7, 8), ErrorId.PARAMETER_COUNT)
        *pose, user, tool = read_numbers(replace(request, values=request.values[:6]), PLACE_IN_FRAMES, (6,))
        joints = self.arm.joints_at(self._frame("user", user) @ PlanarFrame(*pose) @ self._frame("tool", tool).inverse())
        refuse_if(self.arm.kinematics.violation(joints))
        return _text(joints)

    def _to_pose(self, request: Request) -> None:
        """Move to a place. Moves with IO have outputs ``{Mode,Distance,Index,Status}``, which they set on their path."""
        groups = [value for value in request.values if value[0] in "{(" and request.name.endswith("io")]
        refuse_if(request.name.endswith("io") and not groups, ErrorId.PARAMETER_COUNT)
        place = read_numbers(replace(request, values=request.values[: len(request.values) - len(groups)]), PLACE, (4,))
        flange = self._flange(place, request)
        length_mm = float(np.linalg.norm(flange.pose[:3] - self.arm.last_target().pose[:3]))
        outputs = tuple(self._on_the_way(text, n, length_mm) for n, text in enumerate(groups, start=5))
        self._order(flange, request, linear=request.name.startswith("movl"), outputs=outputs)

    @staticmethod
    def _on_the_way(text: str, n: int, length_mm: float) -> tuple[float, int, int]:
        """Share of the path at which an output is set, its index and its level."""
        mode, distance, index, level = read_table(text, (4,), n)
        share = distance / 100.0 if mode == 0 else distance / max(length_mm, 1e-9)
        within = mode in (0, 1) and -1.0 <= share <= 1.0 and OUTPUT.low <= index <= OUTPUT.high and level in (0, 1)
        refuse_if(not within, ErrorId.PARAMETER_RANGE - n)
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
        via, end = (self._flange(part, request).pose for part in (numbers[:4], numbers[4:]))
        start = self.arm.last_target().pose
        poses = circle(start, via, end, whole=laps > 0)
        refuse_if(len(poses) == 2)
        speeds = replace(self._speeds(request, "l"), linear_mm_s2=np.inf, angular_deg_s2=np.inf)  # no stop between the lines
        for pose in poses * max(laps, 1):
            self.arm.order(Order(pose, True, speeds))

    def _relative(self, request: Request) -> None:
        """``RelMovLUser(dx, dy, dz, dr, user)`` and similar commands. The offset is along the axes of the user or tool frame."""
        values, kind = read_numbers(request, (*PLACE, INDEX), (4, 5)), "tool" if request.name.endswith("tool") else "user"
        frame = self._frame(kind, values[4] if len(values) == 5 else self.arm.selected[kind])
        last, offset = self.arm.last_target(), PlanarFrame(*values[:4])
        if kind == "tool":
            end = last @ frame @ offset @ frame.inverse()
        else:
            along = PlanarFrame(r=frame.r) @ offset
            end = PlanarFrame(last.x + along.x, last.y + along.y, last.z + along.z, last.r + offset.r)
        self._order(end, request, linear=request.name[6] == "l")

    def _order(self, flange: PlanarFrame, request: Request, *, linear: bool, outputs: tuple[tuple[float, int, int], ...] = ()) -> None:
        order = Order(flange.pose, True, self._speeds(request, "l" if linear else "j"), outputs=outputs)
        if not linear:
            with suppress(RefusedError):  # planning raises the alarm if the target is out of reach
                order = replace(order, end=self.arm.joints_at(flange), linear=False)
        self.arm.order(order)

    def _to_joints(self, request: Request) -> None:
        joints = np.array(read_numbers(request, PLACE, (4,)))
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

    def _frames(self, request: Request) -> list[PlanarFrame]:
        """The user and the tool frame of a request."""
        return [self._frame(kind, keyword_number(request, kind, INDEX, self.arm.selected[kind])) for kind in ("user", "tool")]

    def _frame(self, kind: str, index: float) -> PlanarFrame:
        refuse_if(index not in self.arm.frames[kind])
        return self.arm.frames[kind][int(index)]

    def _flange(self, place: list[float], request: Request) -> PlanarFrame:
        """The flange where the tool of a request is at a place in its user frame."""
        user, tool = self._frames(request)
        return user @ PlanarFrame(*place) @ tool.inverse()


def _text(values: Iterable[float]) -> str:
    return ",".join(f"{value:.6f}" for value in values)


def parse_firmware(text: str) -> tuple[int, ...]:
    """``1.7.0`` as (1, 7, 0); ``ValueError`` if it is no version."""
    if not re.fullmatch(r"\d+(\.\d+)*", text):
        raise ValueError(f"'{text}' is no firmware version; for example 1.7.0")
    return tuple(int(part) for part in text.split("."))
