"""Data on the MG400's connections: ports, error ids, modes, replies and the feedback packet. Driver and emulator use this module."""

import re
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from hardware.errors import DeviceError

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
        return (
            f"the arm refused {request} (-1). If it refuses everything it is not in TCP mode: in DobotStudio Pro choose "
            "TCP/IP Secondary Development; else it is disabled, in error, or the user or tool frame does not exist"
        )
    if error_id == ErrorId.NO_SUCH_COMMAND:
        return (
            f"the arm knows no {request} (-10000). If every command has this reply, the motion port 30003 is not open or another client "
            "holds it: close other programs (DobotStudio Pro, scripts), then connect again; else its firmware is too old"
        )
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
        return (
            "connected, but nothing came: the controller hangs, another program holds the feedback, or this is no MG400 "
            "(a server that waits for a request). Check the address, close other programs, else restart the arm"
        )
    packet, _ = newest_packet(came, lenient=True)
    if packet is not None:
        remedy = "an emulator, or a controller of another kind. If their poses can be trusted, use it as 'mg400-lenient:ADDRESS'"
        return f"packets came whose test value is {int(packet['test_value']):#x} instead of {TEST_VALUE:#x}: {remedy}"
    if describe_bytes(came).startswith("the text"):
        return f"{describe_bytes(came)} came instead of feedback: this is no MG400. Check address and port"
    remedy = "its firmware or the arm may be of another kind. Check the address"
    return f"{describe_bytes(came)} came, and no packet of {PACKET_BYTES} bytes: {remedy}"
