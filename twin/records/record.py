"""Records: episodes of steps, independent of the file format. A step has a picture and numbers.

Only the tables in this module define the numbers, their columns in LeRobot's and Hugging Face's formats, and their topics in ROS 2. In
every format numbers are stored as 32-bit floats (a pose of 300 mm to 0.00003 mm) and times as 64-bit floats. Therefore a record that is
read equals the record that was written.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from twin.errors import TwinError
from twin.types import Form, ImageArray

POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the numbers of a pose: mm, and Euler angles about the fixed axes x, y, z in this order, in deg."""
WRENCH_AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
"""Names of the numbers of a wrench: N and N mm."""
NOMINAL_HZ = 10.0
"""Assumed frames per second of a record whose times are not known."""
FASTEST_HZ = 1000
"""Largest whole number of frames per second that a record states."""
DIGEST = 16
"""Hexadecimal digits of the digest in an episode's key: 64 bits."""


class RecordError(TwinError):
    """A record can't be read, written or translated. The message states what was found and what to do."""


@dataclass(frozen=True)
class Channel:
    """A kind of numbers that each step of a record may have.

    Attributes
    ----------
    name : str
        Name in this program, and first part of the column names in the recordings' table.
    column : str
        Name in LeRobot's and Hugging Face's formats.
    topic : str
        ROS 2 topic.
    axes : tuple of str
        Names of the numbers. () if the record itself names them.
    meaning : str
        Meaning of the numbers, with unit and frame.
    """

    name: str
    column: str
    topic: str
    axes: tuple[str, ...]
    meaning: str


_WRENCH = "force (N) and torque (N mm) of the skin on the object, in the sensor frame"
_ACTION = "the pose that the arm was sent to, mm and deg; or as the record names it"
CHANNELS = {
    channel.name: channel
    for channel in (
        Channel("pins", "observation.tactile.pins", "/tactip/pins", (), "x, y of each pin in px of the picture; NaN: not found"),
        Channel("pose", "observation.state", "/tactip/arm_pose", POSE_AXES, "the tool's pose, mm and deg"),
        Channel("move", "observation.tactile.move", "/tactip/move", POSE_AXES, "the move (shear) before the picture, mm and deg"),
        Channel("wrench", "observation.tactile.wrench", "/tactip/wrench", WRENCH_AXES, _WRENCH),
        Channel("estimate", "observation.tactile.estimate", "/tactip/estimate", (), "the model's estimate, mm and deg; NaN: not valid"),
        Channel("low", "observation.tactile.estimate_low", "/tactip/estimate_low", (), "lower end of its 90 % interval"),
        Channel("high", "observation.tactile.estimate_high", "/tactip/estimate_high", (), "upper end of its 90 % interval"),
        Channel("width", "observation.gripper_width", "/tactip/gripper_width", ("mm",), "the gripper's width, mm"),
        Channel("goal", "observation.environment_state", "/tactip/goal", (), "the goal of the task"),
        Channel("action", "action", "/tactip/command", POSE_AXES, _ACTION),
    )
}
"""All channels, in the order in which formats have them."""
IMAGE, TIME = "observation.images.tactip", "observation.time_s"
"""Columns of the picture and of the time of its exposure (s, from the episode's first exposure)."""
ONE_VIEW = (IMAGE.rpartition(".")[2],)
"""Name of the only sensor of a record: the last part of the picture's column."""
_ESTIMATED = ("estimate", "low", "high")


def channel_of(name: str) -> Channel:
    """The channel of a name in ``About.numbers``. ``pins.left`` are the pins of the sensor ``left`` in a record of several sensors."""
    kind, _, view = name.partition(".")
    own = CHANNELS[kind]
    if not view:
        return own
    column, topic = own.column.replace("tactile", f"tactile.{view}"), own.topic.replace(ONE_VIEW[0], view)
    return replace(own, name=name, column=column, topic=topic)


def is_pins(name: str) -> bool:
    """Whether a channel's numbers are a sensor's pins."""
    return name.partition(".")[0] == "pins"


def image_column(view: str) -> str:
    """The column of a sensor's picture."""
    return IMAGE.replace(ONE_VIEW[0], view)


@dataclass(frozen=True)
class About:
    """Common properties of all episodes of a record.

    Attributes
    ----------
    sensor : str
        Name of the specification; "" if unknown.
    form : Form
    size_px : (int, int)
        Width and height of the pictures.
    gray : bool
        Whether the pictures have one channel.
    numbers : dict of str to int
        The channels that every step has, in the order of ``CHANNELS``, and how many numbers each has (of pins: 2 N).
    estimates : tuple of str
        Names of the estimated labels.
    frame : str
        Frame of poses and actions: ``base`` (of the arm) or ``work`` (of the experiment).
    robot : str
        Kind of the arm, or a specification such as ``mg400:192.168.1.6``, of which only the kind is kept; "" if unknown.
    names : dict of str to tuple of str
        Names of the numbers of channels that are not the usual ones: of goals, and of actions that are no poses.
    views : tuple of str
        Names of the sensors whose pictures a step has.
    """

    sensor: str
    form: Form
    size_px: tuple[int, int]
    gray: bool
    numbers: dict[str, int]
    estimates: tuple[str, ...] = ()
    frame: str = "work"
    robot: str = ""
    names: dict[str, tuple[str, ...]] = field(default_factory=dict)
    views: tuple[str, ...] = ONE_VIEW

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", self.robot.partition(":")[0].removesuffix("-lenient"))

    def axes(self, channel: str) -> tuple[str, ...]:
        """Names of the numbers of a channel. Pins have ``pin_0_x, pin_0_y, pin_1_x, ...``."""
        if is_pins(channel):
            return tuple(f"pin_{k}_{axis}" for k in range(self.numbers[channel] // 2) for axis in "xy")
        return self.names.get(channel, self.estimates if channel in _ESTIMATED else CHANNELS[channel].axes)

    def is_plain(self, channel: str) -> bool:
        """Whether a channel's numbers are no pose and no wrench."""
        return self.axes(channel) not in (POSE_AXES, WRENCH_AXES)

    def shape(self, channel: str) -> tuple[int, ...]:
        """Shape of a channel's array in one step."""
        count = self.numbers[channel]
        return (count // 2, 2) if is_pins(channel) else (count,)

    def plain(self) -> dict[str, Any]:
        """The properties as JSON."""
        plain = TypeAdapter(About).dump_python(self, mode="json", warnings=False)
        return plain | {"channels": {name: channel_of(name).meaning for name in self.numbers}}

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> "About":
        """The properties from the result of ``plain``.

        Raises
        ------
        ValueError
            A property is missing or wrong.
        """
        about = TypeAdapter(About).validate_python(plain)
        known = {*CHANNELS, *(f"pins.{view}" for view in about.views)}
        if not set(about.numbers) <= known or not about.views or not all(0 < count < 1_000_000 for count in about.numbers.values()):
            raise ValueError("unknown channels")
        return about

    def differs(self, other: "About") -> list[str]:
        """Reasons why episodes of another record do not fit into this one."""
        mine, its = self.plain(), other.plain()
        compared = mine.keys() - {"channels", "robot"}
        return [f"{key} {its[key]!r} instead of {mine[key]!r}" for key in mine if key in compared and mine[key] != its[key]]


@dataclass(frozen=True)
class RecordStep:
    """One moment of an episode.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) uint8
    time_s : float
        Time of the exposure, s, from the episode's first exposure. A step that uses the frame of the step before it is later.
    values : dict of str to array of float32
        The numbers of each channel; shapes as ``About.shape``.
    beside : tuple of array
        The pictures of further sensors.
    """

    image: ImageArray
    time_s: float
    values: Mapping[str, np.ndarray]
    beside: tuple[ImageArray, ...] = ()

    @property
    def images(self) -> tuple[ImageArray, ...]:
        """The pictures of all sensors."""
        return (self.image, *self.beside)


@dataclass(frozen=True)
class Episode:
    """One contact path, or one round of a servo.

    Attributes
    ----------
    key : str
        Unique name of the episode: readable, with a digest of its content.
    task : str
        Description of what is done.
    steps : callable
        Function that gives the steps from the first one. Each step is read when it is needed.
    length : int
        Number of steps.
    rest : array or None
        The picture without contact.
    started_s : float
        Unix time of the first exposure; 0 if unknown.
    T_tool_sensor : (4, 4) float or None
        Pose of the sensor on the tool, mm.
    """

    key: str
    task: str
    steps: Callable[[], Iterator[RecordStep]]
    length: int
    rest: ImageArray | None = None
    started_s: float = 0.0
    T_tool_sensor: np.ndarray | None = field(default=None, compare=False)

    def facts(self) -> dict[str, Any]:
        """The stored facts of the episode without its steps, as JSON."""
        T = None if self.T_tool_sensor is None else np.asarray(self.T_tool_sensor, float).tolist()
        return {"key": self.key, "task": self.task, "length": self.length, "started_s": self.started_s, "T_tool_sensor": T}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any], steps: Callable[[], Iterator[RecordStep]], rest: ImageArray | None) -> "Episode":
        """An episode from the result of ``facts``.

        Raises
        ------
        KeyError, TypeError, ValueError
            Something is missing or wrong.
        """
        T = None if facts["T_tool_sensor"] is None else np.array(facts["T_tool_sensor"], float).reshape(4, 4)
        return cls(str(facts["key"]), str(facts["task"]), steps, int(facts["length"]), rest, float(facts["started_s"]), T)


@dataclass(frozen=True)
class Records:
    """Episodes that were opened for reading.

    Attributes
    ----------
    about : About
    episodes : list of Episode
    notes : list of str
        Irregularities, one line each.
    """

    about: About
    episodes: list[Episode]
    notes: list[str] = field(default_factory=list)

    def with_task(self, task: str) -> "Records":
        """The same records with another task; unchanged for ""."""
        return self if not task else replace(self, episodes=[replace(episode, task=task) for episode in self.episodes])

    def rate_hz(self) -> int:
        """Whole number of frames per second, from the times of the first episode with several steps.

        It is the usual rate, which a pause does not change, or the mean one: the one by which more frames have their true time.
        """
        for episode in self.episodes:
            if episode.length > 1:
                times_s = np.array([step.time_s for step in episode.steps()])
                shortest_s = 1.0 / FASTEST_HZ
                steps_s = [np.median(np.diff(times_s)), times_s[-1] / (len(times_s) - 1)] if len(times_s) > 1 else []
                rates_hz = [max(1, round(1.0 / max(step_s, shortest_s))) for step_s in steps_s]
                return max(rates_hz, key=lambda hz: int((off_s(times_s, hz) <= 0.5 / hz).sum()), default=round(NOMINAL_HZ))
        return round(NOMINAL_HZ)


def off_s(times_s: np.ndarray, rate_hz: int) -> np.ndarray:
    """Differences (n,), s, between the times (n,) of an episode's frames and those of as many frames at a rate."""
    return np.abs(times_s - np.arange(len(times_s)) / rate_hz)


def digest(*parts: object) -> str:
    """A short digest of bytes and of values that JSON can hold, for an episode's key."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part if isinstance(part, bytes) else json.dumps(part, sort_keys=True, default=str).encode())
    return found.hexdigest()[:DIGEST]


def float32(numbers: object, count: int | None = None) -> np.ndarray:
    """Numbers as a channel stores them; None, and missing numbers at the end, become NaN."""
    values = np.array([np.nan if value is None else value for value in np.ravel(np.asarray(numbers, object))], np.float32)
    if count is not None and len(values) != count:
        values = np.concatenate([values[:count], np.full(max(0, count - len(values)), np.nan, np.float32)])
    return values


def seconds(time_s: float) -> float:
    """A time rounded to the nanosecond, which every format can hold."""
    return round(float(time_s), 9)
