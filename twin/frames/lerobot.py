"""Reads LeRobot data sets of version 3 as frames and labels: tables in ``data``, and pictures in these tables or in videos.

Each number of a feature becomes a column, named after the feature and the number: ``observation.state.x``.
"""

import json
import math
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from scenes.files import read_regular
from twin.errors import ErrorsAs, FrameError, library
from twin.frames.images import Pictures, picture_of
from twin.frames.tables import LARGEST_BYTES, called_here

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


class LeRobotFrames:
    """Frames of a data set, each read when it is needed.

    Of a data set that is still being written, only the episodes that its description counts are read.

    Attributes
    ----------
    names : list of str
    first : (H, W) or (H, W, 3) uint8
        The first frame. A picture whose three channels are equal counts as gray.
    labels : dict of str to (M,) float
    problems : list of str
        Irregularities, one line each.

    Raises
    ------
    FrameError
        It has another version, is damaged or has no pictures; or pyarrow is missing.
    """

    def __init__(self, path: Path) -> None:
        info = _info(path)
        library("pyarrow.parquet")
        features: dict[str, dict[str, Any]] = {name: each for name, each in info["features"].items() if isinstance(each, dict)}
        pictured = [name for name, each in features.items() if each.get("dtype") in PICTURES]
        if not pictured:
            named = ", ".join(list(features)[:5])
            raise FrameError(f"{path}: a LeRobot data set without pictures ({named}); give one with a camera's frames")
        feature = next((name for name in pictured if any(word in name.lower() for word in OURS)), pictured[0])
        others = [name for name in pictured if name != feature]
        self.problems = [f"{path.name}: read {feature}, not {', '.join(others)}"] if others else []
        numbered = [name for name, each in features.items() if str(each.get("dtype")).startswith(NUMBERS) and name not in COUNTERS]
        rows, places = _rows(path, info, numbered)
        if not places:
            raise FrameError(f"{path}: a LeRobot data set without frames; {DAMAGED}")
        if features[feature]["dtype"] == "video":
            places = _in_videos(path, info, feature, rows)
        labels: dict[str, np.ndarray] = {}
        for name in numbered:
            labels |= _columns(name, features[name].get("names"), rows[name])
        self.labels = called_here(labels)
        self.names = [f"episode-{e:06d}-frame-{k:06d}" for e, k in zip(rows["episode_index"], rows["frame_index"], strict=True)]
        self._path, self._feature, self._places, self._gray = path, feature, places, False
        self._cells_of = lru_cache(maxsize=1)(self._read_cells)
        reason = ""
        for _, image, _ in self.frames(range(len(places))):
            if not isinstance(image, str):
                self._gray = image.ndim == 3 and bool((image == image[..., :1]).all())
                self.first = image[..., 0] if self._gray else image
                return
            reason = reason or image
        raise FrameError(f"{path}: no picture of {feature} can be read ({reason}); {DAMAGED}")

    def frames(self, chosen: Collection[int]) -> Pictures:
        """Pictures of chosen frames, in order."""
        for (path, group), part in groupby(sorted(chosen), key=lambda index: self._places[index][:2]):
            index_of = {self._places[index][2]: index for index in part}
            for row, image, time_s in self._from_table(path, group, index_of) if group >= 0 else self._from_video(path, index_of):
                if self._gray and not isinstance(image, str) and image.ndim == 3:
                    image = image[..., 0]
                yield index_of[row], image, time_s

    def _from_video(self, path: Path, rows: Collection[int]) -> Pictures:
        from twin.frames.videos import open_video  # its library takes time to load

        video, found = open_video(path), set()
        self.problems += [problem for problem in video.problems if problem not in self.problems]
        for row, image, _ in video.frames(rows):
            found.add(row)
            yield row, image, 0.0
        yield from ((row, f"{path.name} ends before it", 0.0) for row in rows if row not in found)

    def _from_table(self, path: Path, group: int, rows: Collection[int]) -> Pictures:
        for row in rows:
            try:
                image, note = picture_of(self._picture_bytes(self._cells_of(path, group)[row]))
                said = f"{self._path.name}: pictures of {self._feature}: {note}"
                self.problems += [said] if note and said not in self.problems else []
                yield row, image, 0.0
            except FrameError as error:
                yield row, str(error), 0.0

    def _read_cells(self, path: Path, group: int) -> list[Any]:
        """The cells that hold or name the pictures of a table's row group."""
        with _parquet(path) as file:
            table = file.read_row_group(group, [self._feature])
        if self._feature not in table.column_names:
            raise FrameError(f"{path}: has no column {self._feature}, though {INFO} names it; {DAMAGED}")
        return table.column(self._feature).to_pylist()

    def _picture_bytes(self, cell: Any) -> bytes:
        """The encoded bytes of the picture that a cell holds or names."""
        cell = cell if isinstance(cell, dict) else {"bytes": cell}
        if isinstance(cell.get("bytes"), bytes):
            return cell["bytes"]
        named = cell.get("path")
        if not named:
            raise FrameError("no picture in its row")
        with ErrorsAs(OSError, lambda error: FrameError(f"{named}: can't be read ({error.strerror})")):
            return read_regular(self._path / named, LARGEST_BYTES)


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (path / INFO).is_file()


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
    counted = info.get("total_episodes")
    total = counted if isinstance(counted, int) else math.inf
    for file in sorted(path.glob(DATA)):
        with _parquet(file) as parquet:
            tables = [parquet.read_row_group(group, columns) for group in range(parquet.num_row_groups)]
        for group, table in enumerate(tables):
            if missing := [name for name in columns if name not in table.column_names]:
                raise FrameError(f"{file}: has no column {', '.join(missing[:3])}, though {INFO} names it; {DAMAGED}")
            cells = {name: table.column(name).to_pylist() for name in columns}
            kept = [k for k, episode in enumerate(cells["episode_index"]) if episode < total]
            places += [(file, group, k) for k in kept]
            for name in columns:
                rows[name] += [cells[name][k] for k in kept]
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
