"""ROS 2 messages, defined once for MCAP records and live topics (``hardware.ros2``), and records as MCAP files, one for each episode.

A message is a dict of its fields; fields that are missing are 0, "" or empty. The package ``rosbags`` knows the fields of ROS 2's messages
(Humble and later), and translates to and from CDR (XCDR1, the encoding of ROS 2).

Foxglove, PlotJuggler and ``ros2 bag play`` can open the files. Where the public TacTip stack (tactip-main) has a topic, its name and unit
are used: the six numbers of a pose are a ``TwistStamped`` in mm and deg. Types that ROS itself defines have ROS's units: ``/tf`` and
``/tf_static`` (m, quaternions) and ``/tactip/wrench`` (N, N m).
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from twin.errors import ErrorsAs, library
from twin.records.folder import AGAIN, VERSION, FolderWriter, episode_of, image_of, png, read_sidecar, require_numbered, whole_steps
from twin.records.record import POSE_AXES, About, Episode, RecordError, Records, RecordStep, channel_of, float32, is_pins
from twin.rig.arm_pose import matrix_of
from twin.store import write_with

MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000
TF_TOPIC, TF_STATIC_TOPIC, DIAGNOSTICS_TOPIC = "/tf", "/tf_static", "/diagnostics"
TOUCHES_N = 1e-6
"""Force, N, above which the topic ``contact`` is 1."""
IMAGE_TOPIC, CONTACT_TOPIC, POSE_TOPIC = "/{view}/image/compressed", "/tactip/contact", "/tactip/pose"
TOOL_FRAME, SENSOR_FRAME = "tactip_tool", "{view}_sensor"
"""Child frames; the parent is ``base`` or ``work``. The sensor's z points out of the dome's apex, its x along the picture's x."""
METADATA, REST = "tactip", "rest.png"
"""Name of a file's own metadata, and of the attached picture without contact."""
MOST_SAID = 200
"""Most characters of a library's error that a message repeats."""


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
    sizes = zip(labels, values.shape, strict=False)
    dim = [{"label": label, "size": n, "stride": int(np.prod(values.shape[k:]))} for k, (label, n) in enumerate(sizes)]
    return {"layout": {"dim": dim}, "data": values.ravel()}


class Ros2Writer(FolderWriter):
    """Writes records as MCAP files ``episode_NNNNNN.mcap``."""

    FORMAT = "mcap"
    NAMES = ("episode_*.mcap",)
    LIBRARIES = ("mcap.writer", "rosbags.typesys")
    VIEWS = True

    def _find(self) -> list[dict[str, Any]]:
        return [_read_description(path)[1] for path in _files(self.folder)]

    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        for episode in episodes:
            if next(episode.steps(), None) is not None:
                facts = episode.facts()
                write_with(self.folder / _name(len(self.facts)), partial(self._fill, episode=episode, facts=facts))
                yield [facts]

    def _fill(self, file: Any, *, episode: Episode, facts: dict[str, Any]) -> None:
        """Write an episode, and complete its facts."""
        writer, start_ns = library("mcap.writer").Writer(file), round(episode.started_s * NS_PER_S)
        writer.start(profile="ros2")
        schemas, channels, count = dict[str, int](), dict[str, int](), 0
        for step in episode.steps():
            self._require_fitting(episode, step)
            at_ns = start_ns + round(step.time_s * NS_PER_S)
            for topic, kind, message in _messages(self.about, step, at_ns, None if count else episode.T_tool_sensor):
                if kind not in schemas:
                    schemas[kind] = writer.register_schema(full_name(kind), "ros2msg", definition_of(kind).encode())
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
                writer.add_message(channels[topic], at_ns, encode(kind, message), at_ns, count)
            count += 1
        facts["length"] = count
        metadata = {"version": str(VERSION), "facts": json.dumps(facts), "about": json.dumps(self.about.plain())}
        writer.add_metadata(METADATA, metadata)
        if episode.rest is not None:
            writer.add_attachment(start_ns, start_ns, REST, "image/png", png(episode.rest))
        writer.finish()


def _messages(about: About, step: RecordStep, at_ns: int, static: np.ndarray | None) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topic, kind and content of each message of a step, with the time of its exposure. ``static`` is the sensor's pose on the tool."""
    sensor, based = SENSOR_FRAME.format(view=about.views[0]), header_of(at_ns, about.frame)
    header = header_of(at_ns, sensor)
    if static is not None:
        yield TF_STATIC_TOPIC, "tf2_msgs/TFMessage", transform(static, header_of(at_ns, TOOL_FRAME), sensor)
    for view, image in zip(about.views, step.images, strict=True):
        seen = {"header": header_of(at_ns, SENSOR_FRAME.format(view=view)), "format": "png", "data": png(image)}
        yield IMAGE_TOPIC.format(view=view), "sensor_msgs/CompressedImage", seen
    for name, values in step.values.items():
        numbers, topic = values.astype(float), channel_of(name).topic
        if about.is_plain(name):
            labels = "pin" if is_pins(name) else ",".join(about.axes(name))
            yield topic, "std_msgs/Float32MultiArray", number_array(values, labels, "axis")
        elif name == "wrench":
            yield topic, "geometry_msgs/WrenchStamped", {"header": header, "wrench": wrench(numbers[:3], numbers[3:])}
            yield CONTACT_TOPIC, "std_msgs/Int8", {"data": int(np.linalg.norm(numbers[:3]) > TOUCHES_N)}
        else:
            yield topic, "geometry_msgs/TwistStamped", {"header": based, "twist": twist(numbers)}
    if "estimate" in step.values:
        known = dict(zip(about.estimates, step.values["estimate"].tolist(), strict=True))
        yield POSE_TOPIC, "geometry_msgs/TwistStamped", {"header": header, "twist": estimated_twist(known)}
    if "pose" in step.values and np.isfinite(step.values["pose"]).all():
        yield TF_TOPIC, "tf2_msgs/TFMessage", transform(matrix_of(step.values["pose"].astype(float)), based, TOOL_FRAME)


def ros2_records(path: Path) -> Records:
    """Records in a folder of MCAP files that ``Ros2Writer`` wrote, or in one such file.

    Raises
    ------
    RecordError
        A file is damaged, or another program wrote it.
    """
    files = _files(path) if path.is_dir() else [path]
    if not files:
        return Records(read_sidecar(path)[0], [])
    found = [_read_description(file) for file in files]
    about = found[0][0]
    episodes = []
    for file, (its, facts, rest) in zip(files, found, strict=True):
        if wrong := about.differs(its):
            raise RecordError(f"{file}: does not fit the files before it ({'; '.join(wrong)}); translate it alone")
        image = None if rest is None else image_of(rest, about.gray, str(file))
        episodes.append(episode_of(file, facts, partial(whole_steps, file, facts, partial(_steps_of, file, about)), image))
    return Records(about, episodes)


@contextmanager
def _reading(path: Path) -> Iterator[Any]:
    """Context that gives mcap's reader of a file. If the file turns out to be damaged, ``RecordError`` is raised."""
    reader = library("mcap.reader")
    try:
        with path.open("rb") as file:
            yield reader.make_reader(file, validate_crcs=True)
    except RecordError:
        raise
    except OSError as error:
        raise RecordError(f"{path}: can't be read ({error.strerror}); {AGAIN}") from error
    except Exception as error:  # the libraries raise exceptions of any type for damaged files
        raise RecordError(f"{path}: damaged or cut ({' '.join(str(error).split())[:MOST_SAID]}); {AGAIN}") from error


def _read_description(path: Path) -> tuple[About, dict[str, Any], bytes | None]:
    """The description of a file, and its picture without contact."""
    with _reading(path) as bag:
        metadata = next((each.metadata for each in bag.iter_metadata() if each.name == METADATA), None)
        if metadata is None:
            raise RecordError(f"{path}: was not written by this program; give one that it wrote")
        rest = next((bytes(each.data) for each in bag.iter_attachments() if each.name == REST), None)
        facts = json.loads(metadata["facts"])
        if metadata["version"] != str(VERSION) or not isinstance(facts, dict):
            raise ValueError(f"version {metadata['version']}")
        return About.of(json.loads(metadata["about"])), facts, rest


def _steps_of(path: Path, about: About) -> Iterator[RecordStep]:
    """The steps of a file. Messages with the same sequence number belong to one step."""
    named = {channel_of(name).topic: name for name in about.numbers}
    pictures = [IMAGE_TOPIC.format(view=view) for view in about.views]
    start_ns: int | None = None
    with _reading(path) as bag:
        found = bag.iter_messages([*pictures, *named], log_time_order=False)
        for _, messages in groupby(found, key=lambda each: each[2].sequence):
            images, values, at_ns = dict[str, np.ndarray](), dict[str, np.ndarray](), 0
            for schema, channel, message in messages:
                at_ns, fields = message.log_time, decode(schema.name.replace("/msg/", "/"), message.data)
                if channel.topic in pictures:
                    images[channel.topic] = image_of(fields["data"].tobytes(), about.gray, str(path))
                else:
                    values[named[channel.topic]] = _numbers(named[channel.topic], fields, about)
            start_ns = at_ns if start_ns is None else start_ns
            if images:
                image, *beside = (images[topic] for topic in pictures)
                in_order = {name: values[name] for name in about.numbers}
                yield RecordStep(image, (at_ns - start_ns) / NS_PER_S, in_order, tuple(beside))


def _numbers(name: str, fields: dict[str, Any], about: About) -> np.ndarray:
    """A channel's numbers from its message."""
    if about.is_plain(name):
        return np.asarray(fields["data"], np.float32).reshape(about.shape(name))
    parts, scale = (fields["wrench"], MM_PER_M) if name == "wrench" else (fields["twist"], 1.0)
    first, second = (list(each.values()) for each in parts.values())
    return float32([*first, *(scale * each for each in second)])


def _files(folder: Path) -> list[Path]:
    """A folder's files in the order of their numbers.

    Raises
    ------
    RecordError
        One of them is missing.
    """
    files = sorted(folder.glob("episode_*.mcap"))
    require_numbered(files, _name)
    return files


def _name(number: int) -> str:
    return f"episode_{number:06d}.mcap"
