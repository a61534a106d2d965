"""ROS 2 messages, defined once: for the MCAP records, for live topics (``hardware.ros2``), and for reading both.

A message is a dict of its fields; fields that are missing are 0, "" or empty. The package ``rosbags`` knows the fields of ROS 2's messages
(Humble and later), and translates to and from CDR (XCDR1, the encoding of ROS 2).
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from twin.errors import ErrorsAs, library
from twin.records.record import POSE_AXES

MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000
TF_TOPIC, TF_STATIC_TOPIC, DIAGNOSTICS_TOPIC = "/tf", "/tf_static", "/diagnostics"
TOUCHES_N = 1e-6
"""Force, N, above which the topic ``contact`` is 1."""


class Field(NamedTuple):
    """A field of a message: its name, the name of its type (a number's, ``string``, or a message's), and whether it is an array.

    ``length`` is None for a single value, 0 for an array of any length.
    """

    name: str
    kind: str
    length: int | None


@cache
def _store() -> Any:
    typesys = library("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


@cache
def fields_of(kind: str) -> tuple[Field, ...]:
    """The fields of a message, by its short name (``sensor_msgs/Image``)."""
    found = []
    for name, (node, detail) in _store().fielddefs[full_name(kind)][1]:
        one, length = (detail[0][1], detail[1]) if node.name in ("ARRAY", "SEQUENCE") else (detail, None)
        found.append(Field(name, (one if isinstance(one, str) else one[0]).replace("/msg/", "/"), length))
    return tuple(found)


def full_name(kind: str) -> str:
    """The name of a message in ROS 2: ``sensor_msgs/msg/Image``."""
    return kind.replace("/", "/msg/")


def definition_of(kind: str) -> str:
    """The definition of a message and of all messages in it, as MCAP files contain it."""
    return str(_store().generate_msgdef(full_name(kind), ros_version=2)[0])


def encode(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message in CDR. Arrays of numbers, and of messages that consist of equal numbers (points), may be NumPy arrays."""
    return bytes(_store().serialize_cdr(_whole(kind, message), full_name(kind)))


def _whole(kind: str, message: Mapping[str, Any] | np.ndarray) -> Any:
    """A message as an object of ``rosbags``, with all fields."""
    values: dict[str, Any] = {}
    if isinstance(message, np.ndarray):
        message = dict(zip((field.name for field in fields_of(kind)), message.tolist(), strict=True))
    for name, base, length in fields_of(kind):
        value = message.get(name)
        if "/" in base:
            value = _whole(base, value or {}) if length is None else [_whole(base, each) for each in (() if value is None else value)]
        elif base == "string":
            value = value or ("" if length is None else [])
        elif length is None:
            value = 0 if value is None else value
        elif isinstance(value, bytes):
            value = np.frombuffer(value, np.uint8)
        else:
            value = np.asarray(np.zeros(length) if value is None else value, {"byte": "uint8"}.get(base, base))
        values[name] = value
    return _store().types[full_name(kind)](**values)


def decode(kind: str, data: bytes) -> dict[str, Any]:
    """A message from CDR, as a dict. Arrays of numbers come as NumPy arrays.

    Raises
    ------
    ValueError
        The bytes are no message of this kind.
    """
    if bytes(data[:2]) not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"{full_name(kind)}: an encoding other than CDR")
    # the library raises exceptions of several types for damaged bytes
    with ErrorsAs(Exception, lambda error: ValueError(f"{full_name(kind)}: cut or damaged ({error})")):
        return asdict(_store().deserialize_cdr(data, full_name(kind)), dict_factory=_without_type)


def _without_type(pairs: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in pairs if name != "__msgtype__"}


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
