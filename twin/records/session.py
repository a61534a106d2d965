"""A live session on disk: every frame as the camera delivered it, and a line of JSON for each step.

``session.json`` describes the session. ``steps.jsonl`` has one line for each step, ``frames/`` the pictures (PNG, lossless). A picture is
written before its line, so every picture that a line names exists. Therefore the session can be read up to its last complete line at any
time. ``rest.png`` is the no-contact frame from which pin displacements were computed, if one was taken.
"""

import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from scenes import load_experiment, load_sensor
from scenes.base import Name, SpecError, problem_text
from scenes.files import quote, read_regular
from twin.errors import ErrorsAs, FrameError, StoreError, format_count
from twin.frames.forms import times
from twin.frames.images import read_image, write_image
from twin.frames.videos import describe_pauses
from twin.records.folder import read_json
from twin.records.record import CHANNELS, POSE_AXES, About, Episode, Records, RecordStep, digest, float32, seconds
from twin.rig.kinematics import Mounting
from twin.store import contents, write_json, writing
from twin.types import Form, Frame

ABOUT, STEPS, FRAMES, REST = "session.json", "steps.jsonl", "frames", "rest.png"
SESSION_FILES = (ABOUT, STEPS, FRAMES, REST)
VERSION = 1
LARGEST_BYTES = 1_000_000_000  # of the steps: enough for a million of them, more than one day at 10 Hz
LARGEST_ABOUT_BYTES = 1_000_000  # of the description


def is_session(path: str | Path) -> bool:
    """Whether a folder holds a recorded session."""
    return (Path(path) / ABOUT).is_file() and (Path(path) / STEPS).is_file()


class SessionWriter(AbstractContextManager["SessionWriter"]):
    """Appends the steps of a session.

    Parameters
    ----------
    folder : path
        A new or empty folder, or the folder of a session that ended before its first step. Such a session is started again.
    about : dict
        Sensor, camera, model and arm, in types that JSON can hold.

    Raises
    ------
    StoreError
        The folder holds something else, or can't be written to.
    """

    def __init__(self, folder: str | Path, about: dict) -> None:
        self.folder = Path(folder)
        begun_only = is_session(self.folder) and not (self.folder / STEPS).stat().st_size
        if contents(self.folder) and not begun_only:
            raise StoreError(f"{self.folder}: not empty; give a new folder for the session")
        (self.folder / FRAMES).mkdir(parents=True, exist_ok=True)
        (self.folder / REST).unlink(missing_ok=True)
        clock = {"unix_s": time.time(), "monotonic_s": time.monotonic()}  # the same moment on both clocks; frames use the second
        write_json(self.folder / ABOUT, {"version": VERSION, "clock": clock, **about})
        self._lines = (self.folder / STEPS).open("a", encoding="utf-8")
        self._written: dict[int, str] = {}  # the newest picture by its number, because several steps may use one frame
        self.count = 0

    def append(self, frame: Frame, step: dict) -> None:
        """Write a step and its frame."""
        name = self._written.get(frame.sequence)
        if name is None:
            name = f"frame_{self.count:06d}.png"
            write_image(self.folder / FRAMES / name, frame.image)
            self._written = {frame.sequence: name}
        about_frame = {"file": name, "name": frame.name, "form": str(frame.form), "time_s": frame.time_s, "sequence": frame.sequence}
        line = {"step": self.count, "frame": about_frame, **{key: plain(value) for key, value in step.items()}}
        with writing(self.folder / STEPS):
            self._lines.write(json.dumps(line) + "\n")
            self._lines.flush()
        self.count += 1

    def keep_rest(self, frame: Frame) -> None:
        """Keep the no-contact frame from which pin displacements are computed."""
        write_image(self.folder / REST, frame.image)

    def close(self) -> None:
        """End the session. The lines of complete steps are already on disk.

        Raises
        ------
        StoreError
            A line that could not be written before can't be written now.
        """
        with writing(self.folder / STEPS):
            self._lines.close()

    def __exit__(self, *_: object) -> None:
        self.close()


class _FrameLine(BaseModel):
    """The part of a step's line that describes its frame."""

    file: Name
    name: str
    form: Form
    time_s: float
    sequence: int


class _StepLine(BaseModel):
    """The part of a step's line that a replay needs."""

    step: int
    frame: _FrameLine
    time_s: float = 0.0
    value: list[float | None] = []


def _steps_and_note(folder: Path) -> tuple[list[dict], str]:
    """The complete steps of a session, and the fault in the line after them ("" if there is none).

    An incomplete last line, and everything after it, is left out.

    Raises
    ------
    FrameError
        The file can't be read.
    """
    with ErrorsAs(OSError, lambda error: FrameError(f"{folder}: {STEPS} can't be read ({error.strerror}); give the folder of a session")):
        text = read_regular(folder / STEPS, LARGEST_BYTES).decode("utf-8", "replace")
    steps: list[dict] = []
    lines = text.split("\n")
    with suppress(ValueError, RecursionError):
        for line in lines[:-1]:
            if not isinstance(step := json.loads(line), dict):
                break
            steps.append(step)
    whole = len(steps) == len(lines) - 1 and not lines[-1]
    return steps, "" if whole else f"{STEPS}: line {len(steps) + 1} is cut or damaged; the lines before it are read"


class Session:
    """A recorded session, opened for reading.

    Parameters
    ----------
    folder : path

    Attributes
    ----------
    about : dict
        Description of the session.
    steps : list of dict
        The complete steps.
    form : Form
    notes : list of str
        Irregularities, one line each.

    Raises
    ------
    FrameError
        The folder holds no session, one of another version, or a damaged one. An incomplete last line does not count as damage.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not is_session(self.folder):
            raise FrameError(f"{folder}: holds no recorded session ({ABOUT} and {STEPS} are expected); '--record DIR' writes one")
        self.about = read_json(self.folder / ABOUT, most_bytes=LARGEST_ABOUT_BYTES, error=FrameError, again="copy the session again")
        if (version := self.about.get("version")) != VERSION:
            said = f"is of version {quote(version)}, expected {VERSION}; replay it with the program that wrote it"
            raise FrameError(f"{self.folder / ABOUT}: {said}")
        self.steps, note = _steps_and_note(self.folder)
        if not self.steps:
            raise FrameError(f"{folder}: {note or 'the session ended before its first step'}; nothing to replay, record it again")
        checked = [self._check_step(number, step) for number, step in enumerate(self.steps, 1)]
        self._lines, self._decided_s = [line.frame for line in checked], [line.time_s for line in checked]
        loose = {path.name for path in (self.folder / FRAMES).glob("*.png")} - {line.file for line in self._lines}
        loose_note = f"{FRAMES}/ has pictures without a step in {STEPS} ({len(loose)}): the session was interrupted" if loose else ""
        self.notes = [each for each in (note, loose_note) if each]
        self.form = self._lines[0].form

    def _check_step(self, number: int, step: dict) -> _StepLine:
        try:
            line = _StepLine.model_validate(step)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key, problem = ".".join(map(quote, first["loc"])), quote(problem_text(first))
            raise FrameError(f"{self.folder}: {STEPS}, line {number}: {key}: {problem}; copy the session again") from error
        if line.step != number - 1:
            raise FrameError(f"{self.folder}: {STEPS}, line {number} is of step {line.step}: lines are missing; copy the session again")
        return line

    def _picture(self, name: str) -> np.ndarray:
        """A picture of the session by its path in the folder. A picture outside the folder is not read, even if a link leads to it."""
        path = self.folder / name
        if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self.folder)):
            raise FrameError(f"{self.folder}: {name} is a link to outside the session; put the picture itself there")
        with ErrorsAs(FrameError, lambda error: FrameError(f"{self.folder}: {error}")):
            return read_image(path)[0]

    def stills(self) -> list[str]:
        """Pauses between frames, frames that the camera took and nobody read, and steps that use a frame again, one line each."""
        used = {line.sequence: line.time_s for line in self._lines}
        numbers, times_s = sorted(used), [used[number] for number in sorted(used)]
        unread, again = numbers[-1] - numbers[0] + 1 - len(numbers), len(self._lines) - len(numbers)
        found = [describe_pauses(times_s)]
        found += [f"{format_count(unread, 'frames')} of the camera between the recorded ones, not in the session"] if unread > 0 else []
        found += [f"{again} of {len(self._lines)} steps use the same frame as the step before them"] if again else []
        return [f"{self.folder.name}: {each}" for each in found if each]

    @property
    def rest(self) -> Frame | None:
        """The no-contact frame from which displacements were computed; None if they were computed from the nominal layout."""
        if not (self.folder / REST).is_file():
            return None
        return Frame(self._picture(REST), self.form, REST)

    def frame(self, index: int) -> Frame:
        """The frame of a step. A frame that several steps used is returned for each of them.

        Raises
        ------
        FrameError
            The picture can't be read.
        """
        line = self._lines[index]
        return Frame(self._picture(f"{FRAMES}/{line.file}"), line.form, line.name, line.time_s, line.sequence)

    def __iter__(self) -> Iterator[Frame]:
        return map(self.frame, range(len(self.steps)))

    def step_s(self, index: int) -> float:
        """Time of a step: the exposure of its frame, and the time that passed since the first step that used this frame."""
        first = index
        while first and self._lines[first - 1].sequence == self._lines[index].sequence:
            first -= 1
        return self._lines[index].time_s + self._decided_s[index] - self._decided_s[first]


def session_records(folder: Path) -> Records:
    """A session as a record of one episode.

    Raises
    ------
    FrameError
        As for ``Session``, or the first picture can't be read.
    """
    session = Session(folder)
    first, first_s, image = session.steps[0], session.frame(0).time_s, session.frame(0).image
    estimates = tuple(map(str, first.get("names", [])))
    counts = {"pose": 6, "action": 6, "width": 1} | dict.fromkeys(("estimate", "low", "high"), len(estimates))
    counts["pins"] = 2 * len(first["pins"]) if isinstance(first.get("pins"), list) else 0
    names: dict[str, tuple[str, ...]] = {}
    if "sent_mm" in first:
        counts["action"], names = 7, {"action": (*POSE_AXES, "width")}
    about = About(
        sensor=str(session.about.get("sensor", "")),
        form=session.form,
        size_px=(image.shape[1], image.shape[0]),
        gray=image.ndim == 2,
        numbers={name: counts[name] for name in CHANNELS if name in _KEYS and _KEYS[name][0] in first and counts[name]},
        estimates=estimates,
        frame="base",
        robot=str(session.about.get("arm", "")),
        names=names,
    )
    touched = session.about.get("object")
    rest = session.rest
    episode = Episode(
        key=f"{folder.name}#{digest(session.about, first)}",
        task=f"follow the {touched}" if touched else "grip" if "gripper" in session.about else "watch what the sensor touches",
        steps=partial(_steps_of, session, about, first_s),
        length=len(session.steps),
        rest=None if rest is None else rest.image,
        started_s=_started_s(session),
        T_tool_sensor=_sensor_on_tool(session.about),
    )
    return Records(about, [episode], [*session.notes, *session.stills()])


# Keys of a step's line that hold the numbers of a channel.
_KEYS: dict[str, tuple[str, ...]] = {"pins": ("pins",), "pose": ("exposed_pose",), "width": ("width_mm",), "action": ("sent", "sent_mm")}
_KEYS |= {"estimate": ("value",), "low": ("low",), "high": ("high",)}


def rig_records(folder: Path) -> Records | None:
    """The sessions of several sensors on one rig, in subfolders that have the sensors' names, as one record; None if there are none.

    Raises
    ------
    FrameError
        As for ``session_records``, or the sessions do not fit together.
    """
    views = [each.name for each in sorted(folder.iterdir()) if is_session(each)]
    named = [Session(folder / view).about.get("sensors") for view in views]
    if len(views) < 2 or not all(isinstance(names, list) and all(view in names for view in views) for names in named):
        return None
    parts = [session_records(folder / view) for view in views]
    about, episodes = parts[0].about, [records.episodes[0] for records in parts]
    for view, records in zip(views, parts, strict=True):
        if wrong := about.differs(records.about):
            raise FrameError(f"{folder}: {view} does not fit {views[0]} ({'; '.join(wrong)}); translate each session alone")
    numbers = {f"pins.{view}": count for name, count in about.numbers.items() if name == "pins" for view in views}
    numbers |= {name: count for name, count in about.numbers.items() if name != "pins"}

    def steps() -> Iterator[RecordStep]:
        for each in zip(*(episode.steps() for episode in episodes), strict=False):
            pins = {f"pins.{view}": step.values["pins"] for view, step in zip(views, each, strict=True) if "pins" in step.values}
            values = {name: value for name, value in each[0].values.items() if name != "pins"}
            yield replace(each[0], values=pins | values, beside=tuple(step.image for step in each[1:]))

    key = f"{folder.name}#{digest(*(episode.key for episode in episodes))}"
    joined = replace(episodes[0], key=key, steps=steps, length=min(episode.length for episode in episodes))
    return Records(replace(about, numbers=numbers, views=tuple(views)), [joined], [note for records in parts for note in records.notes])


def _steps_of(session: Session, about: About, first_s: float) -> Iterator[RecordStep]:
    for index, line in enumerate(session.steps):
        frame = session.frame(index)
        if frame.image.shape[1::-1] != about.size_px:
            got, expected = times(frame.image.shape[1::-1]), times(about.size_px)
            place = f"{session.folder}: {line['frame']['file']}"
            raise FrameError(f"{place}: expected {expected} as the first frame, got {got}; record it again")
        values = _numbers_in(line, about, f"{session.folder}: {STEPS}, line {index + 1}")
        yield RecordStep(frame.image, seconds(session.step_s(index) - first_s), values)


def _numbers_in(line: dict, about: About, place: str) -> dict[str, np.ndarray]:
    """The numbers of each channel in a step's line; ``place`` is where the line is, for errors."""
    values = {}
    with ErrorsAs((TypeError, ValueError), lambda error: FrameError(f"{place} holds no numbers ({error}); copy the session again")):
        for name, count in about.numbers.items():
            parts = [np.ravel(np.asarray(line.get(key, []), object)) for key in _KEYS[name]]
            values[name] = float32(np.concatenate(parts), count).reshape(about.shape(name))
    return values


def _started_s(session: Session) -> float:
    """Unix time of the session's first frame; 0 if the session states no clock or a damaged one."""
    try:
        clock = session.about["clock"]
        started_s = float(clock["unix_s"]) + session.frame(0).time_s - float(clock["monotonic_s"])
    except (KeyError, TypeError, ValueError):
        return 0.0
    return started_s if math.isfinite(started_s) else 0.0


def _sensor_on_tool(about: dict[str, Any]) -> np.ndarray | None:
    """``T_tool_sensor`` (4, 4) of a session that states its sensor and its servo; None if it states neither, or they are not known."""
    try:
        return Mounting.of(load_sensor(about["sensor"]), load_experiment(about["servo"]["experiment"])).T_tool_sensor
    except (KeyError, TypeError, SpecError):
        return None


def plain(value: object) -> object:
    """The value in a form that JSON can hold: an array becomes a list, a number that is not finite becomes null."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
