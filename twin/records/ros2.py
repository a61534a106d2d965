"""Records as MCAP files with ROS 2 messages, one file for each episode.

Foxglove, PlotJuggler and ``ros2 bag play`` can open these files. Where the public TacTip stack (tactip-main) has a topic, its name and unit
are used: the six numbers of a pose are a ``TwistStamped`` in mm and deg. Types that ROS itself defines have ROS's units: ``/tf`` and
``/tf_static`` (m, quaternions) and ``/tactip/wrench`` (N, N m).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import library
from twin.records import ros2_messages as ros
from twin.records.folder import AGAIN, VERSION, FolderWriter, episode_of, image_of, png, read_sidecar, require_numbered, whole_steps
from twin.records.record import About, Episode, RecordError, Records, RecordStep, channel_of, float32, is_pins
from twin.rig.arm_pose import matrix_of
from twin.store import write_with

IMAGE_TOPIC, CONTACT_TOPIC, POSE_TOPIC = "/{view}/image/compressed", "/tactip/contact", "/tactip/pose"
TOOL_FRAME, SENSOR_FRAME = "tactip_tool", "{view}_sensor"
"""Child frames; the parent is ``base`` or ``work``. The sensor's z points out of the dome's apex, its x along the picture's x."""
METADATA, REST = "tactip", "rest.png"
"""Name of a file's own metadata, and of the attached picture without contact."""
MOST_SAID = 200
"""Most characters of a library's error that a message repeats."""


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
            first = next(episode.steps(), None)
            if first is not None:
                facts: dict[str, Any] = episode.facts()
                path = self.folder / _name(len(self.facts))
                write_with(path, partial(self._fill, episode=episode, facts=facts))
                yield [facts]

    def _fill(self, file: Any, *, episode: Episode, facts: dict[str, Any]) -> None:
        """Write an episode, and complete its facts."""
        writer, start_ns = library("mcap.writer").Writer(file), round(episode.started_s * ros.NS_PER_S)
        writer.start(profile="ros2")
        schemas, channels, count = dict[str, int](), dict[str, int](), 0
        for step in episode.steps():
            self._require_fitting(episode, step)
            at_ns = start_ns + round(step.time_s * ros.NS_PER_S)
            for topic, kind, message in _messages(self.about, step, at_ns, None if count else episode.T_tool_sensor):
                if kind not in schemas:
                    schemas[kind] = writer.register_schema(ros.full_name(kind), "ros2msg", ros.definition_of(kind).encode())
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
                writer.add_message(channels[topic], at_ns, ros.encode(kind, message), at_ns, count)
            count += 1
        facts["length"] = count
        metadata = {"version": str(VERSION), "facts": json.dumps(facts), "about": json.dumps(self.about.plain())}
        writer.add_metadata(METADATA, metadata)
        if episode.rest is not None:
            writer.add_attachment(start_ns, start_ns, REST, "image/png", png(episode.rest))
        writer.finish()


def _messages(about: About, step: RecordStep, at_ns: int, static: np.ndarray | None) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topic, kind and content of each message of a step, with the time of its exposure. ``static`` is the sensor's pose on the tool."""
    sensor, based = SENSOR_FRAME.format(view=about.views[0]), ros.header_of(at_ns, about.frame)
    header = ros.header_of(at_ns, sensor)
    if static is not None:
        yield ros.TF_STATIC_TOPIC, "tf2_msgs/TFMessage", ros.transform(static, ros.header_of(at_ns, TOOL_FRAME), sensor)
    for view, image in zip(about.views, step.images, strict=True):
        seen = {"header": ros.header_of(at_ns, SENSOR_FRAME.format(view=view)), "format": "png", "data": png(image)}
        yield IMAGE_TOPIC.format(view=view), "sensor_msgs/CompressedImage", seen
    for name, values in step.values.items():
        numbers, topic = values.astype(float), channel_of(name).topic
        if about.is_plain(name):
            labels = "pin" if is_pins(name) else ",".join(about.axes(name))
            yield topic, "std_msgs/Float32MultiArray", ros.number_array(values, labels, "axis")
        elif name == "wrench":
            yield topic, "geometry_msgs/WrenchStamped", {"header": header, "wrench": ros.wrench(numbers[:3], numbers[3:])}
            yield CONTACT_TOPIC, "std_msgs/Int8", {"data": int(np.linalg.norm(numbers[:3]) > ros.TOUCHES_N)}
        else:
            yield topic, "geometry_msgs/TwistStamped", {"header": based, "twist": ros.twist(numbers)}
    if "estimate" in step.values:
        known = dict(zip(about.estimates, step.values["estimate"].tolist(), strict=True))
        yield POSE_TOPIC, "geometry_msgs/TwistStamped", {"header": header, "twist": ros.estimated_twist(known)}
    if "pose" in step.values and np.isfinite(step.values["pose"]).all():
        yield ros.TF_TOPIC, "tf2_msgs/TFMessage", ros.transform(matrix_of(step.values["pose"].astype(float)), based, TOOL_FRAME)


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
                at_ns, fields = message.log_time, ros.decode(schema.name.replace("/msg/", "/"), message.data)
                if channel.topic in pictures:
                    images[channel.topic] = image_of(fields["data"].tobytes(), about.gray, str(path))
                else:
                    values[named[channel.topic]] = _numbers(named[channel.topic], fields, about)
            start_ns = at_ns if start_ns is None else start_ns
            if images:
                image, *beside = (images[topic] for topic in pictures)
                in_order = {name: values[name] for name in about.numbers}
                yield RecordStep(image, (at_ns - start_ns) / ros.NS_PER_S, in_order, tuple(beside))


def _numbers(name: str, fields: dict[str, Any], about: About) -> np.ndarray:
    """A channel's numbers from its message."""
    if about.is_plain(name):
        return np.asarray(fields["data"], np.float32).reshape(about.shape(name))
    parts, scale = (fields["wrench"], ros.MM_PER_M) if name == "wrench" else (fields["twist"], 1.0)
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
