"""A Dobot MG400 emulated on this machine, over real TCP sockets on all five ports."""

import logging
import select
import socket
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from threading import Event

import numpy as np

from hardware.arms import mg400_wire as wire
from hardware.arms.arm import happens
from hardware.emulators.faults import EVERY_NTH, SECONDS, SHARE, EmulatedArm, Fault, PortServer, Range
from hardware.emulators.mg400_commands import Mg400Commands, Request, parse_firmware, take_request
from hardware.emulators.mg400_controller import START_JOINTS_DEG, Mg400Controller, PlanarFrame, RefusedError, refuse_if
from hardware.errors import cannot_listen, on_error
from twin.errors import ErrorsAs, TwinError

LOG = logging.getLogger(__name__)
PORTS = (wire.DASHBOARD_PORT, wire.MOTION_PORT, *wire.FEEDBACK_PERIOD_S)
OLD_FIRMWARE, NEW_FIRMWARE = "1.5.5", "1.7.0"
# First firmware whose replies have numbers; older firmware answers bare echoes.
FIRST_NUMBERED_REPLIES = (1, 5, 6)
# Length of a feedback packet that was cut short, in bytes.
SHORT_BYTES = 1000
# Interval in s at which a waiting thread checks again.
POLL_S = 0.002
# Time in s after which a client that has connected to a port is being served, also on a busy machine.
ACCEPTS_S = 0.3
# Interval in s of the finite differences that give speeds: the period of the fastest feedback.
DIFFERENCE_S = 0.008
FAULTS = {
    "no-tcp-mode": Fault("not in TCP mode: every command is refused with -1"),
    "split-refusals": Fault("a refusal arrives as two fragments: -1,{},;EnableRobot();"),
    "needs-motion-client": Fault("the dashboard answers -10000 until a client is on the motion port"),
    "motion-port-closed": Fault("nobody listens on the motion port and the dashboard answers -10000"),
    "one-client": Fault("a port hangs up on a second client"),
    "emergency-stop": Fault("the emergency stop is pressed, this many seconds after the start", 0.0, SECONDS),
    "no-fast-feedback": Fault("nobody listens on 30004"),
    "no-feedback": Fault("nobody listens on 30004 to 30006"),
    "silent-feedback": Fault("each feedback connection falls silent after this many seconds", 1.0, SECONDS),
    "late-feedback": Fault("feedback arrives this many seconds late", 2.0, SECONDS),
    "short-packets": Fault("every n-th feedback packet is cut short", 10.0, EVERY_NTH),
    "wrong-test-value": Fault("every n-th feedback packet has a wrong test value", 10.0, EVERY_NTH),
    "collision": Fault("each move ends in a collision alarm after this share of its time", 0.5, SHARE),
    "stall": Fault("each move stops without an alarm after this share of its time", 0.5, SHARE),
    "ignore-moves": Fault("moves are accepted and not executed"),
    "slow": Fault("moves at this share of the speed", 0.1, SHARE),
    "no-move-reply": Fault("moves are executed, and their replies are lost"),
    "no-sync-reply": Fault("Sync() is never answered"),
    "frozen": Fault(
        "the controller answers nothing and sends no feedback, from this many seconds after the start; the arm goes on", 5.0, SECONDS
    ),
    "six-value-pose": Fault("GetPose() gives six values"),
    "error-groups": Fault("GetErrorID() gives this many groups", 7.0, Range(1, 100, whole=True)),
    "die": Fault("the arm goes dead, this many seconds after the start", 5.0, SECONDS),
}


class Mg400Emulator(EmulatedArm):
    """An MG400 on loopback. A context manager, which listens between ``start`` and ``stop``.

    Parameters
    ----------
    host : str
        Address to listen on.
    port_offset : int or None
        Added to the arm's port numbers. None: free ports are used, see ``ports``.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.
    firmware : str
        Below 1.5.6 it replies with bare echoes, and not at all on the motion port. From 1.6 on it has SetUser and SetTool. From 1.7 on it
        refuses ``GetPose`` with keywords.
    lenient : bool
        Behave as firmware 1.5.5, whatever ``firmware`` is, but echo on the motion port too.
    joints_deg : (4,) float
        Joints at the start.
    time_scale : float
        Factor by which it moves faster than the real arm.

    Attributes
    ----------
    ports : dict of int to int
        For each of the arm's own ports, the port on which the emulator listens.
    """

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port_offset: int | None = 0,
        faults: tuple[str, ...] = (),
        firmware: str = NEW_FIRMWARE,
        lenient: bool = False,
        joints_deg: Sequence[float] = START_JOINTS_DEG,
        time_scale: float = 1.0,
    ) -> None:
        with ErrorsAs(ValueError, lambda error: TwinError(str(error))):
            version = parse_firmware(OLD_FIRMWARE if lenient else firmware)
        wire.require_ports(port_offset or 0)
        super().__init__(FAULTS, faults, time_scale)
        self.host, self._port_offset = host, port_offset
        self.arm = Mg400Controller(self.faults, joints_deg=joints_deg, time_scale=time_scale)
        self._commands = Mg400Commands(self.arm, version)
        self._bare, self._lenient = version < FIRST_NUMBERED_REPLIES, lenient
        self.ports: dict[int, int] = {}
        self._servers: dict[int, PortServer] = {}  # by the arm's own ports
        self._ended = Event()
        self._started_s = time.monotonic()

    def start(self) -> None:
        """Begin to listen.

        Raises
        ------
        DeviceError
            A port is taken, or the host is not this machine's.
        """
        deaf = {wire.MOTION_PORT} if "motion-port-closed" in self.faults else set()
        deaf |= set(wire.FEEDBACK_PERIOD_S) if "no-feedback" in self.faults else {30004} if "no-fast-feedback" in self.faults else set()
        for port in PORTS:
            at = self.host, 0 if self._port_offset is None else port + self._port_offset
            with on_error(self.stop), ErrorsAs(OSError, partial(cannot_listen, "mg400", *at, option="`port_offset`")):
                server = self._servers[port] = PortServer(at, partial(self._serve, port), deaf=port in deaf)
            self.ports[port] = server.server_address[1]
        self.place = " ".join(map(str, ("mg400", self.host, *self.ports.values())))
        self._started_s = time.monotonic()
        self.faults.after("emergency-stop", self.arm.press_emergency_stop)
        self.faults.after("die", self.kill)

    def stop(self, *, abruptly: bool = False) -> None:
        """Close all connections and stop listening; ``abruptly``: every connection is reset."""
        self._ended.set()
        for server in self._servers.values():
            server.lose(abruptly=abruptly)

    def kill(self) -> None:
        """Emulate a power loss: every connection is reset and no port listens."""
        self.stop(abruptly=True)

    def _serve(self, port: int, client: socket.socket) -> None:
        if "one-client" in self.faults and len(self._servers[port].clients) > 1:
            return
        if port in wire.FEEDBACK_PERIOD_S:
            self._feed(client, wire.FEEDBACK_PERIOD_S[port])
        else:
            self._converse(client, port)

    def _feed(self, client: socket.socket, period_s: float) -> None:
        begun_s = due_s = time.monotonic()
        count = 0
        waiting: deque[tuple[float, bytes]] = deque()
        while not self._ended.is_set():
            silent_after_s = self.faults.value("silent-feedback")
            silent = silent_after_s is not None and time.monotonic() - begun_s >= silent_after_s
            if not silent and not self._frozen:
                count += 1
                waiting.append((time.monotonic() + (self.faults.value("late-feedback") or 0.0), self._packet(count)))
            while waiting and waiting[0][0] <= time.monotonic():
                client.sendall(waiting.popleft()[1])
            due_s = max(due_s + period_s, time.monotonic())
            self._ended.wait(max(0.0, due_s - time.monotonic()) or POLL_S)

    def _packet(self, count: int) -> bytes:
        packet = feedback_packet(self.arm)
        if self.faults.every("wrong-test-value", count):
            packet["test_value"] = 0
        return packet.tobytes()[: SHORT_BYTES if self.faults.every("short-packets", count) else None]

    def _converse(self, client: socket.socket, port: int) -> None:
        buffer = ""
        while data := client.recv(4096):
            buffer += data.decode("ascii", errors="replace")
            request, buffer = take_request(buffer)
            while request is not None:
                if not self._frozen:
                    self._answer(client, port, request)
                request, buffer = take_request(buffer)

    def _answer(self, client: socket.socket, port: int, request: Request) -> None:
        error_id, values, waits = 0, "", request.name in ("sync", "syncall")
        try:
            values = self._execute(port, request)
        except RefusedError as refusal:
            error_id = refusal.error_id
        except Exception:
            error_id = wire.ErrorId.FAILED
            LOG.exception("emulated MG400: %s failed and was refused", request.text)
        if waits and not error_id and not self._wait_until_done(client):  # a connection that is lost meanwhile is no command that failed
            return
        reply = f"{error_id},{{{values}}},{request.text};"
        if error_id and "split-refusals" in self.faults and not self._bare:
            client.sendall(f"{error_id},{{}},;".encode())
            time.sleep(0.02)  # the client receives two pieces
            reply = f"{request.text};"
        if port == wire.MOTION_PORT and "no-move-reply" in self.faults and not waits:
            return
        if not self._bare:
            client.sendall(reply.encode())
        elif port == wire.DASHBOARD_PORT or self._lenient:
            client.sendall(f"{request.text};".encode())

    def _execute(self, port: int, request: Request) -> str:
        refuse_if("no-tcp-mode" in self.faults)
        if "needs-motion-client" in self.faults or "motion-port-closed" in self.faults:
            there = happens(lambda: self._servers[wire.MOTION_PORT].clients, ACCEPTS_S)
            refuse_if(not there, wire.ErrorId.NO_SUCH_COMMAND)
        commands = self._commands.dashboard if port == wire.DASHBOARD_PORT else self._commands.motion
        refuse_if(request.name not in commands, wire.ErrorId.NO_SUCH_COMMAND)
        with self.arm.lock:
            return commands[request.name](request) or ""

    @property
    def _frozen(self) -> bool:
        after_s = self.faults.value("frozen")
        return after_s is not None and time.monotonic() - self._started_s >= after_s

    def _wait_until_done(self, client: socket.socket) -> bool:
        """Wait until the queue is empty. False if the client has gone or no reply will be sent."""
        while self.arm.busy() or self._frozen or "no-sync-reply" in self.faults:
            readable, _, _ = select.select([client], [], [], POLL_S)
            if self._ended.is_set() or (readable and not client.recv(1, socket.MSG_PEEK)):
                return False
            if readable:
                time.sleep(POLL_S)
        return True


def feedback_packet(arm: Mg400Controller) -> np.ndarray:
    """The present state as a record of ``PACKET``. The arm follows its targets exactly. Currents and forces are not emulated."""
    mode, now_s = arm.mode(), arm.update()
    user, tool = (arm.frames[kind][index] for kind, index in arm.selected.items())
    joints, before = arm.track.joints_deg(now_s), arm.track.joints_deg(now_s - DIFFERENCE_S)
    seen, seen_before = (np.array(user.inverse() @ PlanarFrame.of_pose(arm.kinematics.forward(at)) @ tool) for at in (joints, before))
    speed = (seen - seen_before) / DIFFERENCE_S
    half_turn = np.radians(seen[3]) / 2
    packet = np.zeros((), wire.PACKET)
    fields: dict[str, object] = {
        "length": wire.PACKET_BYTES,
        "test_value": wire.TEST_VALUE,
        "digital_out": arm.digital_out,
        "mode": int(mode),
        "unix_ms": int(time.time() * 1000),
        "speed_scaling": arm.percent["speedfactor"],
        **dict.fromkeys(("q_target", "q_actual"), [*joints, 0, 0]),
        **dict.fromkeys(("qd_target", "qd_actual"), [*((joints - before) / DIFFERENCE_S), 0, 0]),
        **dict.fromkeys(("tool_target", "tool_actual"), [*seen, 0, 0]),
        **dict.fromkeys(("tcp_speed_target", "tcp_speed_actual"), [*speed, 0, 0]),
        "user_index": arm.selected["user"],
        "tool_index": arm.selected["tool"],
        "queue_runs": arm.queue_runs,
        "paused": arm.paused,
        "enabled": arm.enabled,
        "drag": mode == wire.Mode.BACKDRIVE,
        "running": mode == wire.Mode.RUNNING,
        "error": bool(arm.alarms),
        "jog": mode == wire.Mode.JOG,
        "robot_type": wire.ROBOT_TYPE_MG400,
        "load": arm.load,
        "user": [*user, 0, 0],
        "tool": [*tool, 0, 0],
        **dict.fromkeys(("target_quaternion", "actual_quaternion"), [np.cos(half_turn), 0, 0, np.sin(half_turn)]),
    }
    for name, value in fields.items():
        packet[name] = value
    return packet
