"""Reads LeRobot data sets of version 3 as frames and labels: tables in ``data``, and pictures in these tables or in videos.

Each number of a feature becomes a column, named after the feature and the number: ``observation.state.x``.
"""

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenes.files import read_regular
from twin.errors import ErrorsAs, FrameError, library
from twin.frames.images import picture_of
from twin.frames.tables import LARGEST_BYTES, called_here
from twin.frames.videos import open_video

INFO, DATA, EPISODES = Path("meta", "info.json"), "data/chunk-*/*.parquet", "meta/episodes/chunk-*/*.parquet"
"""Paths of a data set's description, of its tables of frames and of its tables of episodes."""
RESTS = "rest"
"""Folder of the no-contact frames in records that this program writes, in every format."""
VERSION = "v3."
"""Beginning of the format version that can be read."""
PICTURES = ("image", "video")
"""Types of features that hold pictures."""
OURS = ("tactip", "tactile", "tacpad")
"""Words in the name of a camera's feature that mark a tactile sensor. The first such camera is read."""
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""Columns of whole numbers that LeRobot adds itself."""
NUMBERS = ("float", "int", "uint", "bool")
"""Beginnings of the type names of numeric features, which become labels."""
DAMAGED = "give the complete data set"
Episode = dict[str, Any]


@dataclass
class LeRobotFrames:
    """Frames of a data set, each read when it is needed.

    Attributes
    ----------
    names : list of str
    first : (H, W) or (H, W, 3) uint8
        The first frame. A picture whose three channels are equal counts as gray.
    labels : dict of str to (M,) float
    problems : list of str
        Irregularities, one line each.
    """

    path: Path
    names: list[str]
    labels: dict[str, np.ndarray]
    problems: list[str]
    first: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.uint8))
    _places: list[tuple[Path, int, int]] = field(
        default_factory=list, repr=False
    )  # of each frame: file, row group (-1 for a video), and row or frame number in it
    _feature: str = field(default="", repr=False)
    _group: tuple[Path, int] | None = field(default=None, repr=False)
    _cells: list[Any] = field(default_factory=list, repr=False)

    def frames(self, chosen: Collection[int]) -> Iterator[tuple[int, np.ndarray | str]]:
        """Index and picture of chosen frames, in order. A damaged frame gives the reason, a text, instead of the picture."""
        wanted = sorted(chosen)
        if wanted and self._places[wanted[0]][1] < 0:
            yield from self._from_videos(wanted)
            return
        for index in wanted:
            try:
                image, note = picture_of(self._read_encoded(*self._places[index]))
                said = f"{self.path.name}: pictures of {self._feature}: {note}"
                self.problems += [said] if note and said not in self.problems else []
                yield index, self._as_first(image)
            except FrameError as error:
                yield index, str(error)

    def _from_videos(self, wanted: list[int]) -> Iterator[tuple[int, np.ndarray | str]]:
        for path in dict.fromkeys(self._places[index][0] for index in wanted):
            number = {self._places[index][2]: index for index in wanted if self._places[index][0] == path}
            video = open_video(path)
            self.problems += [problem for problem in video.problems if problem not in self.problems]
            for k, _, image in video.frames():
                if k in number:
                    yield number.pop(k), image if isinstance(image, str) else self._as_first(image)
                if not number:
                    break
            for index in number.values():
                yield index, f"{path.name} ends before it"

    def _read_encoded(self, path: Path, group: int, row: int) -> bytes:
        """The encoded bytes of a picture that a table holds or names."""
        if self._group != (path, group):
            with _parquet(path) as file:
                table = file.read_row_group(group, [self._feature])
            if self._feature not in table.column_names:
                raise FrameError(f"{path}: has no column {self._feature}, though {INFO} names it; {DAMAGED}")
            self._group, self._cells = (path, group), table.column(self._feature).to_pylist()
        cell = self._cells[row]
        data = cell.get("bytes") if isinstance(cell, dict) else cell
        if isinstance(data, bytes):
            return data
        named = cell.get("path") if isinstance(cell, dict) else None
        if not named:
            raise FrameError("no picture in its row")
        with ErrorsAs(OSError, lambda error: FrameError(f"{named}: can't be read ({error.strerror})")):
            return read_regular(self.path / named, LARGEST_BYTES)

    def _as_first(self, image: np.ndarray) -> np.ndarray:
        return image[..., 0] if image.ndim == 3 and self.first.ndim == 2 and self.first.size else image


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (path / INFO).is_file()


def open_lerobot(path: Path) -> LeRobotFrames:
    """Open a data set. Of a data set that is still being written, only the episodes that its description counts are read.

    Raises
    ------
    FrameError
        It has another version, is damaged or has no pictures; or pyarrow is missing.
    """
    info = _info(path)
    library("pyarrow.parquet")
    problems: list[str] = []
    features: dict[str, dict[str, Any]] = {name: each for name, each in info["features"].items() if isinstance(each, dict)}
    pictured = [name for name, each in features.items() if each.get("dtype") in PICTURES]
    if not pictured:
        raise FrameError(f"{path}: a LeRobot data set without pictures ({', '.join(list(features)[:5])}); give one with a camera's frames")
    feature = next((name for name in pictured if any(word in name.lower() for word in OURS)), pictured[0])
    if len(pictured) > 1:
        problems.append(f"{path.name}: read {feature}, not {', '.join(name for name in pictured if name != feature)}")
    numbered = [name for name, each in features.items() if str(each.get("dtype")).startswith(NUMBERS) and name not in COUNTERS]
    rows, places = _rows(path, info, numbered)
    if not places:
        raise FrameError(f"{path}: a LeRobot data set without frames; {DAMAGED}")
    if features[feature]["dtype"] == "video":
        places = _in_videos(path, info, feature, rows)
    labels: dict[str, np.ndarray] = {}
    for name in numbered:
        labels |= _columns(name, features[name].get("names"), rows[name])
    labels = called_here(labels)
    names = [f"episode-{e:06d}-frame-{k:06d}" for e, k in zip(rows["episode_index"], rows["frame_index"], strict=True)]
    found = LeRobotFrames(path, names, labels, problems, _places=places, _feature=feature)
    reason = ""
    for _, image in found.frames(range(len(names))):
        if not isinstance(image, str):
            alike = image.ndim == 3 and bool((image == image[..., :1]).all())
            found.first = image[..., 0] if alike else image
            return found
        reason = reason or image
    raise FrameError(f"{path}: no picture of {feature} can be read ({reason}); {DAMAGED}")


def _info(path: Path) -> dict[str, Any]:
    with ErrorsAs((OSError, ValueError, RecursionError), lambda error: FrameError(f"{path / INFO}: can't be read ({error}); {DAMAGED}")):
        info = json.loads(read_regular(path / INFO, LARGEST_BYTES))
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise FrameError(f"{path / INFO}: names no features; {DAMAGED}")
    if not str(info.get("codebase_version")).startswith(VERSION):
        raise FrameError(
            f"{path}: a LeRobot data set of version {info.get('codebase_version')!r}; only version 3 is read: convert it with LeRobot "
            "(lerobot.datasets.v30.convert_dataset_v21_to_v30)"
        )
    return info


def _rows(path: Path, info: dict[str, Any], numbered: list[str]) -> tuple[dict[str, list[Any]], list[tuple[Path, int, int]]]:
    """Cells of the numeric columns, and file, row group and row of each frame; only of the episodes that the description counts."""
    columns = ["episode_index", "frame_index", *numbered]
    rows: dict[str, list[Any]] = {name: [] for name in columns}
    places: list[tuple[Path, int, int]] = []
    total = info.get("total_episodes")
    for file in sorted(path.glob(DATA)):
        with _parquet(file) as parquet:
            tables = [parquet.read_row_group(group, columns) for group in range(parquet.num_row_groups)]
        for group, table in enumerate(tables):
            if missing := [name for name in columns if name not in table.column_names]:
                raise FrameError(f"{file}: has no column {', '.join(missing[:3])}, though {INFO} names it; {DAMAGED}")
            cells = {name: table.column(name).to_pylist() for name in columns}
            for k, episode in enumerate(cells["episode_index"]):
                if isinstance(total, int) and episode >= total:
                    continue
                places.append((file, group, k))
                for name in columns:
                    rows[name].append(cells[name][k])
    return rows, places


def _in_videos(path: Path, info: dict[str, Any], feature: str, rows: dict[str, list[Any]]) -> list[tuple[Path, int, int]]:
    """Video, -1, and number in the video of each frame."""
    episodes: dict[int, Episode] = {}
    keys = [f"videos/{feature}/{key}" for key in ("chunk_index", "file_index", "from_timestamp")]
    for file in sorted(path.glob(EPISODES)):
        with _parquet(file) as parquet:
            episodes |= {row["episode_index"]: row for row in parquet.read(["episode_index", *keys]).to_pylist()}
    places = []
    try:
        for episode, frame in zip(rows["episode_index"], rows["frame_index"], strict=True):
            chunk, number, begins_s = (episodes[episode][key] for key in keys)
            video = path / info["video_path"].format(video_key=feature, chunk_index=chunk, file_index=number)
            places.append((video, -1, round(begins_s * info["fps"]) + frame))
        return places
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise FrameError(f"{path}: does not say where the video of an episode is ({error!r}); {DAMAGED}") from error


def _columns(feature: str, names: object, cells: list[Any]) -> dict[str, np.ndarray]:
    """A feature's numbers as columns (M,). A feature of more than two dimensions, or of changing length, gives no columns."""
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}
        (names,) = names.values()
    try:
        values = np.array(cells, float)
    except (TypeError, ValueError):
        return {}
    if values.ndim == 1:
        return {feature: values}
    if values.ndim != 2:
        return {}
    if values.shape[1] == 1:
        return {feature: values[:, 0]}
    named = isinstance(names, list) and len(names) == values.shape[1]
    return {f"{feature}.{names[k] if named else k}": values[:, k] for k in range(values.shape[1])}  # type: ignore[index]


@contextmanager
def _parquet(file: Path) -> Iterator[Any]:
    """An open file of tables. If it turns out to be damaged, ``FrameError`` is raised."""
    parquet, arrow = library("pyarrow.parquet"), library("pyarrow")
    try:
        yield parquet.ParquetFile(file, page_checksum_verification=True)
    except (OSError, KeyError, ValueError, arrow.ArrowException) as error:
        raise FrameError(f"{file}: damaged ({str(error).splitlines()[0]}); {DAMAGED}") from error
