"""A live session on disk: every frame as it was, and a line of JSON for each step.

``session.json`` says what the session is. ``steps.jsonl`` has one line a step, ``frames/`` the pictures (PNG, lossless). A picture is
written before its line, so every picture that a line names exists, and the session can be read up to its last complete line at any
time. ``rest.png`` is the frame without contact that pins were counted from, if one was taken.
"""

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import BaseModel, ValidationError

from hardware.cameras.recorded import SequentialSource
from hardware.errors import DeviceError
from scenes.base import Name
from scenes.files import read_regular, shown
from twin.errors import FrameError
from twin.frames.images import read_image, write_image
from twin.store import contents, unwritten, write_json
from twin.types import Form, Frame

ABOUT, STEPS, FRAMES, REST = "session.json", "steps.jsonl", "frames", "rest.png"
SESSION_FILES = (ABOUT, STEPS, FRAMES, REST)
VERSION = 1
LARGEST_BYTES = 1_000_000_000  # of the steps: a million of them, which a day at 10 Hz has
LARGEST_ABOUT_BYTES = 1_000_000  # of what the session is


def is_session(path: str | Path) -> bool:
    """Whether a folder holds a recorded session."""
    return (Path(path) / ABOUT).is_file() and (Path(path) / STEPS).is_file()


class SessionWriter:
    """Appends the steps of a session.

    Parameters
    ----------
    folder : path
        A new or empty folder, or the folder of a session that ended before its first step. Such a session is begun anew.
    about : dict
        Sensor, camera, model and arm, in types that JSON can hold.
    """

    def __init__(self, folder: str | Path, about: dict) -> None:
        self.folder = Path(folder)
        begun_only = is_session(self.folder) and not (self.folder / STEPS).stat().st_size
        if contents(self.folder) and not begun_only:
            raise DeviceError(f"{self.folder}: not empty; give a new folder for the session")
        (self.folder / FRAMES).mkdir(parents=True, exist_ok=True)
        (self.folder / REST).unlink(missing_ok=True)
        write_json(self.folder / ABOUT, {"version": VERSION, **about})
        self._lines = (self.folder / STEPS).open("a", encoding="utf-8")
        self._written: dict[int, str] = {}  # the newest picture by its number: a frame may serve several steps
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
        try:
            self._lines.write(json.dumps(line) + "\n")
            self._lines.flush()
        except OSError as error:
            raise unwritten(self.folder / STEPS, error) from error
        self.count += 1

    def keep_rest(self, frame: Frame) -> None:
        """Keep the frame without contact that pins are counted from."""
        write_image(self.folder / REST, frame.image)

    def close(self) -> None:
        """End the session; its lines are on disk already."""
        self._lines.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _FrameLine(BaseModel):
    """What a step's line says about its frame."""

    file: Name
    name: str
    form: Form
    time_s: float
    sequence: int


class _StepLine(BaseModel):
    """What a replay needs of a step's line."""

    step: int
    frame: _FrameLine
    value: list[float | None] = []


def read_steps(folder: str | Path) -> list[dict]:
    """Every complete step of a session; a line that was being written when it ended is left out, with all after it.

    Raises
    ------
    FrameError
        The file can't be read.
    """
    return _steps_and_note(Path(folder))[0]


def _steps_and_note(folder: Path) -> tuple[list[dict], str]:
    """A session's complete steps, and what is wrong with the line after them ("" if there is none)."""
    try:
        text = read_regular(folder / STEPS, LARGEST_BYTES).decode("utf-8", "replace")
    except OSError as error:
        raise FrameError(f"{folder}: {STEPS} can't be read ({error.strerror}); give the folder of a session") from error
    steps: list[dict] = []
    lines = text.split("\n")
    for line in lines[:-1]:
        try:
            step = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(step, dict):
            break
        steps.append(step)
    whole = len(steps) == len(lines) - 1 and not lines[-1]
    return steps, "" if whole else f"{STEPS}: line {len(steps) + 1} is cut or damaged; the {len(steps)} steps before it are read"


class SessionSource(SequentialSource):
    """A session's frames in the order of its steps. A frame that served several steps is given once for each.

    Parameters
    ----------
    folder : path

    Raises
    ------
    FrameError
        The folder holds no session, one of another version, or a damaged one. A line that was being written when the session ended is
        no damage.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not is_session(self.folder):
            raise FrameError(f"{folder}: holds no recorded session ({ABOUT} and {STEPS} are expected); '--record DIR' writes one")
        self.about = self._read_about()
        self.steps, note = _steps_and_note(self.folder)
        if not self.steps:
            raise FrameError(f"{folder}: {note or 'the session ended before its first step'}; nothing to replay, record it again")
        self._lines = [self._checked(number, step).frame for number, step in enumerate(self.steps, 1)]
        loose = {path.name for path in (self.folder / FRAMES).glob("*.png")} - {line.file for line in self._lines}
        loose_note = f"{len(loose)} pictures in {FRAMES}/ have no step in {STEPS}: the session was cut" if loose else ""
        self._notes = [each for each in (note, loose_note) if each]
        super().__init__(str(folder), self._lines[0].form)

    def _read_about(self) -> dict:
        try:
            about = json.loads(read_regular(self.folder / ABOUT, LARGEST_ABOUT_BYTES).decode("utf-8-sig"))
        except OSError as error:
            raise FrameError(f"{self.folder}: {ABOUT} can't be read ({error.strerror}); copy the session again") from error
        except (ValueError, RecursionError) as error:
            raise FrameError(f"{self.folder}: {ABOUT} is no JSON; copy the session again") from error
        if not isinstance(about, dict) or "version" not in about:
            raise FrameError(f"{self.folder}: {ABOUT} is not that of a session; copy the session again")
        if about["version"] != VERSION:
            version = shown(about["version"])
            raise FrameError(
                f"{self.folder}: {ABOUT} is of version {version}, expected {VERSION}; replay it with the program that wrote it"
            )
        return about

    def _checked(self, number: int, step: dict) -> _StepLine:
        try:
            line = _StepLine.model_validate(step)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key, problem = ".".join(shown(part) for part in first["loc"]), shown(first["msg"].removeprefix("Value error, "))
            raise FrameError(f"{self.folder}: {STEPS}, line {number}: {key}: {problem}; copy the session again") from error
        if line.step != number - 1:
            raise FrameError(f"{self.folder}: {STEPS}, line {number} is of step {line.step}: lines are missing; copy the session again")
        return line

    def _picture(self, name: str) -> np.ndarray:
        """A picture of the session by its path in the folder; one that lies elsewhere is not read, even where a link leads to it."""
        path = self.folder / name
        if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(self.folder)):
            raise FrameError(f"{self.folder}: {name} is a link to outside the session; put the picture itself there")
        try:
            return read_image(path)[0]
        except FrameError as error:
            raise FrameError(f"{self.folder}: {error}") from error

    @property
    def rest(self) -> Frame | None:
        """The frame without contact that pins were counted from; None if they were counted from the nominal layout."""
        if not (self.folder / REST).is_file():
            return None
        return Frame(self._picture(REST), self.form, REST)

    def notes(self) -> list[str]:
        return self._notes

    def _frames(self) -> Iterator[Frame]:
        for line in self._lines:
            image = self._picture(f"{FRAMES}/{line.file}")
            yield Frame(image, line.form, line.name, line.time_s, line.sequence)


def plain(value: object) -> object:
    """The value as JSON can hold it: an array becomes a list, a number that is not finite becomes null."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
