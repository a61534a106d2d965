"""The MG400's connections, one for requests and replies and one that keeps the newest feedback, and the data on them.

The data are ports, error ids, modes, replies and the feedback packet, which the emulator uses too.
"""

import contextlib
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from threading import Condition, Event, RLock, Thread

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S
from hardware.arms.awake import awake_s
from hardware.arms.supervisor import Supervisor
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError

DASHBOARD_PORT, MOTION_PORT = 29999, 30003
FEEDBACK_PERIOD_S = {30004: 0.008, 30005: 0.2, 30006: 0.05}
LARGEST_PORT = 65535
DEFAULT_HOSTS = {"LAN1": "192.168.1.6", "LAN2": "192.168.2.6", "Wi-Fi": "192.168.9.1"}

# Speeds at SpeedL and SpeedJ of 100 %. The vendor's figures are not verified on an arm. They are assumed high, so that an arm
# never moves faster than requested.
MAX_LINEAR_MM_S, MAX_JOINT_DEG_S = 1000.0, 300.0


def address_of(text: str) -> tuple[str, int]:
    """Host ("" if there is none) and offset of the ports of ``ADDRESS[:DASHBOARD_PORT]``.

    Raises
    ------
    DeviceError
        The port is not a number, or not valid.
    """
    host, _, port = text.partition(":")
    if port and not port.isdecimal():
        raise DeviceError(f"mg400:{text}: '{port}' is no port; for example mg400:127.0.0.1:{DASHBOARD_PORT}")
    offset = int(port) - DASHBOARD_PORT if port else 0
    require_ports(offset)
    return host, offset


def require_ports(offset: int) -> None:
    """``DeviceError`` if the arm's ports plus the offset are not valid ports."""
    lowest, highest = DASHBOARD_PORT + offset, max(FEEDBACK_PERIOD_S) + offset
    if lowest < 1 or highest > LARGEST_PORT:
        remedy = f"give a dashboard port (29999 + the offset) between 1 and {LARGEST_PORT - 7}"
        raise DeviceError(f"mg400: no ports {lowest} to {highest}; {remedy}")


class ErrorId(IntEnum):
    """First number of a reply. The last two become -3000n and -4000n, where n is the number of the parameter, from 1."""

    ACCEPTED = 0
    FAILED = -1
    NO_SUCH_COMMAND = -10000
    PARAMETER_COUNT = -20000
    PARAMETER_TYPE = -30000
    PARAMETER_RANGE = -40000


class Mode(IntEnum):
    """``RobotMode``."""

    INIT = 1
    BRAKE_OPEN = 2
    POWER_STATUS = 3
    DISABLED = 4
    ENABLED = 5
    BACKDRIVE = 6
    RUNNING = 7
    RECORDING = 8
    ERROR = 9
    PAUSE = 10
    JOG = 11


@dataclass(frozen=True)
class Reply:
    """One reply; ``error_id`` is None for the bare echo of old firmware."""

    error_id: int | None
    values: str
    echo: str

    @property
    def name(self) -> str:
        return self.echo.split("(")[0].strip().lower()

    def alarms(self) -> list[int]:
        """The alarms in a reply to ``GetErrorID``, from 5 to 7 groups. Values that are not whole numbers are left out."""
        listed = [text.strip() for group in re.findall(r"\[([^\[\]]*)\]", self.values) for text in group.split(",")]
        return [int(text) for text in listed if re.fullmatch(r"-?\d+", text)]


def take_reply(buffer: str) -> tuple[Reply | None, str]:
    """The first complete reply in the received text, and the remaining text.

    Replies end at ``;``, except that a refusal may come as two fragments: ``-1,{},;EnableRobot();``.
    """
    end = buffer.find(";")
    while end >= 0:
        text = buffer[:end].strip()
        numbered = re.fullmatch(r"(-?\d+)\s*,\s*\{(.*)\}\s*,?\s*;?\s*(.*)", text, re.DOTALL)
        if numbered and numbered[3]:
            return Reply(int(numbered[1]), numbered[2], numbered[3]), buffer[end + 1 :]
        if not numbered:
            return Reply(None, "", text), buffer[end + 1 :]
        end = buffer.find(";", end + 1)  # the echo follows in the second fragment
    return None, buffer


def why_refused(error_id: int, request: str) -> str:
    """The meaning of an error id, with the remedy."""
    if error_id == ErrorId.FAILED:
        remedy = "If it refuses everything it is not in TCP mode: in DobotStudio Pro choose TCP/IP Secondary Development"
        return f"the arm refused {request} (-1). {remedy}; else it is disabled, in error, or the user or tool frame does not exist"
    if error_id == ErrorId.NO_SUCH_COMMAND:
        remedy = "close other programs (DobotStudio Pro, scripts), then connect again; else its firmware is too old"
        held = "If every command has this reply, the motion port 30003 is not open or another client holds it"
        return f"the arm knows no {request} (-10000). {held}: {remedy}"
    if error_id == ErrorId.PARAMETER_COUNT:
        return f"wrong number of parameters in {request} (-20000); its firmware may be of another version"
    kind, n = ("range", -error_id - 40000) if error_id < ErrorId.PARAMETER_RANGE else ("type", -error_id - 30000)
    return f"parameter {n} of {request} has the wrong {kind} ({error_id})"


PACKET_BYTES = 1440
TEST_VALUE = 0x0123456789ABCDEF
_LENGTH = PACKET_BYTES.to_bytes(2, "little")
TEST_BYTES = TEST_VALUE.to_bytes(8, "little")
TEST_OFFSET = 48
ROBOT_TYPE_MG400 = 1

_SIX = ("<f8", (6,))
_FIELDS = {  # name: (format, offset)
    "length": ("<u2", 0),
    "digital_out": ("<u8", 16),
    "mode": ("<u8", 24),
    "unix_ms": ("<u8", 32),
    "test_value": ("<u8", TEST_OFFSET),
    "speed_scaling": ("<f8", 64),
    "q_target": (_SIX, 192),
    "qd_target": (_SIX, 240),
    "q_actual": (_SIX, 432),
    "qd_actual": (_SIX, 480),
    "tool_actual": (_SIX, 624),  # X, Y, Z, R, -, -: R is the fourth
    "tcp_speed_actual": (_SIX, 672),
    "tool_target": (_SIX, 768),
    "tcp_speed_target": (_SIX, 816),
    "user_index": ("u1", 1012),
    "tool_index": ("u1", 1013),
    "queue_runs": ("u1", 1014),
    "paused": ("u1", 1015),
    "enabled": ("u1", 1026),
    "drag": ("u1", 1027),
    "running": ("u1", 1028),
    "error": ("u1", 1029),
    "jog": ("u1", 1030),
    "robot_type": ("u1", 1031),
    "load": (("<f8", (4,)), 1168),  # kg, and its centre x, y, z in mm
    "user": (_SIX, 1200),
    "tool": (_SIX, 1248),
    "target_quaternion": (("<f8", (4,)), 1352),
    "actual_quaternion": (("<f8", (4,)), 1384),
}
_FORMATS, _OFFSETS = zip(*_FIELDS.values(), strict=True)
PACKET = np.dtype({"names": list(_FIELDS), "formats": _FORMATS, "offsets": _OFFSETS, "itemsize": PACKET_BYTES})


def pose_in(packet: np.void) -> np.ndarray:
    """Pose (6,) of the tool in a packet."""
    x, y, z, turn = packet["tool_actual"][:4]
    return np.array([x, y, z, 0.0, 0.0, turn])


def newest_packet(buffer: bytes, *, lenient: bool = False) -> tuple[np.void | None, bytes]:
    """The newest whole packet in the received bytes.

    A packet counts if its length is 1440, its test value is at its place, no other packet begins inside it, and it is
    followed by another packet or by nothing yet. Otherwise it was cut short. ``lenient``: the test value may be anything.

    Returns
    -------
    packet : record of ``PACKET`` or None
    rest : bytes
        The bytes after it.
    """
    newest, begin = None, 0
    mark, offset = (_LENGTH, 0) if lenient else (TEST_BYTES, TEST_OFFSET)
    at = buffer.find(mark)
    while at >= 0:
        start, following = at - offset, buffer.find(mark, at + 1)
        alone = lenient or not 0 <= following < start + PACKET_BYTES
        whole = alone and start >= 0 and start + PACKET_BYTES <= len(buffer)
        if whole and buffer.startswith(_LENGTH, start) and _LENGTH.startswith(buffer[start + PACKET_BYTES :][:2]):
            newest, begin = np.frombuffer(buffer[start : start + PACKET_BYTES], PACKET)[0], start
            following = buffer.find(mark, at + PACKET_BYTES)
        at = following
    if newest is None:
        return None, buffer[-2 * PACKET_BYTES :]
    return newest, buffer[begin + PACKET_BYTES :]


def describe_bytes(came: bytes) -> str:
    """Description of unexpected bytes, in words: text is quoted, other bytes are counted."""
    text = came[:60].split(b"\r\n")[0]
    if not came:
        return "nothing"
    if text.isascii() and text.decode("ascii").isprintable():
        return f"the text '{text.decode('ascii')}'"
    return f"{len(came)} bytes that begin with {came[:8].hex(' ')}"


def why_no_packet(came: bytes, *, closed: bool) -> str:
    """Reason why the bytes from a feedback port hold no packet of an MG400, with the remedy."""
    if not came and closed:
        return "it closed the connection at once: another program holds the arm (DobotStudio Pro, a script). Close it, then connect again"
    if not came:
        other = "another program holds the feedback, or this is no MG400 (a server that waits for a request)"
        remedy = "Check the address, close other programs, else restart the arm"
        return f"connected, but nothing came: the controller hangs, {other}. {remedy}"
    packet, _ = newest_packet(came, lenient=True)
    if packet is not None:
        remedy = "an emulator, or a controller of another kind. If their poses can be trusted, use it as 'mg400-lenient:ADDRESS'"
        return f"packets came whose test value is {int(packet['test_value']):#x} instead of {TEST_VALUE:#x}: {remedy}"
    if describe_bytes(came).startswith("the text"):
        return f"{describe_bytes(came)} came instead of feedback: this is no MG400. Check address and port"
    remedy = "its firmware or the arm may be of another kind. Check the address"
    return f"{describe_bytes(came)} came, and no packet of {PACKET_BYTES} bytes: {remedy}"


# Longest wait for a connection, in s.
CONNECT_TIMEOUT_S = 2.0
# Longest wait for a reply, in s.
REPLY_TIMEOUT_S = 2.0
# Time, s, of silence after which a feedback connection is closed and opened again.
SILENCE_S = FEEDBACK_AGE_S
# Interval in s at which a wait for a reply checks whether the arm still answers.
LOOK_S = 0.05
# Pause before feedback is connected again, in s. Public clients wait 5 s, but a servo that stands still needs feedback sooner.
RECONNECT_S = 0.5
# Difference of a joint between two packets, deg, above which the arm is in motion.
MOTION_DEG = 1e-4
# Interval in s at which a wait for feedback after a stall checks it.
STALL_CHECK_S = 0.01
# Largest number of bytes in one read: more than half a second of feedback.
BACKLOG_BYTES = 64 * PACKET_BYTES


class NoReplyError(DeviceError):
    """No reply came in time."""


class CommandPort:
    """Requests and their replies over one connection. Calls from several threads take turns."""

    def __init__(self, name: str, host: str, port: int) -> None:
        self._name, self._address = name, (host, port)
        self._socket: socket.socket | None = None
        self._lock, self._buffer = RLock(), ""
        self._heard = False  # whether anything came from this address
        self._last_words: tuple[bytes, ...] = ()
        self._supervisor = Supervisor()

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self._socket is not None

    def open(self, *, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        self.close()
        try:
            self._socket = socket.create_connection(self._address, timeout_s)
        except OSError as error:
            host, port = self._address
            check = f"Check that the arm is on, that this machine has an address in its network ('ping {host}')"
            remedy = f"{check} and that no other program holds the port; without an arm: 'twin emulate mg400' and mg400:127.0.0.1"
            raise DeviceNotConnectedError(f"{self._name}: no connection to {host}:{port} ({error.strerror or error}). {remedy}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.supervise(*self._last_words)

    def supervise(self, *last_words: bytes) -> None:
        """Have a further process send these requests if this program dies, over this connection or one that is opened after it.

        Without requests there is no such process.
        """
        with self._lock:
            self._last_words = last_words
            self._supervisor.end()
            if self._socket is not None:
                self._supervisor = Supervisor(self._socket.fileno, last_words)

    def close(self) -> None:
        with self._lock:
            self._supervisor.end()
            if self._socket is not None:
                self._socket.close()
            self._socket, self._buffer = None, ""

    def request(self, text: str, *, timeout_s: float = REPLY_TIMEOUT_S, look: Callable[[], object] = lambda: None) -> Reply:
        """Send a request and wait for its reply. Late replies to other requests are dropped. ``look`` is called meanwhile and may raise an
        error.

        Raises
        ------
        DeviceNotConnectedError
            The connection is lost.
        NoReplyError
            No reply came in time.
        """
        with self._lock:
            self.send(text)
            deadline = awake_s() + timeout_s
            while (left_s := deadline - awake_s()) > 0:
                if reply := self.poll(text, wait_s=min(LOOK_S, left_s)):
                    return reply
                look()
            came = self._buffer
        host, port = self._address
        instead = f", {describe_bytes(came.encode('ascii', errors='replace'))} came instead: is this an MG400?" if came else ""
        late = f"no reply to {text} from {host}:{port} within {timeout_s:g} s"
        raise NoReplyError(f"{self._name}: {late}{instead}; check the arm, then connect again")

    def send(self, text: str) -> None:
        """Send one command; its reply is read by ``poll``."""
        with self._lock:
            if self._socket is None:
                raise DeviceNotConnectedError(f"{self._name}: the connection was lost; disconnect() and connect() again")
            try:
                self._socket.settimeout(REPLY_TIMEOUT_S)
                self._socket.sendall(text.encode("ascii"))
            except OSError as error:
                self._lost_error(error)

    def poll(self, request: str, *, wait_s: float) -> Reply | None:
        """The reply to a request, if it comes within ``wait_s``."""
        with self._lock:
            deadline = time.monotonic() + wait_s
            wanted = request.split("(")[0].lower()
            while True:
                reply, self._buffer = take_reply(self._buffer)
                if reply is not None and reply.name == wanted:
                    return reply
                if reply is None and (time.monotonic() >= deadline or not self._receive(deadline)):
                    return None

    def _receive(self, deadline: float) -> bool:
        if self._socket is None:
            raise DeviceNotConnectedError(f"{self._name}: the connection was lost; disconnect() and connect() again")
        try:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-4))
            data = self._socket.recv(4096)
        except TimeoutError:
            return False
        except OSError as error:
            self._lost_error(error)
        if not data:
            self._lost_error(None)
        self._heard = True
        self._buffer += data.decode("ascii", errors="replace")
        return True

    def _lost_error(self, error: OSError | None) -> None:
        came = self._buffer
        self.close()
        reason = f" ({error.strerror or error})" if error else ""
        if came and came.lstrip()[:1] not in "-0123456789":  # it can't be the beginning of a reply
            said, (host, port) = describe_bytes(came.encode("ascii", errors="replace")), self._address
            strange = f"{said} came from {host}:{port}: this is no MG400. Check address and port"
            raise DeviceNotConnectedError(f"{self._name}: {strange}") from error
        why = "Check its power and cable" if self._heard else "Another program may hold it (DobotStudio Pro, a script): close that"
        lost = f"the arm closed the connection{reason}. {why}, then disconnect() and connect() again"
        raise DeviceNotConnectedError(f"{self._name}: {lost}") from error


class Feedback:
    """Keeps the newest feedback packet. A thread reads all packets, and reconnects after silence.

    Parameters
    ----------
    name, host : str
    ports : tuple of int
        Tried in order.
    lenient : bool
        Whether packets count whatever their test value is.
    """

    def __init__(self, name: str, host: str, ports: tuple[int, ...], *, lenient: bool = False) -> None:
        self._name, self._host, self._ports, self._lenient = name, host, ports, lenient
        self._came, self._closed = b"", False  # the first received bytes without a packet, and whether the newest connection was closed
        self._joints: np.ndarray | None = None
        self.turned_s = -np.inf  # when the joints were last seen in motion
        self._newest: tuple[np.void, float] | None = None
        self._heard_s = 0.0  # when the newest packet arrived, on the clock of ``awake_s``
        self._arrived, self._ended = Condition(), Event()
        self._thread: Thread | None = None

    def open(self) -> None:
        """Connect to the first port that accepts and wait for a packet.

        Raises
        ------
        DeviceNotConnectedError
            No port accepts, or no packet arrives.
        """
        connection = self._connect()
        self._ended = Event()  # a new event: an earlier reader that still runs must keep its own and end
        self._thread = Thread(target=self._read_loop, args=(connection, self._ended), daemon=True, name="mg400-feedback")
        self._thread.start()
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._newest is not None, CONNECT_TIMEOUT_S):
                why = why_no_packet(self._came, closed=self._closed)
                self.close()
                raise DeviceNotConnectedError(f"{self._name}: no feedback from {self._host}: {why}")

    def close(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._thread, self._newest, self._came = None, None, b""

    def age_s(self) -> float:
        """How long ago the newest packet arrived; infinite if none did."""
        with self._arrived:
            newest = self._newest
        return float("inf") if newest is None else time.monotonic() - newest[1]

    def newest(self, max_age_s: float) -> tuple[np.void, float]:
        """The newest packet and the time of its arrival. After a stall of this process it waits for what arrived meanwhile.

        Raises
        ------
        StaleDataError
            The packet is older than ``max_age_s``.
        """
        with self._arrived:
            while (newest := self._newest) is not None and time.monotonic() - newest[1] > max_age_s > awake_s() - self._heard_s:
                self._arrived.wait(STALL_CHECK_S)
        age_s = np.inf if newest is None else time.monotonic() - newest[1]
        if newest is None or age_s > max_age_s:
            remedy = "the reader keeps trying to reconnect. Don't trust the last pose: stop, check the cable, then go on"
            raise StaleDataError(f"{self._name}: no feedback for {age_s:.1f} s (allowed {max_age_s:g} s); {remedy}")
        return newest

    def _connect(self) -> socket.socket:
        errors = []
        for port in self._ports:
            try:
                return socket.create_connection((self._host, port), CONNECT_TIMEOUT_S)
            except OSError as error:
                errors.append(f"{port}: {error.strerror or error}")
        remedy = "check that it is on (without an arm: 'twin emulate mg400'), and close other programs that use the arm"
        deaf = f"no feedback port of {self._host} takes connections ({'; '.join(errors)})"
        raise DeviceNotConnectedError(f"{self._name}: {deaf}; {remedy}")

    def _read_loop(self, connection: socket.socket, ended: Event) -> None:
        while not ended.is_set():
            with contextlib.suppress(OSError):
                self._read_until_silent(connection, ended)
            connection.close()
            if ended.wait(RECONNECT_S):
                return
            with contextlib.suppress(DeviceNotConnectedError):
                connection = self._connect()
        connection.close()

    def _read_until_silent(self, connection: socket.socket, ended: Event) -> None:
        connection.settimeout(SILENCE_S / 4)
        buffer, heard_s = b"", awake_s()
        while not ended.is_set() and awake_s() - heard_s < SILENCE_S:
            try:
                data = connection.recv(BACKLOG_BYTES)
            except TimeoutError:
                continue
            self._closed = not data
            if not data:
                return
            if self._newest is None:
                self._came = (self._came + data)[-2 * PACKET_BYTES :]
            packet, buffer = newest_packet(buffer + data, lenient=self._lenient)
            if packet is not None and len(data) < BACKLOG_BYTES:  # otherwise newer packets are still waiting to be read
                valid_s, heard_s = time.monotonic(), awake_s()
                if self._joints is not None and np.abs(packet["q_actual"] - self._joints).max() > MOTION_DEG:
                    self.turned_s = valid_s
                self._joints = packet["q_actual"].copy()
                with self._arrived:
                    self._newest, self._heard_s = (packet, valid_s), heard_s
                    self._arrived.notify_all()
