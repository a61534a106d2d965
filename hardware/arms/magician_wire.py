"""Messages on the Magician's serial line: ``AA AA | len | id | ctrl | params | checksum``. Driver and emulator use this module."""

from dataclasses import dataclass
from enum import IntEnum

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
