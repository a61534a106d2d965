"""Opens a recording from a picture, a folder, a video or a data set, and reads it frame by frame."""

import os
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

import numpy as np

from scenes.files import LONGEST_PATH, quote
from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.frames.folders import IMAGE_FOLDERS, VIDEO_SUFFIXES, frames_in, image_folders, odd_entries, references_in, the_video_in
from twin.frames.forms import FrameKind, common_kind, form_named, form_of, times
from twin.frames.images import Pictures, read_image
from twin.frames.lerobot import INFO, RESTS, LeRobotFrames, is_lerobot
from twin.frames.tables import TABLES, describe_count, order_by_table, read_metadata, unlikely_units
from twin.types import Form, Frame

MOST_NAMED = 20  # most columns that a message names; the widest tables in use have about 40
_ConcretePath: type[Path] = type(Path())


class FramesAt(_ConcretePath):  # type: ignore[misc, valid-type]
    """A path to frames, with a table and a no-contact frame that do not lie beside them under a usual name. ``frames_at`` makes it.

    Attributes
    ----------
    table : Path or None
        Table of labels that replaces the recording's own.
    no_contact : Path or None
        No-contact frame that replaces the recording's own.
    """

    table: Path | None = None
    no_contact: Path | None = None


def frames_at(path: str | Path, table: Path | None = None, no_contact: Path | None = None) -> Path:
    """A path to frames with a table and a no-contact frame from elsewhere. It can be used wherever a path to frames is expected."""
    if table is None and no_contact is None:
        return Path(path)
    at = FramesAt(path)
    at.table, at.no_contact = table, no_contact
    return at


class BadFrame(TypedDict):
    """A frame that could not be used, and the reason."""

    image_name: str
    reason: str


@dataclass
class Recording:
    """Recorded frames. Each is read when it is needed.

    Iterating gives the readable frames in order. A frame that cannot be read is added to ``failed`` and skipped.

    Attributes
    ----------
    path : Path
    form : Form
    names : list of str
        Base names of the frames in the order of the table; frames without a row come last. Without a table they are sorted naturally.
    size_px : (int, int)
        Width and height that every frame must have.
    labels : dict of str to (M,) array
        The table's columns, in the order of ``names``. A column is float if all its cells are numbers, else text. A frame without
        a row has NaN or "". There are no columns without a table.
    metadata : dict of str to object
        Content of the JSON files, by file name.
    reference : Frame or None
        The no-contact frame (``init_*``).
    problems : list of str
        Irregularities, one line each.
    failed : list of BadFrame
        Frames that could not be read so far, and the reasons.
    """

    path: Path
    form: Form
    names: list[str]
    size_px: tuple[int, int]
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    metadata: dict[str, object] = field(default_factory=dict)
    reference: Frame | None = None
    problems: list[str] = field(default_factory=list)
    failed: list[BadFrame] = field(default_factory=list)
    _files: list[Path] = field(default_factory=list, repr=False)
    _pictures: Callable[[Collection[int]], Pictures] | None = field(default=None, repr=False)
    _bits: int = field(default=0, repr=False)
    _noted: set[str] = field(default_factory=set, repr=False)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Frame]:
        yield from self.some(range(len(self)))

    def some(self, chosen: Collection[int]) -> Iterator[Frame]:
        """The readable frames of some indices of ``names``, in order; unreadable ones are added to ``failed``."""
        self.failed.clear()
        for index, frame in self._read_chosen(chosen):
            if isinstance(frame, str):
                self.failed.append({"image_name": self.names[index], "reason": frame})
            else:
                yield frame

    def read(self, index: int) -> Frame:
        """Read frame ``index`` of ``names``. A video is decoded from its beginning for this.

        Raises
        ------
        FrameError
            The frame can't be read, or its size differs from the recording's.
        """
        for _, frame in self._read_chosen({index}):
            if isinstance(frame, str):
                raise FrameError(f"{self.names[index]}: {frame}")
            return frame
        raise FrameError(f"{self.path.name}: has no frame {index}; it ends after {len(self)}")

    def notes(self) -> list[str]:
        """Irregularities of the recording, and the frames that could not be read so far, one line each."""
        alike: dict[str, list[str]] = {}
        for bad in self.failed:
            alike.setdefault(bad["reason"], []).append(bad["image_name"])
        skipped = {said: names[0] if len(names) == 1 else describe_count("frames", names) for said, names in alike.items()}
        return [*self.problems, *(f"skipped {named}: {said}" for said, named in skipped.items())]

    def labels_found(self) -> str:
        """The available labels, in words for a message: the table's columns, or why no table can be used."""
        if self.labels:
            columns = list(self.labels)
            return f"found {', '.join(columns[:MOST_NAMED])}{', ...' if len(columns) > MOST_NAMED else ''}"
        return "; ".join(p for p in self.problems if p.startswith(TABLES)) or "found no table"

    def _image(self, file: Path) -> np.ndarray:
        image, note = read_image(file, self._bits)
        if note and note not in self._noted:
            self._noted.add(note)
            self.problems.append(f"{file.name}: {note} (the first such frame)")
        return image

    def _read_chosen(self, chosen: Collection[int]) -> Iterator[tuple[int, Frame | str]]:
        """Index and frame, or the reason why it can't be read, of chosen frames of any source."""
        expected = tuple(self.size_px)
        for index, image, time_s in (self._pictures or self._from_files)(chosen):
            if isinstance(image, str):
                yield index, image.removeprefix(f"{self.names[index]}: ")
            elif (got := image.shape[1::-1]) != expected:
                unlike = f"expected {times(expected)} as the recording's other frames, got {times(got)}"
                yield index, f"{unlike}; leave it out or record it again"
            else:
                yield index, Frame(image, self.form, self.names[index], time_s, index)

    def _from_files(self, chosen: Collection[int]) -> Pictures:
        for index in sorted(chosen):
            try:
                yield index, self._image(self._files[index]), 0.0
            except FrameError as error:
                yield index, str(error), 0.0

    def take_reference(self, candidates: list[Path]) -> None:
        """Use the first readable picture of the frames' size as the no-contact frame."""
        for candidate in candidates:
            try:
                image = self._image(candidate)
            except FrameError as error:
                self.problems.append(f"no-contact frame {error}")
                continue
            got = image.shape[1::-1]
            if got == tuple(self.size_px):
                self.reference = Frame(image, self.form, candidate.name)
                return
            self.problems.append(f"no-contact frame {candidate.name}: {times(got)}, the frames are {times(self.size_px)}; ignored")

    def must_take_reference(self, file: Path) -> None:
        """Use the picture that the user gave as the no-contact frame.

        Raises
        ------
        FrameError
            The picture cannot be read, or its size differs from the frames'.
        """
        if not file.is_file():
            raise FrameError(f"{file}: no such no-contact frame; give the path of a picture with `no_contact`")
        before = len(self.problems)
        self.reference = None
        self.take_reference([file])
        if self.reference is None:
            raise FrameError(f"{'; '.join(self.problems[before:])}; give another one with `no_contact`")

    def take_metadata(self, homes: list[Path]) -> None:
        """Read the JSON files of these folders."""
        for file in (file for home in homes for file in sorted(home.glob("*.json"))):
            if (content := read_metadata(file, self.problems)) is not None:
                self.metadata[file.name] = content


def _open_video(path: Path, spec: SensorSpec | None, form: Form | None) -> Recording:
    from twin.frames.videos import open_video  # its library takes time to load

    video = open_video(path)
    names = [f"{path.stem}_{k:06d}" for k in range(video.count)]
    told = form_of(video.first, path.name, spec, form)
    return Recording(path, told, names, video.first.shape[1::-1], problems=video.problems, _pictures=video.frames)


def _open_dataset(path: Path, spec: SensorSpec | None, form: Form | None, table: Path | None) -> Recording:
    if table is not None and not Path(table).is_relative_to(path):
        raise FrameError(f"{path}: a LeRobot data set holds its own labels; leave out {table}")
    found = LeRobotFrames(path)
    told = form_of(found.first, path.name, spec, form)
    recording = Recording(path, told, found.names, found.first.shape[1::-1], found.labels, problems=found.problems, _pictures=found.frames)
    recording.take_metadata([path / INFO.parent])
    recording.take_reference([*references_in(path), *sorted((path / RESTS).glob("*.png"))])
    return recording


def _choose_folder(
    path: Path, folders: list[Path], spec: SensorSpec | None, form: Form | None, problems: list[str]
) -> tuple[Path, list[Path], FrameKind]:
    """The first folder with a usable frame, its frames and their kind."""
    reasons = []
    for folder in folders:
        files = frames_in(folder)
        try:
            kind = common_kind(files, spec, form)
        except FrameError as error:
            reasons.append((folder, error))
            continue
        others = [f.name + "/" for f in folders if f not in (folder, path)]
        if others:
            problems.append(f"{path.name}: read {folder.name}/, not {', '.join(others)}")
        problems += [f"{unusable.name}: {error}" for unusable, error in reasons]
        return folder, files, kind
    first, reason = reasons[0]
    raise FrameError(f"{first}: {reason}")


def _open_folder(path: Path, spec: SensorSpec | None, form: Form | None, table: Path | None) -> Recording:
    if not any(path.iterdir()):
        raise FrameError(f"{path}: the folder is empty; give a folder of frames")
    problems: list[str] = []
    folders = image_folders(path, form)
    if folders:
        folder, files, kind = _choose_folder(path, folders, spec, form, problems)
        problems += odd_entries(folder)
        # if ``path`` is the inner folder of a recording, table and no-contact frame lie in the folder above
        inner = folder == path and path.name in IMAGE_FOLDERS
        homes = list(dict.fromkeys([path, folder] + ([path.parent] if inner else [])))
        tables = [home / name for home in homes for name in TABLES if (home / name).is_file()] if table is None else [table]
        files, labels = order_by_table(tables, files, problems)
        if table is not None and not labels:
            raise FrameError(f"{'; '.join(problems)}; give a table of these frames with `table`")
        names = [p.name for p in files]
        recording = Recording(path, kind.form, names, kind.size_px, labels, problems=problems, _files=files, _bits=kind.bits)
    else:
        homes = [path]
        recording = _open_video(the_video_in(path), spec, form)
    recording.take_metadata(homes)
    recording.take_reference([file for home in homes for file in references_in(home)])
    return recording


def open_recording(path: str | Path, spec: SensorSpec | None = None, form: Form | None = None) -> Recording:
    """Open recorded frames.

    Parameters
    ----------
    path : path
        A picture, a folder of pictures, a recording's folder, a LeRobot data set, or a video or a folder with one. ``frames_at`` adds
        a table and a no-contact frame from elsewhere.
    spec : SensorSpec, optional
        The sensor; frames must have the size of one of its forms. The recording's size is that of most frames.
    form : Form, optional
        The frames' form; recognised by size and content if not given.

    Raises
    ------
    FrameError
        There is nothing at ``path``, no frame is usable, or there is no such form.
    """
    form = None if form is None else form_named(form)
    table, no_contact = (path.table, path.no_contact) if isinstance(path, FramesAt) else (None, None)
    path = Path(path)
    if table is not None and not table.is_file() and not is_lerobot(table):
        raise FrameError(f"{quote(table, LONGEST_PATH)}: no such table; give the path of a CSV file (`table` or `label_table`)")
    recording = _open_with_table(path, spec, form, table)
    if no_contact is not None:
        recording.must_take_reference(no_contact)
    recording.problems += unlikely_units(recording.labels)
    return recording


def _open_with_table(path: Path, spec: SensorSpec | None, form: Form | None, table: Path | None) -> Recording:
    """The recording at ``path``, with the table and the other files that lie beside its frames."""
    if not os.path.exists(path):  # unlike ``Path.exists``, this returns False for a text that can be no path
        link = "a broken link" if os.path.islink(path) else "no such file or folder"
        raise FrameError(f"{quote(path, LONGEST_PATH)}: {link}; give a picture, a folder of frames, a recording or a video")
    if path.is_dir() and is_lerobot(path):
        return _open_dataset(path, spec, form, table)
    if path.is_dir():
        return _open_folder(path, spec, form, table)
    if not path.is_file():
        raise FrameError(f"{path}: a named pipe or a device, not a file; give a picture, a folder of frames, a recording or a video")
    if table is not None:
        raise FrameError(f"{path}: a table needs a folder of frames; give the folder, or leave out `table`")
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _open_video(path, spec, form)
    kind = common_kind([path], spec, form)
    return Recording(path, kind.form, [path.name], kind.size_px, _files=[path], _bits=kind.bits)


def spread_indices(count: int, wanted: int) -> list[int]:
    """At most ``wanted`` of ``count`` indices, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).round().astype(int)).tolist()


def evenly_read(recording: Recording, limit: int) -> list[Frame]:
    """At most ``limit`` frames of a recording, evenly spread from its first to its last frame.

    A frame that can't be read is left out and added to ``failed``.

    Raises
    ------
    FrameError
        None of them can be read.
    """
    frames = list(recording.some(set(spread_indices(len(recording), limit))))
    if not frames:
        raise FrameError(f"{recording.failed[0]['image_name']}: {recording.failed[0]['reason']}")
    return frames
