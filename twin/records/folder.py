"""A folder that a record is written to: what it says of itself, and how episodes come into it one after the other.

``tactip.json`` states the format and what all episodes have in common. A folder is gone on with only if both are the same.
"""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from scenes.files import read_regular, shown
from twin.errors import FrameError
from twin.frames.images import read_image
from twin.frames.lerobot import RESTS
from twin.records.record import About, Episode, RecordError, Records, Step, digest, library
from twin.store import contents, output, write_bytes, write_json
from twin.types import ImageArray

SIDECAR = "tactip.json"
"""File that says what the folder is."""
VERSION = 1
"""Version of what is written."""
HELD_STEPS = 1000
"""Pictures from which on formats of single pictures finish a folder or a table of several episodes."""
LARGEST_BYTES = 100_000_000
"""Bytes of a JSON file: a million steps' worth."""
AGAIN = "copy it again, or translate it again"
"""Remedy for damaged records."""


class FolderWriter(ABC):
    """Writes episodes into a folder. A context manager; the folder is held for this run meanwhile.

    Parameters
    ----------
    folder : Path
        New, empty, or holding a record of this format with the same ``about``, which is gone on with.
    about : About
    rate_hz : int
        Whole number of frames a second, for formats that state one. A record that is gone on with keeps its own.

    Raises
    ------
    RecordError
        On entering: the folder holds something else, or records that do not fit.
    StoreError
        The folder can't be written to, or another run is at work there.
    """

    FORMAT: ClassVar[str]
    NAMES: ClassVar[tuple[str, ...]]  # of everything that is written right below the folder, beside the sidecar
    FOLDERS: ClassVar[tuple[str, ...]] = ()  # that are there from the beginning
    LIBRARIES: ClassVar[tuple[str, ...]] = ()  # that need not be installed

    def __init__(self, folder: Path, about: About, rate_hz: int) -> None:
        self.folder, self.about, self.rate_hz = folder, about, rate_hz
        self.facts: list[dict[str, Any]] = []  # of the episodes that are there
        self.keys: set[str] = set()
        self._held = ExitStack()

    def __enter__(self) -> Self:
        for name in self.LIBRARIES:
            library(name)
        fresh = not os.path.isfile(self.folder / SIDECAR)  # unlike ``Path.is_file`` False for what is no path at all
        if fresh and contents(self.folder):
            raise RecordError(f"{self.folder}: holds something else; give a new or empty folder")
        with ExitStack() as held:
            held.enter_context(output(self.folder, gone_on=(SIDECAR, RESTS, *self.NAMES)))
            if fresh:
                self._begin()
                write_json(self.folder / SIDECAR, self._said())
            else:
                self._go_on()
            self._held = held.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._held.close()

    def write(self, episodes: Iterator[Episode]) -> int:
        """Write episodes, and return how many. Those without a readable step are left out."""
        before = len(self.facts)
        for group in self._groups(episodes):
            self.facts += group
            self.keys |= {facts["key"] for facts in group}
        return len(self.facts) - before

    @abstractmethod
    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        """Write episodes, several at once where the format is the better for it, and give the facts of each group once it is whole."""

    @abstractmethod
    def _find(self) -> list[dict[str, Any]]:
        """Facts of the episodes in the folder. What an interrupted run left unfinished is removed."""

    def _begin(self) -> None:
        """Write what a new folder has before its first episode."""
        for name in self.FOLDERS:
            (self.folder / name).mkdir(exist_ok=True)

    def _said(self) -> dict[str, Any]:
        return {"format": self.FORMAT, "version": VERSION, "rate_hz": self.rate_hz, "about": self.about.plain()}

    def _go_on(self) -> None:
        about, said = read_sidecar(self.folder, self.FORMAT)
        if wrong := about.differs(self.about):
            raise RecordError(f"{self.folder}: the new episodes do not fit to those in it ({'; '.join(wrong)}); give another --out")
        self.about, self.rate_hz = about, int(said["rate_hz"])
        self.facts = self._find()
        self.keys = {facts["key"] for facts in self.facts}

    def _facts(self, episode: Episode, length: int) -> dict[str, Any]:
        """What is kept of an episode that turned out to have so many steps; its picture without contact is written."""
        return episode.facts() | {"length": length, "rest": None if episode.rest is None else self._keep_rest(episode.rest)}

    def _keep_rest(self, image: ImageArray) -> str:
        data = png(image)
        name = f"{digest(data)}.png"
        if not (self.folder / RESTS / name).is_file():
            (self.folder / RESTS).mkdir(exist_ok=True)
            write_bytes(self.folder / RESTS / name, data)
        return name

    def _require_fitting(self, episode: Episode, step: Step) -> None:
        """Raise ``RecordError`` if a step is not as ``about`` says, or its time is none."""
        if not 0.0 <= step.time_s < float("inf"):
            raise RecordError(f"{episode.key}: a picture {step.time_s} s after its first; look at its times, or record it again")
        height, width = step.image.shape[:2]
        if (width, height) != self.about.size_px or (step.image.ndim == 2) != self.about.gray:
            raise RecordError(f"{episode.key}: a picture of {step.image.shape}, the others have {self.about.size_px}; record it apart")
        for name in self.about.numbers:
            if (got := np.shape(step.values.get(name, ()))) != self.about.shape(name):
                raise RecordError(f"{episode.key}: {name} of shape {got}, expected {self.about.shape(name)}; record it apart")


def read_sidecar(folder: Path, form: str = "") -> tuple[About, dict[str, Any]]:
    """What a folder says of itself.

    Raises
    ------
    RecordError
        It says nothing, is damaged, or of another format than ``form`` or another version.
    """
    said = read_json(folder / SIDECAR)
    try:
        about = About.of(said["about"])
        found, version = str(said["format"]), said["version"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RecordError(f"{folder / SIDECAR}: damaged; {AGAIN}") from error
    if version != VERSION:
        raise RecordError(f"{folder / SIDECAR}: of version {version!r}, expected {VERSION}; read it with the program that wrote it")
    if form and found != form:
        raise RecordError(f"{folder}: holds a record of the format {found}, not {form}; give another --out")
    return about, said


def format_of(folder: Path) -> str:
    """Format of the record that a folder says to hold; "" if it says none."""
    return str(read_sidecar(folder)[1]["format"]) if (folder / SIDECAR).is_file() else ""


def read_json(path: Path) -> dict[str, Any]:
    """Keys and values of a JSON file.

    Raises
    ------
    RecordError
        It can't be read or holds something else.
    """
    try:
        found = json.loads(read_regular(path, LARGEST_BYTES))
    except OSError as error:
        raise RecordError(f"{path}: can't be read ({error.strerror}); {AGAIN}") from error
    except (ValueError, RecursionError) as error:
        raise RecordError(f"{path}: damaged, no JSON; {AGAIN}") from error
    if not isinstance(found, dict):
        raise RecordError(f"{path}: damaged, holds no keys and values; {AGAIN}")
    return found


def require_numbered(files: Sequence[Path], name: Callable[[int], str]) -> None:
    """Raise ``RecordError`` if files, in order, do not have the names of 0, 1, 2 and so on."""
    for number, path in enumerate(files):
        if path.name != name(number):
            raise RecordError(f"{path.parent}: {name(number)} is missing; {AGAIN}")


def episode_of(folder: Path, facts: dict[str, Any], steps: Any) -> Episode:
    """An episode by what is kept of it.

    Raises
    ------
    RecordError
        Something is damaged.
    """
    try:
        rest = None if facts["rest"] is None else read_image(folder / RESTS / str(facts["rest"]))[0]
        return Episode.from_facts(facts, steps, rest)
    except (KeyError, TypeError, ValueError, FrameError) as error:
        raise RecordError(f"{folder}: what is kept of an episode is damaged ({error}); {AGAIN}") from error


def records_in(folder: Path, form: str, facts: Sequence[dict[str, Any]], steps_of: Any) -> Records:
    """The records of a folder. ``steps_of(about, index)`` gives the steps of an episode."""
    about, _ = read_sidecar(folder, form)
    whole = [partial(whole_steps, folder, each, steps_of(about, index)) for index, each in enumerate(facts)]
    return Records(about, [episode_of(folder, each, steps) for each, steps in zip(facts, whole, strict=True)])


def whole_steps(path: Path, facts: dict[str, Any], steps: Callable[[], Iterator[Step]]) -> Iterator[Step]:
    """The steps of an episode.

    Raises
    ------
    RecordError
        There are not as many as it had.
    """
    count = 0
    for step in steps():
        count += 1
        yield step
    if count != facts["length"]:
        raise RecordError(f"{path}: damaged, {count} of {facts['length']} steps of {shown(facts['key'])} are there; {AGAIN}")


def png(image: ImageArray) -> bytes:
    """A picture as PNG."""
    return cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1].tobytes()


def image_of(data: bytes, gray: bool, name: str) -> ImageArray:
    """A picture from PNG; of a gray one that was kept with three equal channels, the first.

    Raises
    ------
    RecordError
        It can't be decoded.
    """
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if stored is None or stored.dtype != np.uint8:
        raise RecordError(f"{name}: a picture is damaged; {AGAIN}")
    if gray:
        return np.ascontiguousarray(stored if stored.ndim == 2 else stored[..., 0])
    return np.ascontiguousarray(stored[..., 2::-1] if stored.ndim == 3 else np.repeat(stored[..., None], 3, axis=2))
