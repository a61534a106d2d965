"""Base of the writers that put a record into a folder: the folder's description, and the writing of one episode after the other.

``tactip.json`` states the format and the common properties of all episodes. A folder is continued only if both are the same.
"""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from scenes.files import quote, read_regular
from twin.errors import ErrorsAs, FrameError, TwinError, library
from twin.frames.images import png, read_image
from twin.frames.lerobot import RESTS
from twin.records.record import About, Episode, RecordError, Records, RecordStep, channel_of, digest
from twin.store import contents, output, write_bytes, write_json, write_with
from twin.types import ImageArray

SIDECAR = "tactip.json"
"""File with the folder's description."""
VERSION = 1
"""Version of the written format."""
HELD_STEPS = 1000
"""Number of pictures after which a writer of single pictures finishes a folder or a table of several episodes."""
LARGEST_BYTES = 100_000_000
"""Largest size of a JSON file, bytes: enough for a million steps."""
AGAIN = "copy it again, or translate it again"
"""What a message tells the user to do with damaged records."""


class FolderWriter(ABC):
    """Writes episodes into a folder. A context manager, which locks the folder for this run.

    Parameters
    ----------
    folder : Path
        A new or empty folder, or one with a record of this format and the same ``about``, which is continued.
    about : About
    rate_hz : int
        Whole number of frames per second, for formats that state one. A record that is continued keeps its own number.
    video : bool
        Store pictures as video, which loses detail, in a format that has ``VIDEOS``.
    at_once : bool
        Finish a file for each episode instead of larger files, so that an episode is safe as soon as it is written.

    Raises
    ------
    RecordError
        When the context is entered: the folder holds something else, or records that do not fit.
    StoreError
        The folder can't be written to, or another run uses it.
    """

    FORMAT: ClassVar[str]
    NAMES: ClassVar[tuple[str, ...]]  # of everything that is written directly in the folder, besides the description
    FOLDERS: ClassVar[tuple[str, ...]] = ()  # subfolders that exist from the beginning
    LIBRARIES: ClassVar[tuple[str, ...]] = ()  # optional libraries that the format needs
    VIEWS, VIDEOS = False, False  # whether a step may have several pictures, and whether pictures may be stored as video

    def __init__(self, folder: Path, about: About, rate_hz: int, *, video: bool = False, at_once: bool = False) -> None:
        self.folder, self.about, self.rate_hz, self.video, self.at_once = folder, about, rate_hz, video, at_once
        self.facts: list[dict[str, Any]] = []  # of the episodes in the folder
        self._held = ExitStack()

    @property
    def keys(self) -> set[str]:
        """Keys of the episodes in the folder."""
        return {facts["key"] for facts in self.facts}

    def __enter__(self) -> Self:
        for name in self.LIBRARIES:
            library(name)
        fresh = not os.path.isfile(self.folder / SIDECAR)  # unlike ``Path.is_file``, this returns False for a text that can be no path
        if fresh and contents(self.folder):
            raise RecordError(f"{self.folder}: holds something else; give a new or empty folder")
        with ExitStack() as held:
            held.enter_context(output(self.folder, gone_on=(SIDECAR, RESTS, *self.NAMES)))
            if fresh:
                self._begin()
                write_json(self.folder / SIDECAR, self._metadata())
            else:
                self._go_on()
            self._held = held.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def write(self, episodes: Iterator[Episode]) -> int:
        """Write episodes, and return their number. Episodes without a readable step are left out."""
        before = len(self.facts)
        for group in self._groups(episodes):
            self.facts += group
        return len(self.facts) - before

    def notes(self) -> list[str]:
        """What the format could not hold of the episodes that were written, one line each."""
        return []

    @abstractmethod
    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        """Write episodes, several together if this suits the format, and give the facts of each group as soon as the group is complete."""

    @abstractmethod
    def _find(self) -> list[dict[str, Any]]:
        """Facts of the episodes in the folder. Unfinished parts of an interrupted run are removed."""

    def _begin(self) -> None:
        """Write the parts that a new folder has before its first episode."""
        for name in self.FOLDERS:
            (self.folder / name).mkdir(exist_ok=True)

    def _metadata(self) -> dict[str, Any]:
        return {"format": self.FORMAT, "version": VERSION, "rate_hz": self.rate_hz, "about": self.about.plain()}

    def _go_on(self) -> None:
        about, stored = read_sidecar(self.folder, self.FORMAT)
        if wrong := about.differs(self.about):
            raise RecordError(f"{self.folder}: the new episodes do not fit those in it ({'; '.join(wrong)}); give another `out`")
        self.about, self.rate_hz = about, int(stored["rate_hz"])
        self.facts = self._find()

    def _facts(self, episode: Episode, length: int) -> dict[str, Any]:
        """Facts to store of an episode with ``length`` steps. Its picture without contact is written."""
        return episode.facts() | {"length": length, "rest": None if episode.rest is None else self._keep_rest(episode.rest)}

    def _keep_rest(self, image: ImageArray) -> str:
        data = png(image)
        name = f"{digest(data)}.png"
        if not (self.folder / RESTS / name).is_file():
            (self.folder / RESTS).mkdir(exist_ok=True)
            write_bytes(self.folder / RESTS / name, data)
        return name

    def _require_fitting(self, episode: Episode, step: RecordStep) -> None:
        """Raise ``RecordError`` if a step does not agree with ``about``, or its time is not a valid number."""
        if not 0.0 <= step.time_s < float("inf"):
            raise RecordError(f"{episode.key}: a picture has the time {step.time_s} s after the first; correct the times, or record again")
        for image in step.images:
            height, width = image.shape[:2]
            if (width, height) != self.about.size_px or (image.ndim == 2) != self.about.gray:
                raise RecordError(f"{episode.key}: a picture of {image.shape}, the others have {self.about.size_px}; record it separately")
        for name in self.about.numbers:
            if (got := np.shape(step.values.get(name, ()))) != self.about.shape(name):
                raise RecordError(f"{episode.key}: {name} of shape {got}, expected {self.about.shape(name)}; record it separately")


class PicturesWriter(FolderWriter):
    """Writes single pictures and tables of several episodes."""

    @abstractmethod
    def _write_step(self, episode: Episode, step: RecordStep, number: int, k: int) -> Any:
        """Write the picture of the step ``k`` of the episode ``number``, and return its row for ``_commit``."""

    @abstractmethod
    def _commit(self, group: list[dict[str, Any]], rows: list[Any]) -> None:
        """Write the tables of episodes with these facts, and with a row for each step."""

    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        group: list[dict[str, Any]] = []
        rows: list[Any] = []
        for episode in episodes:
            number, before = len(self.facts) + len(group), len(rows)
            for k, step in enumerate(episode.steps()):
                self._require_fitting(episode, step)
                rows.append(self._write_step(episode, step, number, k))
            if len(rows) > before:
                group.append(self._facts(episode, len(rows) - before))
            if len(rows) > (0 if self.at_once else HELD_STEPS):
                self._commit(group, rows)
                yield group
                group, rows = [], []
        if group:
            self._commit(group, rows)
            yield group


def read_sidecar(folder: Path, form: str = "") -> tuple[About, dict[str, Any]]:
    """The description of a folder.

    Raises
    ------
    RecordError
        The folder has no description, or a damaged one, or one of another format than ``form`` or of another version.
    """
    stored = read_json(folder / SIDECAR)
    with ErrorsAs((KeyError, TypeError, ValueError, AttributeError), lambda error: RecordError(f"{folder / SIDECAR}: damaged; {AGAIN}")):
        about = About.of(stored["about"])
        found, version = str(stored["format"]), stored["version"]
    if version != VERSION:
        raise RecordError(f"{folder / SIDECAR}: of version {version!r}, expected {VERSION}; read it with the program that wrote it")
    if form and found != form:
        raise RecordError(f"{folder}: holds a record of the format {found}, not {form}; give another `out`")
    return about, stored


def format_of(folder: Path) -> str:
    """Format of the record in a folder, as the folder states it; "" if it states none."""
    return str(read_sidecar(folder)[1]["format"]) if (folder / SIDECAR).is_file() else ""


def read_json(path: Path, *, most_bytes: int = LARGEST_BYTES, error: type[TwinError] = RecordError, again: str = AGAIN) -> dict[str, Any]:
    """Keys and values of a JSON file.

    Raises
    ------
    TwinError
        Of the type ``error``: the file can't be read, is larger than ``most_bytes``, or holds something else. ``again`` is the remedy.
    """
    try:
        found = json.loads(read_regular(path, most_bytes))
    except OSError as problem:
        raise error(f"{path}: can't be read ({problem.strerror}); {again}") from problem
    except (ValueError, RecursionError) as problem:
        raise error(f"{path}: damaged, no JSON; {again}") from problem
    if not isinstance(found, dict):
        raise error(f"{path}: damaged, holds no keys and values; {again}")
    return found


def card(about: About, front: str, says: str) -> str:
    """The page of a data set for Hugging Face: YAML at the front, what it is, and its columns."""
    lines = [f"- `{channel_of(name).column}`: {channel_of(name).meaning}" for name in about.numbers]
    return "\n".join([f"---\n{front}---\n\n# Records of the tactile sensor {about.sensor}\n\n{says}\n", *lines, ""])


def write_tables(path: Path, table: Any) -> None:
    """Write a Parquet file. Its folder is made if it does not exist."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_with(path, lambda file: library("pyarrow.parquet").write_table(table, file, write_page_checksum=True))


@contextmanager
def reading_tables(path: Path) -> Iterator[Any]:
    """Context that gives the library of Parquet tables. If the tables turn out to be damaged, ``RecordError`` is raised."""
    damaged = (OSError, KeyError, ValueError, TypeError, AttributeError, StopIteration, FrameError, library("pyarrow").ArrowException)
    try:
        yield library("pyarrow.parquet")
    except damaged as error:
        raise RecordError(f"{path}: damaged ({error}); {AGAIN}") from error


def read_facts(path: Path) -> list[dict[str, Any]]:
    """The facts of the episodes that a JSON file lists; raises as ``read_json``."""
    facts = read_json(path).get("episodes")
    if not isinstance(facts, list) or not all(isinstance(each, dict) for each in facts):
        raise RecordError(f"{path}: damaged; {AGAIN}")
    return facts


def require_numbered(files: Sequence[Path], name: Callable[[int], str]) -> None:
    """Raise ``RecordError`` if the files, in order, do not have the names for the numbers 0, 1, 2 and so on."""
    for number, path in enumerate(files):
        if path.name != name(number):
            raise RecordError(f"{path.parent}: {name(number)} is missing; {AGAIN}")


def episode_of(path: Path, facts: dict[str, Any], steps: Any, rest: ImageArray | None = None) -> Episode:
    """An episode from its stored facts. They name the picture without contact unless it is given.

    Raises
    ------
    RecordError
        A part is damaged.
    """
    damaged = (KeyError, TypeError, ValueError, FrameError)
    with ErrorsAs(damaged, lambda error: RecordError(f"{path}: the stored facts of an episode are damaged ({error}); {AGAIN}")):
        if rest is None and facts.get("rest") is not None:
            rest = read_image(path / RESTS / str(facts["rest"]))[0]
        return Episode.from_facts(facts, steps, rest)


def records_in(folder: Path, form: str, facts: Sequence[dict[str, Any]], steps_of: Any) -> Records:
    """The records of a folder. ``steps_of(about, index)`` gives the steps of an episode."""
    about, _ = read_sidecar(folder, form)
    whole = [partial(whole_steps, folder, each, steps_of(about, index)) for index, each in enumerate(facts)]
    return Records(about, [episode_of(folder, each, steps) for each, steps in zip(facts, whole, strict=True)])


def whole_steps(path: Path, facts: dict[str, Any], steps: Callable[[], Iterator[RecordStep]]) -> Iterator[RecordStep]:
    """The steps of an episode.

    Raises
    ------
    RecordError
        Their number is not the stored one.
    """
    count = 0
    for step in steps():
        count += 1
        yield step
    if count != facts["length"]:
        raise RecordError(f"{path}: damaged, {count} of {facts['length']} steps of {quote(facts['key'])} can be read; {AGAIN}")


def image_of(data: bytes, gray: bool, name: str) -> ImageArray:
    """A picture from PNG. Of a gray picture that was stored with three equal channels, the first channel is returned.

    Raises
    ------
    RecordError
        The picture can't be decoded.
    """
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if stored is None or stored.dtype != np.uint8:
        raise RecordError(f"{name}: a picture is damaged; {AGAIN}")
    if gray:
        return np.ascontiguousarray(stored if stored.ndim == 2 else stored[..., 0])
    return np.ascontiguousarray(stored[..., 2::-1] if stored.ndim == 3 else np.repeat(stored[..., None], 3, axis=2))
