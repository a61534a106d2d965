"""Recorded frames from disk: a picture, a folder, a video, or a recording with its table and metadata.

Understands the folder formats in use by the sensor's users: ``frames_bw/`` with ``init_0.png``, ``images/``, and
``sensor_images/`` or ``processed_images/``, each with ``targets.csv`` and JSON metadata. Whatever is odd in them is
listed, and what is readable is read.
"""

import csv
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.types import Form, Frame

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg"})
IMAGE_FOLDERS = ("frames_bw", "sensor_images", "images", "processed_images")
TABLES = ("targets.csv", "targets_images.csv")
NAME_COLUMNS = ("image_name", "sensor_image")
TWO_LEVEL_FRACTION = 0.9  # of the pixels black or white: a thresholded recording (a resized one has grays at its edges)


def natural_key(name: str) -> list:
    """Sort key by which frame_2 comes before frame_10."""
    return [(1, int(part), "") if part.isdigit() else (0, 0, part.lower()) for part in re.split(r"(\d+)", name)]


def base_name(path: str) -> str:
    """The last part of a path written on any system."""
    return re.split(r"[\\/]", path.strip())[-1]


def read_image(path: Path) -> tuple[np.ndarray, str]:
    """A picture as (H, W) or (H, W, 3) uint8 RGB, and a note on what was converted ("" if nothing).

    Raises
    ------
    FrameError
        It can't be read: missing, empty, truncated, not a picture.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path.name}: can't be read ({error.strerror})") from error
    if not data:
        raise FrameError(f"{path.name}: the file is empty; copy it again")
    if data.startswith(b"\x89PNG") and b"IEND" not in data[-64:]:
        raise FrameError(f"{path.name}: truncated PNG ({len(data)} bytes, its end is missing); copy it again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{path.name}: not a readable picture (broken or unknown format); copy or convert it again")
    note = ""
    if image.dtype == np.uint16:
        image, note = np.round(image / 257.0).astype(np.uint8), "16-bit levels scaled to 8 bits"
    elif image.dtype != np.uint8:
        raise FrameError(f"{path.name}: expected 8-bit levels, got {image.dtype}; convert it to 8 bits")
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] < 3 else cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2RGB)
    return np.ascontiguousarray(image), note


def is_two_level(image: np.ndarray) -> bool:
    """Whether a picture was thresholded at capture: nearly all of it black or white, and both occur."""
    low, high = float(np.mean(image < 16)), float(np.mean(image > 239))
    return low + high > TWO_LEVEL_FRACTION and min(low, high) > 0.005


def tell_form(spec: SensorSpec, image: np.ndarray) -> Form:
    """Form of a sensor's frame, by its size and, where that doesn't decide, its content.

    Raises
    ------
    FrameError
        It has neither form's size.
    """
    size = image.shape[1], image.shape[0]
    raw = (spec.camera.width_px, spec.camera.height_px)
    recording = (spec.recording.width_px, spec.recording.height_px) if spec.recording else None
    if size == raw and size == recording:
        return Form.RECORDING if is_two_level(image) else Form.RAW
    if size in (raw, recording):
        return Form.RAW if size == raw else Form.RECORDING
    expected = f"{raw[0]}x{raw[1]} (raw)" + (f" or {recording[0]}x{recording[1]} (recording)" if recording else "")
    raise FrameError(f"expected {expected} for {spec.name}, got {size[0]}x{size[1]}; use the matching --sensor or the unresized frame")


@dataclass
class Recording:
    """Recorded frames, read one at a time when asked for.

    Iterating gives the readable frames in order; what can't be read is added to ``failed`` and skipped.

    Attributes
    ----------
    path : Path
    form : Form
    names : list of str
        Base names of the frames, in the table's order, else naturally sorted.
    size_px : (int, int)
        Width and height every frame must have.
    labels : dict of str to (M,) array
        The table's columns, row by row as ``names``; numbers where a column is all numbers. Empty without a table.
    metadata : dict of str to object
        Content of the JSON files, by file name.
    reference : Frame or None
        The no-contact frame (``init_*``).
    problems : list of str
        What was odd, one line each.
    failed : list of dict
        ``image_name`` and ``reason`` of each frame that couldn't be read so far.
    """

    path: Path
    form: Form
    names: list
    size_px: tuple
    labels: dict = field(default_factory=dict)
    metadata: dict = field(default_factory=dict)
    reference: Frame | None = None
    problems: list = field(default_factory=list)
    failed: list = field(default_factory=list)
    _files: list = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Frame]:
        self.failed.clear()
        if not self._files:
            yield from self._video_frames()
            return
        for index, name in enumerate(self.names):
            try:
                yield self.read(index)
            except FrameError as error:
                self.failed.append({"image_name": name, "reason": str(error).removeprefix(f"{name}: ")})

    def read(self, index: int) -> Frame:
        """Frame ``index`` of ``names`` (of a video: by seeking through it).

        Raises
        ------
        FrameError
            It can't be read, or has another size than the recording's.
        """
        if not self._files:
            for frame in self._video_frames():
                if frame.sequence == index:
                    return frame
            raise FrameError(f"{self.path.name}: has no frame {index}; it ends after {len(self)}")
        image, note = read_image(self._files[index])
        if note and (line := f"{self.names[index]}: {note}") not in self.problems:
            self.problems.append(line)
        return self._frame(image, index)

    def _frame(self, image: np.ndarray, index: int, time_s: float = 0.0) -> Frame:
        name = self.names[index]
        if (image.shape[1], image.shape[0]) != tuple(self.size_px):
            expected, got = _times(self.size_px), _times(image.shape[1::-1])
            raise FrameError(f"{name}: expected {expected} as the recording's other frames, got {got}; leave it out or record it again")
        return Frame(image, self.form, name, time_s, index)

    def _video_frames(self) -> Iterator[Frame]:
        capture = cv2.VideoCapture(str(self.path))
        try:
            for index in range(len(self.names)):
                time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                good, image = capture.read()
                if not good:
                    break
                yield self._frame(_video_image(image), index, time_s)
        finally:
            capture.release()


def _times(size_px: tuple) -> str:
    return f"{size_px[0]}x{size_px[1]}"


def _video_image(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _pictures(folder: Path) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() and not p.name.startswith("."))
    return sorted(found, key=lambda p: natural_key(p.name))


def _is_reference(path: Path) -> bool:
    return path.name.lower().startswith("init_")


def _image_folder(path: Path, form: Form | None, problems: list) -> Path:
    """The folder of a recording that holds its frames."""
    known = [path / name for name in IMAGE_FOLDERS if (path / name).is_dir() and _pictures(path / name)]
    if form == Form.RECORDING:  # where both are there, the processed pictures are the thresholded ones
        known.sort(key=lambda folder: folder.name != "processed_images")
    if known:
        if len(known) > 1:
            problems.append(f"{path.name}: read {known[0].name}/, not {', '.join(f.name + '/' for f in known[1:])}")
        return known[0]
    if any(not _is_reference(p) for p in _pictures(path)):
        return path
    nested = [p for p in sorted(path.iterdir()) if p.is_dir() and _pictures(p)]
    if len(nested) == 1:
        return nested[0]
    if nested:
        names = ", ".join(p.name for p in nested[:5])
        raise FrameError(f"{path}: no pictures here, but in several folders ({names}); give one of them")
    raise FrameError(f"{path}: no pictures found (looked for {', '.join(sorted(s[1:] for s in IMAGE_SUFFIXES))}); give a folder of frames")


def _read_table(path: Path, problems: list) -> tuple[list, dict]:
    """Image base names and columns of a table; ([], {}) if it can't be used."""
    try:
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, csv.Error) as error:
        problems.append(f"{path.name}: can't be read ({error}); frames are taken in natural order")
        return [], {}
    header = [cell.strip() for cell in rows[0]] if rows else []
    name_column = next((c for c in NAME_COLUMNS if c in header), None)
    if name_column is None:
        problems.append(f"{path.name}: no column {' or '.join(NAME_COLUMNS)}; frames are taken in natural order")
        return [], {}
    ragged = sum(len(row) != len(header) for row in rows[1:])
    if ragged:
        problems.append(f"{path.name}: {ragged} rows don't have the header's {len(header)} cells and are left out")
    rows = [row for row in rows[1:] if len(row) == len(header)]
    columns = {c: [row[k].strip() for row in rows] for k, c in enumerate(header) if c}
    return [base_name(cell) for cell in columns[name_column]], columns


def _as_array(cells: list) -> np.ndarray:
    """A column as float where every cell is a number (an empty one NaN), else as text."""
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells, str)


def _read_metadata(path: Path, problems: list):
    """Content of a JSON file, mended where Windows paths or non-finite numbers spoil it; None if it can't be."""
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        problems.append(f"{path.name}: can't be read ({error.strerror}); ignored")
        return None
    odd = set()

    def constant(name: str) -> float:
        odd.add(name)
        return float(name)

    try:
        content = json.loads(text, parse_constant=constant)
    except ValueError as error:
        mended = re.sub(r'\\(?!["\\/bfnrt]|u[0-9a-fA-F]{4})', r"\\\\", text)
        try:
            content = json.loads(mended, parse_constant=constant)
        except ValueError:
            problems.append(f"{path.name}: invalid JSON ({error}); ignored")
            return None
        problems.append(f"{path.name}: invalid JSON ({error}); read with its backslashes doubled")
    if odd:
        problems.append(f"{path.name}: holds {', '.join(sorted(odd))}, which isn't JSON")
    return content


def _counted(count: int, things: str, names: list) -> str:
    return f"{count} {things} ({', '.join(names[:3])}{', ...' if count > 3 else ''})"


def _open_video(path: Path, spec: SensorSpec | None, form: Form | None) -> Recording:
    capture = cv2.VideoCapture(str(path))
    promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    good, image = capture.read() if capture.isOpened() else (False, None)
    if not good:
        capture.release()
        raise FrameError(f"{path}: no frame can be decoded; check that it is a video, or record it again")
    count = 1
    while capture.read()[0]:
        count += 1
    capture.release()
    problems = []
    if promised > count:
        problems.append(f"{path.name}: ends early, {count} of {promised} frames can be decoded")
    first = _video_image(image)
    names = [f"{path.stem}_{k:06d}" for k in range(count)]
    size = first.shape[1], first.shape[0]
    return Recording(path, _form_of(first, path.name, spec, form), names, size, problems=problems)


def _form_of(image: np.ndarray, name: str, spec: SensorSpec | None, form: Form | None) -> Form:
    if form is not None:
        form = Form(form)
    if spec is None:
        return form or (Form.RECORDING if is_two_level(image) else Form.RAW)
    try:
        told = tell_form(spec, image)
    except FrameError as error:
        raise FrameError(f"{name}: {error}") from None
    return told if form is None else form


def _first_good(files: list, spec: SensorSpec | None, form: Form | None) -> tuple[Form, tuple]:
    """Form and size of a recording by its first usable frame."""
    reasons = []
    for file in files:
        try:
            image, _ = read_image(file)
            return _form_of(image, file.name, spec, form), (image.shape[1], image.shape[0])
        except FrameError as error:
            reasons.append(str(error))
    raise FrameError(f"no usable frame among {len(files)}; the first: {reasons[0]}")


def open_recording(path: str | Path, spec: SensorSpec | None = None, form: Form | None = None) -> Recording:
    """Open recorded frames.

    Parameters
    ----------
    path : path
        A picture, a folder of pictures, a recording's folder, or a video.
    spec : SensorSpec, optional
        The sensor; frames must have the size of one of its forms. Without it the first readable frame sets the size.
    form : Form, optional
        The frames' form; told by size and content if not given.

    Raises
    ------
    FrameError
        Nothing there, or no usable frame.
    """
    path = Path(path)
    if not path.exists():
        raise FrameError(f"{path}: no such file or folder; give a picture, a folder of frames, a recording or a video")
    if path.is_file():
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return _open_video(path, spec, form)
        form, size = _first_good([path], spec, form)
        return Recording(path, form, [path.name], size, _files=[path])

    problems: list[str] = []
    if not any(path.iterdir()):
        raise FrameError(f"{path}: the folder is empty; give a folder of frames")
    folder = _image_folder(path, form, problems)
    # given the inner folder of a recording, its table and no-contact frame lie beside it
    inner = folder == path and path.name in IMAGE_FOLDERS
    homes = list(dict.fromkeys([path, folder] + ([path.parent] if inner else [])))
    pictures = _pictures(folder)
    references = list(dict.fromkeys(p for home in homes for p in _pictures(home) if _is_reference(p)))
    by_name = {p.name: p for p in pictures if not _is_reference(p)}

    files, labels = list(by_name.values()), {}
    tables = [home / table for home in homes for table in TABLES if (home / table).is_file()]
    best: tuple[list, dict, Path | None] = ([], {}, None)
    for table in tables:
        names, columns = _read_table(table, problems)
        if sum(name in by_name for name in names) > sum(name in by_name for name in best[0]):
            best = names, columns, table
    names, columns, table = best
    if table is not None:
        rows = list(dict.fromkeys(k for k, name in enumerate(names) if name in by_name))
        missing = [name for name in names if name not in by_name]
        unlisted = [name for name in by_name if name not in set(names)]
        if missing:
            problems.append(f"{table.name}: {_counted(len(missing), 'rows without a picture', missing)}")
        if unlisted:
            problems.append(f"{table.name}: {_counted(len(unlisted), 'pictures without a row, left out', unlisted)}")
        files = [by_name[names[k]] for k in rows]
        labels = {c: _as_array([cells[k] for k in rows]) for c, cells in columns.items()}
    elif tables:
        problems.append("no row of the table names a picture here; frames are taken in natural order")
    if not files:
        raise FrameError(f"{folder}: no frames (only no-contact references, init_*); give a folder of frames")

    metadata = {}
    for home in homes:
        for file in sorted(home.glob("*.json")):
            if (content := _read_metadata(file, problems)) is not None:
                metadata[file.name] = content

    form, size = _first_good(files, spec, form)
    recording = Recording(path, form, [p.name for p in files], size, labels, metadata, problems=problems, _files=files)
    for candidate in references:
        try:
            image, _ = read_image(candidate)
        except FrameError as error:
            problems.append(f"no-contact frame {error}")
            continue
        if (image.shape[1], image.shape[0]) != size:
            problems.append(
                f"no-contact frame {candidate.name}: {image.shape[1]}x{image.shape[0]}, the frames are {size[0]}x{size[1]}; ignored"
            )
            continue
        recording.reference = Frame(image, form, candidate.name)
        break
    return recording
