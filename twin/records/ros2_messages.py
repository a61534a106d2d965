"""ROS 2 messages, defined once: for the MCAP records, for live topics (``hardware.ros2``), and for reading both.

A message is a dict of its fields; fields that are missing are 0, "" or empty. ``encode`` and ``decode`` translate to and from CDR (XCDR1,
the encoding of ROS 2): each number is aligned to its size, a text or a sequence follows its length.
"""

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from twin.records.record import POSE_AXES

MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000
TF_TOPIC, TF_STATIC_TOPIC, DIAGNOSTICS_TOPIC = "/tf", "/tf_static", "/diagnostics"
TOUCHES_N = 1e-6
"""Force, N, above which the topic ``contact`` is 1."""
DEFINITIONS = dict(re.findall(r"^MSG: (\S+)\n((?:.* .*\n)*)", Path(__file__).with_name("ros2.msg").read_text("utf-8"), re.MULTILINE))
"""Fields of each message, as in ROS 2 (Humble and later), by the message's short name."""
_DTYPES = {name: np.dtype(name) for name in ("float32", "float64", "int8", "int32", "uint8", "uint32")}
_DTYPES |= {"bool": np.dtype("?"), "byte": np.dtype("uint8")}
_ENCAPSULATION: dict[bytes, Literal["<", ">"]] = {
    b"\x00\x01": "<",
    b"\x00\x00": ">",
}  # the first two of the four bytes before a message: little or big endian


_TEXT = "std_msgs/String"  # each text of an array is written as this message


class Field(NamedTuple):
    """A field of a message: its name, the name of its type (a number's, ``string``, or a message's), and whether it is an array.

    ``length`` is None for a single value, 0 for an array of any length.
    """

    name: str
    kind: str
    length: int | None


@cache
def fields_of(kind: str) -> tuple[Field, ...]:
    """The fields of a message, by its short name (``sensor_msgs/Image``)."""
    found = re.findall(r"^(\S+?)(\[(\d*)\])? (\w+)$", DEFINITIONS[kind], re.MULTILINE)
    return tuple(Field(name, base, int(count or 0) if array else None) for base, array, count, name in found)


def full_name(kind: str) -> str:
    """The name of a message in ROS 2: ``sensor_msgs/msg/Image``."""
    return kind.replace("/", "/msg/")


@cache
def definition_of(kind: str) -> str:
    """The definition of a message and of all messages in it, as MCAP files contain it."""
    needed = [kind]
    for each in needed:
        needed += [field.kind for field in fields_of(each) if field.kind in DEFINITIONS and field.kind not in needed]
    return DEFINITIONS[kind] + "".join(f"{'=' * 80}\nMSG: {each}\n{DEFINITIONS[each]}" for each in dict.fromkeys(needed[1:]))


@cache
def _one_dtype(kind: str) -> np.dtype | None:
    """The type of the numbers of a message that contains nothing else, such as a point; None for any other."""
    kinds = {field.kind if field.length is None else "" for field in fields_of(kind)}
    return _DTYPES.get(kinds.pop()) if len(kinds) == 1 else None


def encode(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message in CDR. Arrays of numbers, and of messages that consist of equal numbers (points), may be NumPy arrays."""
    out = bytearray(b"\x00\x01\x00\x00")
    _write(out, kind, message)
    return bytes(out)


def _align(out: bytearray, size: int) -> None:
    out += bytes((4 - len(out)) % size)  # counted from the end of the four bytes at the start


def _write(out: bytearray, kind: str, message: Mapping[str, Any]) -> None:
    for name, base, length in fields_of(kind):
        value: Any = message.get(name)
        if text := base == "string" and length is None:
            value = (value or "").encode() + b"\0"
        elif length == 0 and value is None:
            value = ()
        if length == 0 or text:
            _align(out, 4)
            out += len(value).to_bytes(4, "little")
        if isinstance(value, bytes):
            out += value
        elif base in DEFINITIONS and length is None:
            _write(out, base, value or {})
        elif base == "string":
            for each in value:
                _write(out, _TEXT, {"data": each})
        elif base in DEFINITIONS and not isinstance(value, np.ndarray):
            for each in value:
                _write(out, base, each)
        else:
            numbers = np.asarray(np.zeros(length or 1) if value is None else value, _DTYPES.get(base) or _one_dtype(base))
            if numbers.size:
                _align(out, numbers.itemsize)
                out += numbers.tobytes()


def decode(kind: str, data: bytes) -> dict[str, Any]:
    """A message from CDR. Arrays of numbers come as NumPy arrays.

    Raises
    ------
    ValueError
        The bytes are no message of this kind.
    """
    order = _ENCAPSULATION.get(bytes(data[:2]))
    if order is None:
        raise ValueError(f"{full_name(kind)}: an encoding other than CDR")
    try:
        message, end = _read(memoryview(data)[4:], 0, kind, order)
        if end > len(data) - 4:
            raise ValueError(f"{len(data)} bytes of {end + 4}")
        return message
    except (IndexError, TypeError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{full_name(kind)}: cut or damaged ({error})") from error


def _read(data: memoryview, at: int, kind: str, order: Literal["<", ">"]) -> tuple[dict[str, Any], int]:
    """A message that begins at a place, and where it ends."""

    def numbers(dtype: np.dtype, count: int) -> np.ndarray:
        nonlocal at
        if not count:
            return np.empty(0, dtype)
        at += -at % dtype.itemsize
        found = np.frombuffer(data, dtype.newbyteorder(order), count, at)
        at += found.nbytes
        return found

    message: dict[str, Any] = {}
    for name, base, length in fields_of(kind):
        text = base == "string" and length is None
        count = int(numbers(_DTYPES["uint32"], 1)[0]) if length == 0 or text else length
        if text:
            message[name], at = bytes(data[at : at + int(count or 1) - 1]).decode(), at + int(count or 0)
        elif base in _DTYPES:
            found = numbers(_DTYPES[base], 1 if count is None else count)
            message[name] = found if count is not None else found[0].item()
        elif count is None:
            message[name], at = _read(data, at, base, order)
        else:
            message[name] = []
            for _ in range(count):
                each, at = _read(data, at, _TEXT if base == "string" else base, order)
                message[name].append(each["data"] if base == "string" else each)
    return message, at


def header_of(at_ns: int, frame: str) -> dict[str, Any]:
    """A header with a time, ns since 1970, and a frame."""
    return {"stamp": {"sec": at_ns // NS_PER_S, "nanosec": at_ns % NS_PER_S}, "frame_id": frame}


def vector(numbers: np.ndarray) -> dict[str, float]:
    """A vector (3,), or a quaternion (4,), as message."""
    return dict(zip("xyzw", np.asarray(numbers).tolist(), strict=False))


def twist(six: np.ndarray) -> dict[str, Any]:
    """Six numbers as a twist."""
    return {"linear": vector(six[:3]), "angular": vector(six[3:])}


def estimated_twist(known: Mapping[str, float]) -> dict[str, Any]:
    """The labels ``pose_1`` to ``pose_6`` among those estimated, as a twist in mm and deg; NaN for those that are not."""
    return twist(np.array([known.get(f"pose_{k + 1}", np.nan) for k in range(len(POSE_AXES))]))


def wrench(force_n: np.ndarray, torque_nmm: np.ndarray) -> dict[str, Any]:
    """A force (3,), N, and a torque (3,), N mm, as a wrench in N and N m."""
    return {"force": vector(force_n), "torque": vector(np.asarray(torque_nmm) / MM_PER_M)}


def place(T_mm: np.ndarray) -> dict[str, Any]:
    """A pose (4, 4) as message, in m."""
    return {"position": vector(T_mm[:3, 3] / MM_PER_M), "orientation": vector(Rotation.from_matrix(T_mm[:3, :3]).as_quat())}


def matrix_in(place: Mapping[str, Mapping[str, float]]) -> np.ndarray:
    """The pose (4, 4), mm, of such a message; ``ValueError``: it is none."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([place["orientation"][axis] for axis in "xyzw"]).as_matrix()
    T[:3, 3] = [MM_PER_M * place["position"][axis] for axis in "xyz"]
    if not np.isfinite(T).all():
        raise ValueError("a pose that is not a number")
    return T


def transform(T_mm: np.ndarray, header: Mapping[str, Any], child: str) -> dict[str, Any]:
    """A pose (4, 4) of a frame as a ``/tf`` message, in m."""
    parts = dict(zip(("translation", "rotation"), place(T_mm).values(), strict=True))
    return {"transforms": [{"header": header, "child_frame_id": child, "transform": parts}]}


def number_array(values: np.ndarray, *labels: str) -> dict[str, Any]:
    """Numbers as an array message with named dimensions."""
    dim = [
        {"label": label, "size": n, "stride": int(np.prod(values.shape[k:]))}
        for k, (label, n) in enumerate(zip(labels, values.shape, strict=False))
    ]
    return {"layout": {"dim": dim}, "data": values.ravel()}
