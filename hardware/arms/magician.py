"""Driver of the Dobot Magician over its serial port.

A message on the line is ``AA AA | len | id | ctrl | params | checksum``. The emulator uses these messages too.
"""

import contextlib
import struct
import time
from dataclasses import dataclass, replace
from enum import IntEnum
from threading import RLock

import numpy as np
import serial
from serial.tools import list_ports

from hardware.arms.arm import FEEDBACK_AGE_S, POLL_S, ArmState, KinematicArm
from hardware.arms.awake import awake_s
from hardware.arms.motion import MAGICIAN, LinkageKinematics, explain
from hardware.arms.supervisor import Supervisor
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError, on_error
from twin.errors import ErrorsAs

BAUD = 115200  # 8N1
USB_VENDORS = {4292: "CP210x", 6790: "CH340"}
HEADER = b"\xaa\xaa"
LENGTH_LIMIT = 0xAA  # every length is below 0xAA, so AA AA AA is never a header followed by a length
WRITE, QUEUED = 1, 2  # bits of the ctrl byte


class Id(IntEnum):
    """Commands."""

    GET_POSE = 10
    RESET_POSE = 11
    ALARMS = 20  # read: the state; write: clear them (the manual prints 21, devices use 20)
    HOME_PARAMS = 30
    HOME = 31
    HANDHELD_OUTPUT = 41
    END_EFFECTOR = 60
    LASER = 61
    SUCTION = 62
    GRIPPER = 63
    JOG_JOINT_PARAMS = 70
    JOG_COORDINATE_PARAMS = 71
    JOG_COMMON_PARAMS = 72
    JOG = 73
    PTP_JOINT_PARAMS = 80
    PTP_COORDINATE_PARAMS = 81
    PTP_JUMP_PARAMS = 82
    PTP_COMMON_PARAMS = 83
    PTP = 84
    CP_PARAMS = 90
    CP = 91
    CP_LASER = 92
    ARC_PARAMS = 100
    ARC = 101
    WAIT = 110
    IO = 131
    MOTOR = 135  # of a conveyor or a slide
    MOTOR_STEPS = 136
    COLOR = 137
    INFRARED = 138
    QUEUE_START = 240
    QUEUE_STOP = 241
    QUEUE_FORCE_STOP = 242
    QUEUE_CLEAR = 245
    QUEUE_INDEX = 246
    QUEUE_SPACE = 247


class Ptp(IntEnum):
    """Modes of a point-to-point command."""

    JUMP_XYZ = 0
    MOVJ_XYZ = 1
    MOVL_XYZ = 2
    JUMP_ANGLE = 3
    MOVJ_ANGLE = 4
    MOVL_ANGLE = 5
    MOVJ_INC = 6
    MOVL_INC = 7
    MOVJ_XYZ_INC = 8
    JUMP_MOVL_XYZ = 9


@dataclass(frozen=True)
class Message:
    """The content of one frame."""

    id: int
    ctrl: int = 0
    params: bytes = b""

    @property
    def is_write(self) -> bool:
        """Whether the message sets something."""
        return bool(self.ctrl & WRITE)

    @property
    def is_queued(self) -> bool:
        """Whether the command goes through the arm's queue."""
        return bool(self.ctrl & QUEUED)

    def to_bytes(self) -> bytes:
        """The frame; ``ValueError`` if the parameters are too long for one."""
        length = 2 + len(self.params)
        if length >= LENGTH_LIMIT:
            raise ValueError(f"{len(self.params)} bytes of parameters; a frame holds at most {LENGTH_LIMIT - 3}")
        body = bytes([self.id, self.ctrl]) + self.params
        return HEADER + bytes([length]) + body + bytes([checksum(body)])


def checksum(body: bytes) -> int:
    """Two's complement of the sum of id, ctrl and params."""
    return -sum(body) & 0xFF


def take_message(buffer: bytes) -> tuple[Message | None, bytes]:
    """The first valid frame in the received bytes, and the remaining bytes.

    Noise and frames with a wrong checksum are skipped. AA may occur within the parameters, so only a whole frame
    with a correct checksum counts. Bytes that may be the beginning of a frame are kept.
    """
    start, unfinished = buffer.find(HEADER), None
    while start >= 0:
        if start + 3 > len(buffer):
            unfinished = start if unfinished is None else unfinished
            break
        end = start + 3 + buffer[start + 2] + 1
        if 2 <= buffer[start + 2] < LENGTH_LIMIT:
            body = buffer[start + 3 : end - 1]
            if end <= len(buffer) and buffer[end - 1] == checksum(body):
                return Message(body[0], body[1], body[2:]), buffer[end:]
            if end > len(buffer) and unfinished is None:
                unfinished = start
        start = buffer.find(HEADER, start + 1)
    if unfinished is not None:
        return None, buffer[unfinished:]
    return None, buffer[-1:] if buffer.endswith(HEADER[:1]) else b""


# Longest wait for a reply, in s. A reply usually takes about 10 ms. All tries together take as long as feedback may be old.
REPLY_TIMEOUT_S = 0.2
# Times that a command is sent until a reply comes. Moves are absolute, so a repeated move does not move the arm.
TRIES = 4
# Longest time of homing, in s.
HOME_TIMEOUT_S = 60.0
# Errors that pyserial raises when a port vanishes.
PORT_ERRORS: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError, ValueError)
with contextlib.suppress(ImportError):  # Windows has no such module
    from termios import error as terminal_error

    PORT_ERRORS += (terminal_error,)
# Bytes of the replies to commands that read.
REPLY_BYTES = {Id.GET_POSE: 32, Id.ALARMS: 16, Id.QUEUE_INDEX: 8}
# Messages that stop the arm and empty its queue if this program dies.
LAST_WORDS = tuple(Message(id, WRITE).to_bytes() for id in (Id.QUEUE_FORCE_STOP, Id.QUEUE_CLEAR))
# Bytes of a queue index.
INDEX_BYTES = 8
# Acceleration in mm/s2 (deg/s2) for each mm/s (deg/s) of speed, in 1/s: full speed is reached within a quarter of a second.
ACCELERATION = 4.0


def attached_ports() -> list[str]:
    """The ports of attached USB adapters of a Magician's kind."""
    return [port.device for port in list_ports.comports() if port.vid in USB_VENDORS]


def attached_port() -> str:
    """The port of the only attached adapter of a Magician's kind; ``DeviceError`` if there are none or several."""
    found = attached_ports()
    if len(found) != 1:
        adapters = f"{len(found) or 'no'} serial adapters of a Magician's kind ({', '.join(USB_VENDORS.values())})"
        there = ", ".join(found) or "plug in its USB cable"
        raise DeviceError(f"{adapters} are attached: {there}; name one, for example magician:/dev/ttyUSB0")
    return found[0]


class Magician(KinematicArm):
    """A Dobot Magician.

    The arm has no command that switches its motors. ``enable`` allows moves; ``disable`` stops the arm and refuses further moves.

    Parameters
    ----------
    port : str
        For example ``/dev/ttyUSB0``.
    tool_x_mm : float
        Reach of the tool beyond the wrist.
    supervised : bool
        Whether a further process stops the arm if this program dies while the arm is enabled.
    """

    axes = 4
    kinematics: LinkageKinematics

    def __init__(self, port: str, *, tool_x_mm: float = 0.0, supervised: bool = True) -> None:
        self._supervised = supervised
        self._supervisor = Supervisor()
        self.name, self._port_name = f"Magician at {port}", port
        self.kinematics = replace(MAGICIAN, r0_mm=tool_x_mm)
        self._serial: serial.Serial | None = None
        self._lock, self._buffer = RLock(), b""
        self._enabled = False
        self._lost = ""  # how the connection was lost
        self._last_index: int | None = None  # queue index of the newest move; None if no move is pending

    @property
    def is_connected(self) -> bool:
        return self._serial is not None

    def connect(self) -> None:
        self._require_disconnected()
        self._lost = ""
        try:
            self._serial = serial.Serial(self._port_name, BAUD, timeout=0.05, write_timeout=REPLY_TIMEOUT_S, exclusive=True)
        except PORT_ERRORS as error:
            there = f"Magicians attached: {', '.join(attached_ports()) or 'none'}. Plug in the USB cable and switch the arm on"
            remedy = "on Linux the user must be in the group 'dialout'; and no other program may hold the port"
            emulated = "without an arm: 'twin emulate magician'"
            raise DeviceNotConnectedError(f"{self.name}: can't open the port ({error}); {there}; {remedy}; {emulated}") from error
        with on_error(self._close):
            self._buffer = b""
            self._request(Id.GET_POSE)

    def disconnect(self) -> None:
        if self.is_connected:
            self._disconnect(close=self._close)

    def enable(self) -> None:
        self._require_connected()
        if alarms := self._alarms():
            raise DeviceError(f"{self.name}: {explain(alarms)}")
        self._request(Id.END_EFFECTOR, struct.pack("<3f", self.kinematics.r0_mm, 0.0, 0.0), ctrl=WRITE)
        self._request(Id.PTP_COMMON_PARAMS, struct.pack("<2f", 100.0, 100.0), ctrl=WRITE)
        self._forget_queue()
        self._request(Id.QUEUE_START, ctrl=WRITE)
        if self._supervised and not self._enabled:
            self._supervisor = Supervisor(self._port().fileno, LAST_WORDS)
        self._enabled = True

    def disable(self) -> None:
        self.stop()
        self._enabled = False
        self._supervisor.end()

    def clear_error(self) -> None:
        self._forget_queue()
        self._request(Id.ALARMS, ctrl=WRITE)
        self._request(Id.QUEUE_START, ctrl=WRITE)

    def stop(self) -> None:
        self._require_connected()
        self._unstopped = True
        with ErrorsAs(DeviceError, lambda error: type(error)(f"{self.name}: can't be stopped and may move. Switch it off! {error}")):
            self._forget_queue()
            self._request(Id.QUEUE_START, ctrl=WRITE)  # the empty queue must run, or the next move would never begin
        self._unstopped = False

    def home(self, *, timeout_s: float = HOME_TIMEOUT_S) -> None:
        """Find the joints' zeros. The arm moves through its whole range: keep clear of it."""
        self._require_enabled()
        with self._watch_move():
            self._last_index = self._index_of(self._request(Id.HOME, struct.pack("<I", 0), ctrl=WRITE | QUEUED))
            self._await_queue(timeout_s)

    def state(self, *, max_age_s: float = FEEDBACK_AGE_S) -> ArmState:
        self._require_connected()
        begun_s, awake_from_s = time.monotonic(), awake_s()
        try:
            until_s = awake_from_s + max_age_s
            last = self._last_index
            moving = last is not None and self._index_of(self._request(Id.QUEUE_INDEX, until_s=until_s)) < last
            values = np.array(struct.unpack("<8f", self._request(Id.GET_POSE, until_s=until_s)))
            alarms = self._alarms(until_s)
        except DeviceNotConnectedError:
            raise
        except DeviceError as error:
            raise StaleDataError(f"{error}. Don't trust the last pose") from error
        if (took_s := awake_s() - awake_from_s) > max_age_s:
            raise StaleDataError(f"{self.name}: the arm took {took_s:.2f} s to report its state (allowed {max_age_s:g} s)")
        pose = np.array([*values[:3], 0.0, 0.0, values[3]])
        self._require_possible(pose)
        return ArmState(pose, values[4:], begun_s, self._enabled, moving, explain(alarms) if alarms else "")

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        super().set_speed(linear_mm_s, angular_deg_s)
        line = (linear_mm_s, angular_deg_s, ACCELERATION * linear_mm_s, ACCELERATION * angular_deg_s)
        joints = [angular_deg_s] * 4 + [ACCELERATION * angular_deg_s] * 4
        self._request(Id.PTP_COORDINATE_PARAMS, struct.pack("<4f", *line), ctrl=WRITE)
        self._request(Id.PTP_JOINT_PARAMS, struct.pack("<8f", *joints), ctrl=WRITE)

    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        self._require_enabled()
        self._require_within(joints)
        if alarms := self._alarms():
            raise DeviceError(f"{self.name}: {explain(alarms)}")
        begun_s = time.monotonic()
        mode, numbers = (Ptp.MOVJ_ANGLE, joints) if pose is None else (Ptp.MOVL_XYZ, pose[[0, 1, 2, 5]])
        self._last_index = self._index_of(self._request(Id.PTP, struct.pack("<B4f", mode, *numbers), ctrl=WRITE | QUEUED))
        if not wait:
            return
        self._await_queue(timeout_s)
        settled = self.kinematics.forward(joints) if pose is None else pose
        self._wait_until_settled(settled, timeout_s=max(begun_s + timeout_s - time.monotonic(), 0.2))

    def _await_queue(self, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while (state := self.state()).moving or state.error:
            self._require_on_way(state, deadline, timeout_s)
            time.sleep(POLL_S)

    def _forget_queue(self) -> None:
        """Stop at once and empty the queue."""
        self._require_connected()
        self._request(Id.QUEUE_FORCE_STOP, ctrl=WRITE)
        self._request(Id.QUEUE_CLEAR, ctrl=WRITE)
        self._last_index = None

    def _alarms(self, until_s: float = np.inf) -> list[int]:
        bits = int.from_bytes(self._request(Id.ALARMS, until_s=until_s), "little")
        return [n for n in range(bits.bit_length()) if bits >> n & 1]

    def _index_of(self, payload: bytes) -> int:
        if len(payload) < INDEX_BYTES:
            raise DeviceError(f"{self.name}: did not take the command, its queue is full; wait for its moves, or call stop()")
        return int.from_bytes(payload[:INDEX_BYTES], "little")

    def _require_enabled(self) -> None:
        self._require_connected()
        if not self._enabled:
            raise DeviceError(f"{self.name}: not enabled; call enable() first")

    def _request(self, id: Id, params: bytes = b"", *, ctrl: int = 0, until_s: float = np.inf) -> bytes:
        """Send a command and wait for the reply with the same id and ctrl.

        The command is sent again if the reply is missing or damaged, but not after ``until_s`` of ``awake_s``.
        """
        sent = Message(id, ctrl, params).to_bytes()
        with self._lock:
            tries = 0
            while tries < TRIES and awake_s() < until_s:
                tries += 1
                port = self._port()
                try:
                    port.reset_input_buffer()
                    self._buffer = b""
                    port.write(sent)
                    if (reply := self._reply(port, id, ctrl)) is not None:
                        return reply.params
                except serial.SerialTimeoutException:  # the arm takes nothing, or this process was stalled
                    continue
                except PORT_ERRORS as error:
                    self._close()
                    moves = "The arm executes the moves in its queue: switch it off if it moves! Plug the cable in, then connect() again"
                    self._lost = f"{self.name}: the port vanished ({error}). {moves}"
                    raise DeviceNotConnectedError(self._lost) from error
        remedy = "switch the arm on, check that the port is a Magician's and the cable is sound"
        raise DeviceError(f"{self.name}: no valid reply to command {int(id)} in {tries} tries of {REPLY_TIMEOUT_S:g} s; {remedy}")

    def _port(self) -> serial.Serial:
        """The open port; ``DeviceNotConnectedError`` where there is none."""
        if self._serial is None:
            raise DeviceNotConnectedError(self._lost or f"{self.name}: not connected; call connect() first")
        return self._serial

    def _require_connected(self) -> None:
        self._port()

    def _reply(self, port: serial.Serial, id: Id, ctrl: int) -> Message | None:
        """The reply to a command, if it comes in time.

        Raises
        ------
        DeviceError
            A reply of another length came, so the attached device is not a Magician.
        """
        wanted = REPLY_BYTES.get(id) if ctrl == 0 else None
        deadline = awake_s() + REPLY_TIMEOUT_S
        while awake_s() < deadline:
            self._buffer += port.read(max(1, port.in_waiting))
            message, self._buffer = take_message(self._buffer)
            while message is not None:
                if (message.id, message.ctrl) == (id, ctrl) and wanted not in (None, len(message.params)):
                    said = f"replied {len(message.params)} bytes to command {int(id)} instead of {wanted}"
                    raise DeviceError(f"{self.name}: {said}: the device echoes its input, or is no Magician. Give the port of the arm")
                if (message.id, message.ctrl) == (id, ctrl):
                    return message
                message, self._buffer = take_message(self._buffer)
        return None

    def _close(self) -> None:
        self._supervisor.end()
        if self._serial is not None:
            with contextlib.suppress(*PORT_ERRORS):
                self._serial.close()
        self._serial, self._enabled, self._last_index = None, False, None
