"""Records as MCAP files with ROS 2 messages, one file for each episode.

Foxglove, PlotJuggler and ``ros2 bag play`` can open these files. Where the public TacTip stack (tactip-main) has a topic, its name and unit
are used: the six numbers of a pose are a ``TwistStamped`` in mm and deg. Types that ROS itself defines have ROS's units: ``/tf`` and
``/tf_static`` (m, quaternions) and ``/tactip/wrench`` (N, N m).
"""

import json
from collections.abc import Iterator
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from twin.records.folder import AGAIN, VERSION, FolderWriter, image_of, png, read_sidecar, require_numbered, whole_steps
from twin.records.record import CHANNELS, About, Episode, RecordError, Records, RecordStep, float32, library
from twin.store import write_with

IMAGE_TOPIC, CONTACT_TOPIC, POSE_TOPIC = "/tactip/image/compressed", "/tactip/contact", "/tactip/pose"
TF_TOPIC, TF_STATIC_TOPIC = "/tf", "/tf_static"
TOOL_FRAME, SENSOR_FRAME = "tactip_tool", "tactip_sensor"
"""Child frames; the parent is ``base`` or ``work``. The sensor's z points out of the dome's apex, its x along the picture's x."""
METADATA, REST = "tactip", "rest.png"
"""Name of a file's own metadata, and of the attached picture without contact."""
MM_PER_M = 1000.0
NS_PER_S = 1_000_000_000
MOST_SAID = 200
"""Most characters of a library's error that a message repeats."""
TOUCHES_N = 1e-6
"""Force, N, above which ``/tactip/contact`` is 1."""

_HEADER = "std_msgs/Header header\n"
_LINE = "=" * 80
_TIME = f"{_LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_STAMPED = f"{_LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n{_TIME}"
_VECTOR = f"{_LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
_TURN = f"{_LINE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_DIMENSION = f"{_LINE}\nMSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
MESSAGES = {
    "sensor_msgs/msg/CompressedImage": f"{_HEADER}string format\nuint8[] data\n{_STAMPED}",
    "geometry_msgs/msg/TwistStamped": f"{_HEADER}geometry_msgs/Twist twist\n{_LINE}\nMSG: geometry_msgs/Twist\n"
    f"geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n{_VECTOR}{_STAMPED}",
    "geometry_msgs/msg/WrenchStamped": f"{_HEADER}geometry_msgs/Wrench wrench\n{_LINE}\nMSG: geometry_msgs/Wrench\n"
    f"geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n{_VECTOR}{_STAMPED}",
    "tf2_msgs/msg/TFMessage": f"geometry_msgs/TransformStamped[] transforms\n{_LINE}\nMSG: geometry_msgs/TransformStamped\n{_HEADER}"
    f"string child_frame_id\ngeometry_msgs/Transform transform\n{_LINE}\nMSG: geometry_msgs/Transform\n"
    f"geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n{_VECTOR}{_TURN}{_STAMPED}",
    "std_msgs/msg/Float32MultiArray": f"std_msgs/MultiArrayLayout layout\nfloat32[] data\n{_LINE}\nMSG: std_msgs/MultiArrayLayout\n"
    f"std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n{_DIMENSION}",
    "std_msgs/msg/Int8": "int8 data\n",
}
"""Definitions of the messages as in ROS 2."""


class Ros2Writer(FolderWriter):
    """Writes records as MCAP files ``episode_NNNNNN.mcap``."""

    FORMAT = "mcap"
    NAMES = ("episode_*.mcap",)
    LIBRARIES = ("mcap_ros2.writer",)

    def _find(self) -> list[dict[str, Any]]:
        return [_read_description(path)[1] for path in _files(self.folder)]

    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        for episode in episodes:
            first = next(episode.steps(), None)
            if first is not None:
                facts: dict[str, Any] = episode.facts()
                path = self.folder / _name(len(self.facts))
                write_with(path, partial(self._fill, episode=episode, facts=facts))
                yield [facts]

    def _fill(self, file: Any, *, episode: Episode, facts: dict[str, Any]) -> None:
        bag = _Bag(library("mcap_ros2.writer").Writer(file), self.about, episode)
        for step in episode.steps():
            self._require_fitting(episode, step)
            bag.add(step)
        facts["length"] = bag.count
        bag.finish(facts)


class _Bag:
    """An open MCAP file of one episode."""

    def __init__(self, writer: Any, about: About, episode: Episode) -> None:
        self._writer, self._about, self._episode = writer, about, episode
        self._schemas = {name: writer.register_msgdef(name, text) for name, text in MESSAGES.items()}
        self.count = 0
        self._static = episode.T_tool_sensor
        self._start_ns = round(episode.started_s * NS_PER_S)

    def add(self, step: RecordStep) -> None:
        """Write the messages of a step. All have the time of its exposure."""
        at_ns = self._start_ns + round(step.time_s * NS_PER_S)
        send = partial(self._send, at_ns=at_ns)
        header = {"stamp": {"sec": at_ns // NS_PER_S, "nanosec": at_ns % NS_PER_S}, "frame_id": SENSOR_FRAME}
        based = header | {"frame_id": self._about.frame}
        if self._static is not None and not self.count:
            place = _transform(self._static, header | {"frame_id": TOOL_FRAME}, SENSOR_FRAME)
            send(TF_STATIC_TOPIC, "tf2_msgs/msg/TFMessage", {"transforms": [place]})
        send(IMAGE_TOPIC, "sensor_msgs/msg/CompressedImage", {"header": header, "format": "png", "data": png(step.image)})
        for name, values in step.values.items():
            numbers = values.astype(float)
            topic = CHANNELS[name].topic
            if self._about.is_plain(name):
                send(topic, "std_msgs/msg/Float32MultiArray", _array(values, "pin" if name == "pins" else ",".join(self._about.axes(name))))
            elif name == "wrench":
                parts = {"force": _vector(numbers[:3]), "torque": _vector(numbers[3:] / MM_PER_M)}
                send(topic, "geometry_msgs/msg/WrenchStamped", {"header": header, "wrench": parts})
                send(CONTACT_TOPIC, "std_msgs/msg/Int8", {"data": int(np.linalg.norm(numbers[:3]) > TOUCHES_N)})
            else:
                send(topic, "geometry_msgs/msg/TwistStamped", {"header": based, "twist": _twist(numbers)})
        if "estimate" in step.values:
            known = dict(zip(self._about.estimates, step.values["estimate"].tolist(), strict=True))
            six = np.array([known.get(f"pose_{k}", np.nan) for k in range(1, 7)])
            send(POSE_TOPIC, "geometry_msgs/msg/TwistStamped", {"header": header, "twist": _twist(six)})
        if "pose" in step.values and np.isfinite(step.values["pose"]).all():
            T = np.eye(4)
            pose = step.values["pose"].astype(float)
            T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", pose[3:], degrees=True).as_matrix(), pose[:3]
            send(TF_TOPIC, "tf2_msgs/msg/TFMessage", {"transforms": [_transform(T, based, TOOL_FRAME)]})
        self.count += 1

    def finish(self, facts: dict[str, Any]) -> None:
        """Write the file's description, and its end."""
        metadata = {"version": str(VERSION), "facts": json.dumps(facts), "about": json.dumps(self._about.plain())}
        self._writer.add_metadata(METADATA, metadata)
        if self._episode.rest is not None:
            self._writer.add_attachment(self._start_ns, self._start_ns, REST, "image/png", png(self._episode.rest))
        self._writer.finish()

    def _send(self, topic: str, kind: str, message: dict[str, Any], *, at_ns: int) -> None:
        self._writer.write_message(topic, self._schemas[kind], message, at_ns, at_ns, self.count)


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
        try:
            image = None if rest is None else image_of(rest, about.gray, str(file))
            steps = partial(whole_steps, file, facts, partial(_steps_of, file, about))
            episodes.append(Episode.from_facts(facts, steps, image))
        except (KeyError, TypeError, ValueError) as error:
            raise RecordError(f"{file}: its description is damaged ({error}); {AGAIN}") from error
    return Records(about, episodes)


def _read_description(path: Path) -> tuple[About, dict[str, Any], bytes | None]:
    """The description of a file, and its picture without contact."""
    reader = library("mcap.reader")
    try:
        with path.open("rb") as file:
            bag = reader.make_reader(file)
            metadata = next(each.metadata for each in bag.iter_metadata() if each.name == METADATA)
            rest = next((bytes(each.data) for each in bag.iter_attachments() if each.name == REST), None)
        facts = json.loads(metadata["facts"])
        if metadata["version"] != str(VERSION) or not isinstance(facts, dict):
            raise ValueError(f"version {metadata['version']}")
        return About.of(json.loads(metadata["about"])), facts, rest
    except OSError as error:
        raise RecordError(f"{path}: can't be read ({error.strerror}); {AGAIN}") from error
    except StopIteration as error:
        raise RecordError(f"{path}: was not written by this program; give one that it wrote") from error
    except Exception as error:  # the libraries raise exceptions of any type for damaged files
        raise RecordError(f"{path}: damaged or cut ({' '.join(str(error).split())[:MOST_SAID]}); {AGAIN}") from error


def _steps_of(path: Path, about: About) -> Iterator[RecordStep]:
    """The steps of a file. Messages with the same sequence number belong to one step."""
    reader, decoder = library("mcap.reader"), library("mcap_ros2.decoder").DecoderFactory()
    named = {CHANNELS[name].topic: name for name in about.numbers}
    topics = [IMAGE_TOPIC, *named]
    start_ns: int | None = None
    try:
        with path.open("rb") as file:
            bag = reader.make_reader(file, validate_crcs=True, decoder_factories=[decoder])
            decoded = bag.iter_decoded_messages(topics, log_time_order=False)
            for _, messages in groupby(decoded, key=lambda each: each[2].sequence):
                image, values, at_ns = None, dict[str, np.ndarray](), 0
                for _, channel, message, ros in messages:
                    at_ns = message.log_time
                    if channel.topic == IMAGE_TOPIC:
                        image = image_of(bytes(ros.data), about.gray, str(path))
                    else:
                        values[named[channel.topic]] = _numbers(named[channel.topic], ros, about)
                start_ns = at_ns if start_ns is None else start_ns
                if image is not None:
                    yield RecordStep(image, (at_ns - start_ns) / NS_PER_S, {name: values[name] for name in about.numbers})
    except RecordError:
        raise
    except Exception as error:  # the libraries raise exceptions of any type for damaged files
        raise RecordError(f"{path}: damaged ({' '.join(str(error).split())[:MOST_SAID]}); {AGAIN}") from error


def _numbers(name: str, ros: Any, about: About) -> np.ndarray:
    """A channel's numbers from its message."""
    if about.is_plain(name):
        return float32(list(ros.data)).reshape(about.shape(name))
    if name == "wrench":
        force, torque = ros.wrench.force, ros.wrench.torque
        return float32([force.x, force.y, force.z, *(MM_PER_M * t for t in (torque.x, torque.y, torque.z))])
    linear, angular = ros.twist.linear, ros.twist.angular
    return float32([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])


def _twist(six: np.ndarray) -> dict[str, Any]:
    return {"linear": _vector(six[:3]), "angular": _vector(six[3:])}


def _vector(numbers: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", numbers.tolist(), strict=True))


def _transform(T_mm: np.ndarray, header: dict[str, Any], child: str) -> dict[str, Any]:
    turn = Rotation.from_matrix(T_mm[:3, :3]).as_quat()
    rotation = dict(zip("xyzw", turn.tolist(), strict=True))
    return {
        "header": header,
        "child_frame_id": child,
        "transform": {"translation": _vector(T_mm[:3, 3] / MM_PER_M), "rotation": rotation},
    }


def _array(values: np.ndarray, label: str) -> dict[str, Any]:
    """Numbers as an array message with named dimensions."""
    labels = (label, "axis")[: values.ndim]
    dim = [
        {"label": each, "size": n, "stride": int(np.prod(values.shape[k:]))}
        for k, (each, n) in enumerate(zip(labels, values.shape, strict=True))
    ]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": values.ravel().tolist()}


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
