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

from hardware.arms.mg400_wire import (
    DASHBOARD_PORT,
    FEEDBACK_PERIOD_S,
    MOTION_PORT,
    PACKET,
    PACKET_BYTES,
    ROBOT_TYPE_MG400,
    TEST_VALUE,
    ErrorId,
    Mode,
    require_ports,
)
from hardware.emulators.faults import EVERY_NTH, SECONDS, SHARE, Emulator, Fault, Faults, Range, require_time_scale
from hardware.emulators.mg400_commands import Mg400Commands, parse_firmware
from hardware.emulators.mg400_controller import START_JOINTS_DEG, Mg400Controller, PlanarFrame
from hardware.emulators.mg400_grammar import RefusedError, Request, refuse_if, take_request
from hardware.emulators.servers import PortServer
from hardware.errors import cannot_listen
from twin.errors import ErrorsAs, TwinError

LOG = logging.getLogger(__name__)
PORTS = (DASHBOARD_PORT, MOTION_PORT, *FEEDBACK_PERIOD_S)
OLD_FIRMWARE, NEW_FIRMWARE = "1.5.5", "1.7.0"
# First firmware whose replies have numbers; older firmware answers bare echoes.
FIRST_NUMBERED_REPLIES = (1, 5, 6)
# Length of a feedback packet that was cut short, in bytes.
SHORT_BYTES = 1000
# Interval in s at which a waiting thread checks again.
POLL_S = 0.002
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


class Mg400Emulator(Emulator):
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
        require_ports(port_offset or 0)
        require_time_scale(time_scale)
        self.host, self._port_offset = host, port_offset
        self.faults = Faults(FAULTS, faults)
        self.arm = Mg400Controller(self.faults, joints_deg=joints_deg, time_scale=time_scale)
        self._commands = Mg400Commands(self.arm, version)
        self._bare, self._lenient = version < FIRST_NUMBERED_REPLIES, lenient
        self.ports: dict[int, int] = {}
        self._servers: dict[int, PortServer] = {}  # by the arm's own ports
        self._ended = Event()
        self._started_s = time.monotonic()

    def pose(self, time_s: float | None = None) -> np.ndarray:
        """Pose (6,) of the flange at a ``time.monotonic()`` (now if not given)."""
        now_s = self.arm.update()
        return self.arm.track.pose(now_s if time_s is None else time_s)

    def start(self) -> None:
        """Begin to listen.

        Raises
        ------
        DeviceError
            A port is taken, or the host is not this machine's.
        """
        deaf = {MOTION_PORT} if "motion-port-closed" in self.faults else set()
        deaf |= set(FEEDBACK_PERIOD_S) if "no-feedback" in self.faults else {30004} if "no-fast-feedback" in self.faults else set()
        for port in PORTS:
            at = self.host, 0 if self._port_offset is None else port + self._port_offset
            try:
                server = self._servers[port] = PortServer(at, partial(self._serve, port), deaf=port in deaf)
            except OSError as error:
                self.stop()
                raise cannot_listen("mg400", *at, error, option="`port_offset`") from error
            self.ports[port] = server.server_address[1]
        self.place = " ".join(map(str, ("mg400", self.host, *self.ports.values())))
        self._started_s = time.monotonic()
        self.faults.after("emergency-stop", self.arm.press_emergency_stop)
        self.faults.after("die", self.kill)

    def stop(self) -> None:
        """Close all connections and stop listening."""
        self._close(abruptly=False)

    def kill(self) -> None:
        """Emulate a power loss: every connection is reset and no port listens."""
        self._close(abruptly=True)

    def _close(self, *, abruptly: bool) -> None:
        self._ended.set()
        for server in self._servers.values():
            server.lose(abruptly=abruptly)

    def _serve(self, port: int, client: socket.socket) -> None:
        if "one-client" in self.faults and len(self._servers[port].clients) > 1:
            return
        if port in FEEDBACK_PERIOD_S:
            self._feed(client, FEEDBACK_PERIOD_S[port])
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
        try:
            values = self._execute(port, request)
        except Exception as error:
            refusal = error if isinstance(error, RefusedError) else RefusedError(ErrorId.FAILED)
            if refusal is not error:
                LOG.exception("emulated MG400: %s failed and was refused", request.text)
            if "split-refusals" in self.faults and not self._bare:
                client.sendall(f"{refusal.error_id},{{}},;".encode())
                time.sleep(0.02)  # the client receives two pieces
                reply = f"{request.text};"
            else:
                reply = f"{refusal.error_id},{{}},{request.text};"
        else:  # a connection that is lost while it waits is no command that failed
            if request.name in ("sync", "syncall") and not self._wait_until_done(client):
                return
            reply = f"0,{{{values}}},{request.text};"
        if port == MOTION_PORT and "no-move-reply" in self.faults and request.name not in ("sync", "syncall"):
            return
        if not self._bare:
            client.sendall(reply.encode())
        elif port == DASHBOARD_PORT or self._lenient:
            client.sendall(f"{request.text};".encode())

    def _execute(self, port: int, request: Request) -> str:
        refuse_if("no-tcp-mode" in self.faults)
        alone = not self._servers[MOTION_PORT].clients
        refuse_if(alone and ("needs-motion-client" in self.faults or "motion-port-closed" in self.faults), ErrorId.NO_SUCH_COMMAND)
        commands = self._commands.dashboard if port == DASHBOARD_PORT else self._commands.motion
        refuse_if(request.name not in commands, ErrorId.NO_SUCH_COMMAND)
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
    user, tool = arm.users[arm.user], arm.tools[arm.tool]
    joints, before = arm.track.joints_deg(now_s), arm.track.joints_deg(now_s - DIFFERENCE_S)
    seen = _tool_in_user_frame(arm, joints, user, tool)
    speed = (seen - _tool_in_user_frame(arm, before, user, tool)) / DIFFERENCE_S
    half_turn = np.radians(seen[3]) / 2
    packet = np.zeros((), PACKET)
    fields: dict[str, object] = {
        "length": PACKET_BYTES,
        "test_value": TEST_VALUE,
        "digital_out": arm.digital_out,
        "mode": int(mode),
        "unix_ms": int(time.time() * 1000),
        "speed_scaling": arm.percent["speedfactor"],
        **dict.fromkeys(("q_target", "q_actual"), [*joints, 0, 0]),
        **dict.fromkeys(("qd_target", "qd_actual"), [*((joints - before) / DIFFERENCE_S), 0, 0]),
        **dict.fromkeys(("tool_target", "tool_actual"), [*seen, 0, 0]),
        **dict.fromkeys(("tcp_speed_target", "tcp_speed_actual"), [*speed, 0, 0]),
        "user_index": arm.user,
        "tool_index": arm.tool,
        "queue_runs": arm.queue_runs,
        "paused": arm.paused,
        "enabled": arm.enabled,
        "drag": mode == Mode.BACKDRIVE,
        "running": mode == Mode.RUNNING,
        "error": bool(arm.alarms),
        "jog": mode == Mode.JOG,
        "robot_type": ROBOT_TYPE_MG400,
        "load": arm.load,
        "user": [user.x, user.y, user.z, user.r, 0, 0],
        "tool": [tool.x, tool.y, tool.z, tool.r, 0, 0],
        **dict.fromkeys(("target_quaternion", "actual_quaternion"), [np.cos(half_turn), 0, 0, np.sin(half_turn)]),
    }
    for name, value in fields.items():
        packet[name] = value
    return packet


def _tool_in_user_frame(arm: Mg400Controller, joints: np.ndarray, user: PlanarFrame, tool: PlanarFrame) -> np.ndarray:
    """X, Y, Z, R of the tool in the user frame."""
    flange = PlanarFrame.of_pose(arm.kinematics.forward(joints))
    return (user.inverse() @ flange @ tool).pose[[0, 1, 2, 5]]
