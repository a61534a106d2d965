"""A UR5 with PolyScope 3.15 emulated on this machine, over real TCP sockets: RTDE, the port for scripts, and the dashboard.

The control script that ``ur_rtde`` uploads is not interpreted: its handshake over registers, and the commands of ``COMMANDS``, are those of
``ur_rtde`` 1.6. ``ur_rtde`` connects to fixed ports; therefore several emulated arms need an address of the loopback network each.
"""

import contextlib
import logging
import random
import re
import socket
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from hardware.arms.motion import MotionTrack, Speeds, Violation
from hardware.arms.ur import driver as ur
from hardware.emulators.faults import SECONDS, SHARE, EmulatedArm, Fault, Faults, PortServer
from hardware.errors import cannot_listen, on_error
from twin.errors import ErrorsAs
from twin.rig.arm_pose import matrix_of

LOG = logging.getLogger(__name__)
SCRIPT_PORT, RTDE_PORT = 30003, 30004
CYCLE_S = 0.008
VERSION = (3, 15, 8, 0)
START_JOINTS_DEG = (-70.0, -110.0, -90.0, -70.0, 90.0, 0.0)
# The tool points down, 100 mm from the flange, in a frame whose z points up. So a level tool has rx = ry = 0.
TOOL = (0.0, 0.0, 0.1, np.pi, 0.0, 0.0)
LOCKED_S = 5.0  # time, s, before which a protective stop can't be released
READY, DONE = 1, 2  # what the control script writes into its first register
SCRIPT = re.compile(r"^def (\w+)\(\):.*?^end\n", re.MULTILINE | re.DOTALL)
# The format of each type of RTDE, and the names of the variables that have it.
TYPES = {"DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "VECTOR6INT32": "6i"}
NAMES = {
    "DOUBLE": r"timestamp|.*_double_register_\d+|.*speed_(scaling|fraction)|payload|standard_analog.*"
    r"|actual_(execution_time|momentum|main_voltage|robot_.*)",
    "VECTOR3D": "actual_tool_accelerometer|payload_cog",
    "VECTOR6D": "(actual|target)_(q|qd|qdd|current|moment|joint_voltage|TCP_.*)|joint_(control_output|temperatures)|.*inertia|.*torque",
    "INT32": r".*_int_register_\d+|(robot|safety)_mode",
    "UINT32": "runtime_state|.*_status_bits",
    "UINT64": "actual_digital_.*",
    "VECTOR6INT32": "joint_mode",
}
FAULTS = {
    "silent": Fault("nothing arrives in either direction any more; the arm goes on"),
    "frozen-feedback": Fault("the feedback repeats an old packet"),
    "no-replies": Fault("commands are executed, and their replies are lost"),
    "unplugged": Fault("every connection is lost, this many seconds after the start; the arm goes on", 5.0, SECONDS),
    "emergency-stop": Fault("the emergency stop is pressed, this many seconds after the start", 0.0, SECONDS),
    "protective-stop": Fault("each move ends in a protective stop after this share of its time", 0.5, SHARE),
    "slider": Fault("the speed slider is at this share", 0.1, SHARE),
    "ignore-moves": Fault("moves are accepted and not executed"),
    "late-start": Fault("a control script starts this many seconds after its upload", 1.0, SECONDS),
    "script-ends": Fault("a control script ends this many seconds after its start", 0.0, SECONDS),
}


class UrController:
    """The controller of a UR5 that follows its targets exactly; ``cycle`` is called 125 times a second.

    Attributes
    ----------
    inputs, outputs : dict of str to float
        The registers of RTDE.
    watchdog_hz : float
        Least rate of inputs, below which the control script ends; 0 if none is set.
    written_s : float
        ``time.monotonic()`` of the newest input.
    """

    def __init__(self, faults: Faults, time_scale: float) -> None:
        self.faults, self._scale, self.lock = faults, time_scale, Lock()
        self.kinematics = ur.UrKinematics()
        self.kinematics.near_deg[:] = START_JOINTS_DEG
        self.kinematics.T_flange_tool[:] = matrix_of(ur.pose_from_ur(np.array(TOOL)))
        self.track = MotionTrack(self.kinematics, np.array(START_JOINTS_DEG))
        self.inputs: dict[str, float] = defaultdict(float)
        self.outputs: dict[str, float] = defaultdict(float)
        self.robot_mode, self.safety_mode, self.runtime_state = ur.RUNNING, ur.NORMAL, ur.STOPPED
        self._started_s = self._cycled_s = self.written_s = time.monotonic()
        self._program: Iterator[None] | None = None
        self._starts_s = 0.0  # when the script starts
        self.watchdog_hz = self._locked_until_s = 0.0
        self._collides_s = np.inf  # when a fault ends the present move

    @property
    def enabled(self) -> bool:
        """Whether the control script runs under its watchdog."""
        return self.runtime_state == ur.PLAYING and self.watchdog_hz > 0

    def busy(self) -> bool:
        """Whether the arm moves."""
        return self.track.moving(time.monotonic())

    def update(self) -> float:
        """The present time, up to which its cycles go on by themselves."""
        return time.monotonic()

    def cycle(self) -> dict[str, Any]:
        """Go on to the present time; returns the values of RTDE's variables, of which those that are missing are 0."""
        with self.lock:
            now_s = time.monotonic()
            if now_s >= self._collides_s:
                self._collides_s = np.inf
                self.protective_stop()
            if self.runtime_state == ur.PLAYING and self._program is not None:
                starves = self.enabled and now_s - self.written_s > 1 / self.watchdog_hz
                ends_s = self.faults.value("script-ends")
                if starves or (ends_s is not None and now_s > self._starts_s + ends_s) or next(self._program, self) is self:
                    self.end_program()
            elif self.runtime_state == ur.STOPPED and self._program is not None and now_s >= self._starts_s:
                self.runtime_state = ur.PLAYING
            pose = self.track.pose(now_s)
            joints = self.kinematics.inverse(pose) if self.track.target().linear else self.track.joints_deg(now_s)
            speed = np.radians(joints - self.kinematics.near_deg) / max(now_s - self._cycled_s, CYCLE_S / 2)
            self.kinematics.near_deg[:], self._cycled_s = joints, now_s
            values: dict[str, Any] = dict.fromkeys(("actual_q", "target_q"), np.radians(joints))
            values |= dict.fromkeys(("actual_qd", "target_qd"), speed)
            values |= dict.fromkeys(("actual_TCP_pose", "target_TCP_pose"), ur.pose_to_ur(pose))
            values |= dict.fromkeys(("speed_scaling", "target_speed_fraction"), self.faults.factor("slider"))
            values |= {name: getattr(self, name) for name in ("robot_mode", "safety_mode", "runtime_state")}
            values["safety_status_bits"] = {ur.NORMAL: 1, ur.PROTECTIVE: 4, ur.EMERGENCY: 128}[self.safety_mode]
            return values | self.outputs | {"timestamp": now_s - self._started_s}

    def run_script(self, name: str) -> None:
        """Run an uploaded script. Only the control script of ``ur_rtde`` is known."""
        with self.lock:
            self.end_program()
            if name == "rtde_control" and self.robot_mode == ur.RUNNING and self.safety_mode == ur.NORMAL:
                self._program, self._starts_s = self._control(), time.monotonic() + (self.faults.value("late-start") or 0.0)

    def end_program(self) -> None:
        """End the script; the arm stops."""
        self.track.stop(time.monotonic())
        self.runtime_state, self._program, self.watchdog_hz = ur.STOPPED, None, 0.0

    def press_emergency_stop(self) -> None:
        """Press the emergency stop, which cuts the power."""
        self.power(ur.POWER_OFF)
        self.safety_mode = ur.EMERGENCY

    def power(self, mode: int) -> None:
        """Bring the motors into a mode: without power, with brakes, or running."""
        self.end_program()
        self.robot_mode = mode if self.safety_mode == ur.NORMAL else ur.POWER_OFF

    def protective_stop(self) -> None:
        """Stop as after a collision. The script pauses."""
        self.track.stop(time.monotonic())
        self.runtime_state = ur.PAUSED if self._program is not None else ur.STOPPED
        self.safety_mode, self._locked_until_s = ur.PROTECTIVE, time.monotonic() + LOCKED_S / self._scale

    def answer(self, request: str) -> str:
        """The dashboard's answer to a request."""
        words = {"polyscopeversion": "3.15.8.106339", "get robot model": "UR5", "close safety popup": "closing safety popup"}
        words["running"] = f"Program running: {str(self.runtime_state == ur.PLAYING).lower()}"
        acts = {
            "stop": (self.end_program, "Stopped"),
            "power on": (lambda: self.power(max(self.robot_mode, ur.IDLE)), "Powering on"),
            "brake release": (lambda: self.power(ur.RUNNING), "Brake releasing"),
            "power off": (lambda: self.power(ur.POWER_OFF), "Powering off"),
            "unlock protective stop": (lambda: setattr(self, "safety_mode", ur.NORMAL), "Protective stop releasing"),
        }
        if request not in acts:
            return words.get(request, f"could not understand: '{request}'")
        if request.startswith("unlock") and time.monotonic() < self._locked_until_s:
            return "Cannot unlock protective stop until 5s after occurrence"
        act, reply = acts[request]
        with self.lock:
            act()
        return reply

    def _control(self) -> Iterator[None]:
        """The control script, cycle by cycle."""
        register, executed = "output_int_register_0", False
        while True:
            command = int(self.inputs["input_int_register_0"])
            if not command:
                executed, self.outputs[register] = False, READY
            elif not executed:
                if command not in COMMANDS:  # that of the script's end, or one that is not emulated
                    return
                COMMANDS[command](self)
                while not self.inputs["input_int_register_1"] and self.busy():
                    yield
                executed = True
                if "no-replies" not in self.faults:
                    self.outputs[register] = DONE
            yield

    def _move(self, *, linear: bool) -> None:
        *target, speed, acceleration = (self.inputs[f"input_double_register_{n}"] for n in range(8))
        now_s = time.monotonic()
        self.track.stop(now_s)  # a move replaces the one before it
        if "ignore-moves" in self.faults:
            return
        end = ur.pose_from_ur(np.array(target)) if linear else np.degrees(target)
        speeds = Speeds(1000.0 * speed, float(np.degrees(speed)), 1000.0 * acceleration, float(np.degrees(acceleration)))
        piece = self.track.move(end, speeds.scale_time(self._scale * self.faults.factor("slider")), linear=linear, now_s=now_s)
        if isinstance(piece, Violation):
            self.end_program()
            return
        self._collides_s = now_s + (self.faults.value("protective-stop") or np.inf) * max(piece.duration_s, CYCLE_S)


# The commands of the control script by their numbers: moveJ, moveL, triggerProtectiveStop, stopL, stopJ and setWatchdog.
COMMANDS: dict[int, Callable[[UrController], None]] = {
    1: lambda arm: arm._move(linear=False),
    3: lambda arm: arm._move(linear=True),
    31: UrController.protective_stop,
    **dict.fromkeys((33, 34), lambda arm: arm.track.stop(time.monotonic())),
    35: lambda arm: setattr(arm, "watchdog_hz", arm.inputs["input_double_register_0"]),
}


@cache
def type_of(name: str) -> str:
    """The type of an RTDE variable; NOT_FOUND if there is none of this name."""
    return next((kind for kind, names in NAMES.items() if re.fullmatch(names, name)), "NOT_FOUND")


class UrEmulator(EmulatedArm):
    """A UR5 on loopback. A context manager, which listens between ``start`` and ``stop``.

    Parameters
    ----------
    host : str or None
        Address to listen on. None: an unused address of the loopback network, see ``host``.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.
    time_scale : float
        Factor by which it moves faster than the real arm.
    """

    def __init__(self, *, host: str | None = "127.0.0.1", faults: tuple[str, ...] = (), time_scale: float = 1.0) -> None:
        super().__init__(FAULTS, faults, time_scale)
        self.arm = UrController(self.faults, time_scale)
        self.host = host or f"127.{random.randrange(1, 255)}.{random.randrange(256)}.{random.randrange(1, 255)}"
        self._ports: list[PortServer] = []
        self._streams: dict[socket.socket, list[str]] = {}  # the variables that each client gets
        self._owner: socket.socket | None = None  # the client whose inputs the registers take
        self._ended = Event()

    def start(self) -> None:
        """Begin to listen; errors as for ``plug``."""
        self.plug()
        self.place = f"ur {self.host}"
        Thread(target=self._run, daemon=True, name="ur-emulator").start()
        self.faults.after("unplugged", self.unplug)
        self.faults.after("emergency-stop", self.arm.press_emergency_stop)

    def stop(self) -> None:
        self._ended.set()
        self.unplug()

    def plug(self) -> None:
        """Listen, also after ``unplug``.

        Raises
        ------
        DeviceError
            A port is taken, or the host is not this machine's.
        """
        for port, serve in ((ur.DASHBOARD_PORT, self._serve_dashboard), (SCRIPT_PORT, self._serve_scripts), (RTDE_PORT, self._serve_rtde)):
            with on_error(self.unplug), ErrorsAs(OSError, partial(cannot_listen, "ur", self.host, port, option="`host`")):
                self._ports.append(PortServer((self.host, port), serve))

    def unplug(self) -> None:
        """Lose every connection. The arm goes on."""
        ports, self._ports = self._ports, []
        for port in ports:
            port.lose()

    def _run(self) -> None:
        """The controller's cycles, and the packets of each."""
        values, due_s = self.arm.cycle(), time.monotonic()
        while not self._ended.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + CYCLE_S, time.monotonic())
            present = self.arm.cycle()
            values = values if "frozen-feedback" in self.faults else present
            for connection, names in self._streams.copy().items() if "silent" not in self.faults else ():
                layouts = [TYPES[type_of(name)] for name in names]
                given = ((values.get(name, 0), int(layout[:-1] or 1)) for name, layout in zip(names, layouts, strict=True))
                numbers = [number for value, size in given for number in (size * (value,) if np.isscalar(value) else value)]
                with contextlib.suppress(OSError):
                    _send(connection, b"U", b"\1" + struct.pack(">" + "".join(layouts), *numbers))

    def _serve_dashboard(self, connection: socket.socket) -> None:
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in connection.makefile():
            if "silent" not in self.faults:
                connection.sendall(f"{self.arm.answer(line.strip().lower())}\n".encode())

    def _serve_scripts(self, connection: socket.socket) -> None:
        text = ""
        while piece := connection.recv(65536).decode():
            text += piece
            while (script := SCRIPT.search(text)) is not None:
                text = text[script.end() :]
                if "silent" not in self.faults:
                    self.arm.run_script(script[1])

    def _serve_rtde(self, connection: socket.socket) -> None:
        stream, outputs, recipes = connection.makefile("rb"), [""], [[""]]
        try:
            while header := stream.read(3):
                size, kind = struct.unpack(">Hc", header)
                content = stream.read(size - 3)
                if "silent" in self.faults:
                    continue
                answer = b"\1"  # to the protocol's version, start and pause
                if kind == b"U":
                    self._take(recipes[content[0]], content[1:])
                    continue
                if kind == b"v":
                    answer = struct.pack(">4I", *VERSION)
                elif kind in b"OI":
                    names = content[8 if kind == b"O" else 0 :].decode().rstrip(",").split(",")
                    types = [type_of(name) for name in names]
                    if kind == b"O":
                        outputs = names
                    elif self._owner in (None, connection):
                        self._owner = connection
                        recipes.append(names)
                    else:
                        types = ["IN_USE"] * len(names)
                    answer = bytes([len(recipes) - 1 or 1]) + ",".join(types).encode()
                _send(connection, kind, answer)
                if kind == b"S":
                    self._streams[connection] = outputs
                elif kind == b"P":
                    self._streams.pop(connection, None)
        finally:
            self._streams.pop(connection, None)
            self._owner = None if self._owner is connection else self._owner

    def _take(self, names: list[str], content: bytes) -> None:
        numbers = struct.unpack(">" + "".join(TYPES[type_of(name)] for name in names), content)
        with self.arm.lock:
            self.arm.inputs.update(zip(names, numbers, strict=False))
            self.arm.written_s = time.monotonic()


def _send(connection: socket.socket, kind: bytes, content: bytes) -> None:
    connection.sendall(struct.pack(">H", 3 + len(content)) + kind + content)
