"""Records as a LeRobotDataset of version 3, written with pyarrow alone.

Each file appears under its name only when it is complete, and ``meta/info.json`` counts an episode only after its files. Therefore the data
set is readable after any interruption, up to its last finished episode. As LeRobot requires, ``timestamp`` is the frame's number divided by
the whole number of frames per second. The true times are in ``observation.time_s``; a note states where the two differ by more than half a
frame. In addition to LeRobot's columns, the table of episodes has ``tactip/facts``.
"""

import json
import shutil
import tempfile
from collections.abc import Iterator
from functools import partial, reduce
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from twin.errors import ErrorsAs, FrameError, format_count, library
from twin.frames import open_recording
from twin.frames.lerobot import COUNTERS
from twin.frames.videos import describe_pauses
from twin.records.folder import AGAIN, FolderWriter, card, image_of, png, read_json, read_sidecar, reading_tables, records_in, write_tables
from twin.records.record import TIME, About, Episode, RecordError, Records, RecordStep, channel_of, image_column, off_s
from twin.store import write_json, write_text, write_with
from twin.types import Form

CODEBASE = "v3.0"
"""Version of LeRobot's format that is written."""
INFO, STATS, TASKS, CARD = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "README.md"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
FRONT = "task_categories:\n- robotics\ntags:\n- LeRobot\n- tactile\nconfigs:\n- config_name: default\n  data_files: data/*/*.parquet\n"
"""Begin of the data set's page, by which Hugging Face reads it."""
FACTS = "tactip/facts"
"""Column of the table of episodes with the facts that the other formats also store."""
CHUNK_FILES = 1000
"""Number of files in a folder, as LeRobot itself has it."""
DATA_MB, VIDEO_MB = 100, 200
"""Largest size, MB, of a data file with several episodes, and the size that is stated for videos."""
ROWS = 64
"""Number of rows that are written together."""
SAMPLED = 100
"""Number of an episode's pictures from which its statistics are computed."""
PIXEL_STEP = 4
"""Step between the pixels, in each direction, from which the statistics of pictures are computed."""
QUANTILES = {"q01": 1.0, "q10": 10.0, "q50": 50.0, "q90": 90.0, "q99": 99.0}
"""Names and percentages of the quantiles in LeRobot's statistics."""
Stats = dict[str, dict[str, np.ndarray]]
FOURCC = "mp4v"
"""Codec of videos that every build of OpenCV has (MPEG-4 part 2)."""


class LeRobotWriter(FolderWriter):
    """Writes records as a LeRobotDataset of version 3, with pictures as PNG in the tables, or in videos."""

    FORMAT = "lerobot"
    NAMES = ("meta", "data", "videos", CARD)
    LIBRARIES = ("pyarrow.parquet",)
    VIEWS, VIDEOS = True, True

    def __init__(self, folder: Path, about: About, rate_hz: int, **options: bool) -> None:
        super().__init__(folder, about, rate_hz, **options)
        self._images = [image_column(view) for view in about.views]
        self._file = self._frames = 0  # number of the next file, and number of frames so far
        self._tasks: list[str] = []
        self._off: list[tuple[float, str, str]] = []  # largest error of a time (s), key and pauses of an episode
        self._stats: Stats = {}

    def _metadata(self) -> dict[str, Any]:
        return super()._metadata() | {"video": self.video}

    def _begin(self) -> None:
        write_text(self.folder / CARD, card(self.about, FRONT, "A LeRobotDataset of version 3."))

    def _find(self) -> list[dict[str, Any]]:
        self.video = bool(read_sidecar(self.folder)[1].get("video", False))
        rows = _episode_rows(self.folder)
        if rows:
            chunk, file = (int(rows[-1][f"data/{key}"]) for key in ("chunk_index", "file_index"))
            self._file, self._frames = 1 + chunk * CHUNK_FILES + file, int(rows[-1]["dataset_to_index"])
            with reading_tables(self.folder / TASKS) as parquet:
                self._tasks = [str(task) for task in parquet.read_table(self.folder / TASKS)["__index_level_0__"].to_pylist()]
            stats = read_json(self.folder / STATS)
            self._stats = {key: {k: np.asarray(v, float) for k, v in each.items()} for key, each in stats.items()}
        for path in self.folder.glob("**/chunk-*/file-*"):
            chunk, file = (int(part.split("-")[1].split(".")[0]) for part in path.parts[-2:])
            if chunk * CHUNK_FILES + file >= self._file:  # of a run that was killed
                path.unlink()
        return [_facts_of(row) for row in rows]

    def _groups(self, episodes: Iterator[Episode]) -> Iterator[list[dict[str, Any]]]:
        while (first := next(episodes, None)) is not None:
            if group := self._write_group(chain([first], episodes)):
                yield group

    def _write_group(self, waiting: Iterator[Episode]) -> list[dict[str, Any]]:
        """Write a file of episodes, then the data set's description. Returns the facts of each episode."""
        group: list[tuple[dict[str, Any], dict[str, Any], Stats]] = []  # row, facts and statistics of each episode
        at = {"chunk_index": self._file // CHUNK_FILES, "file_index": self._file % CHUNK_FILES}
        path = self.folder / DATA_PATH.format(**at)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="twin-video-") as aside:
            films = {image: Path(aside) / f"{image}.mp4" for image in self._images} if self.video else {}
            write_with(path, partial(self._fill, waiting=waiting, group=group, at=at, films=films))
            if not group:
                path.unlink()
                return []
            for image, film in films.items():
                into = self.folder / VIDEO_PATH.format(video_key=image, **at)
                into.parent.mkdir(parents=True, exist_ok=True)
                with film.open("rb") as made:
                    write_with(into, partial(shutil.copyfileobj, made))
        stats = reduce(_together, (each for _, _, each in group), self._stats)
        self._write_meta(group, at, stats)
        self._stats, self._file = stats, self._file + 1
        self._frames += sum(row["length"] for row, _, _ in group)
        return [facts for _, facts, _ in group]

    def _fill(self, file: BinaryIO, *, waiting: Iterator[Episode], group: list, at: dict[str, int], films: dict[str, Path]) -> None:
        """Write episodes into an open data file until it is large enough."""
        parquet, pa = library("pyarrow.parquet"), library("pyarrow")
        schema = self._schema(pa)
        frames, written = self._frames, 0
        codec = cv2.VideoWriter.fourcc(*FOURCC)
        opened = [cv2.VideoWriter(str(path), codec, float(self.rate_hz), self.about.size_px) for path in films.values()]
        if not all(film.isOpened() for film in opened):
            raise RecordError(f"this OpenCV can't write {FOURCC} videos; leave out `video`")
        with parquet.ParquetWriter(file, schema, compression="snappy", write_page_checksum=True) as table:
            for episode in waiting:
                number, rows, length = len(self.facts) + len(group), [], 0
                if episode.task not in self._tasks:
                    self._tasks.append(episode.task)
                task = self._tasks.index(episode.task)
                gathered = _Gathered()
                for step in episode.steps():
                    self._require_fitting(episode, step)
                    row = self._numbers(step, length, number, frames + length, task)
                    pictures = dict(zip(self._images, map(_colour, step.images), strict=True))
                    gathered.add(row, pictures)
                    for film, image in zip(opened, pictures.values(), strict=False):
                        film.write(np.ascontiguousarray(image[..., ::-1]))
                    stored = {} if self.video else {column: png(image) for column, image in pictures.items()}
                    written += sum(map(len, stored.values())) or 4 * sum(self.about.numbers.values())
                    path = f"frame-{length:06d}.png"
                    rows.append({column: {"bytes": data, "path": path} for column, data in stored.items()} | row)
                    length += 1
                    if len(rows) == ROWS:
                        table.write_table(pa.Table.from_pylist(rows, schema))
                        rows = []
                if rows:
                    table.write_table(pa.Table.from_pylist(rows, schema))
                if not length:
                    continue
                self._compare_times(np.array([row[TIME] for row in gathered.rows]), episode.key)
                group.append((self._episode_row(episode, number, frames, length, at), self._facts(episode, length), gathered.stats()))
                frames += length
                if self.at_once or written >= DATA_MB * 1e6:
                    break
        for film in opened:
            film.release()

    def notes(self) -> list[str]:
        if not self._off:
            return []
        most_s, key, pauses = max(self._off)
        where = f"{format_count(len(self._off), 'episodes')}, by up to {most_s:.3g} s in {key}{f' ({pauses})' if pauses else ''}"
        stamp = f"timestamp, as LeRobot defines it (frame number / {self.rate_hz} fps), is more than half a frame off the true times in"
        return [f"{stamp} {where}; the true times are in {TIME}"]

    def _compare_times(self, times_s: np.ndarray, key: str) -> None:
        """Remember an episode in which ``timestamp`` is more than half a frame off the true times."""
        most_s = float(off_s(times_s, self.rate_hz).max())
        if most_s > 0.5 / self.rate_hz:
            self._off.append((most_s, key, describe_pauses(times_s)))

    def _numbers(self, step: RecordStep, number: int, episode: int, index: int, task: int) -> dict[str, Any]:
        """A step's row without its pictures."""
        row: dict[str, Any] = {}
        for name, count in self.about.numbers.items():  # a single number is no list
            values = np.asarray(step.values[name], np.float32)
            row[channel_of(name).column] = values.tolist() if count > 1 else values.item()
        counted = dict(zip(COUNTERS, (number, episode, index, task), strict=True))
        return row | {TIME: float(step.time_s), "timestamp": number / self.rate_hz} | counted

    def _schema(self, pa: Any) -> Any:
        """Columns of the data files: their Arrow types, and in the metadata their description for Hugging Face's library."""
        columns: list[tuple[str, Any]] = []
        described: dict[str, Any] = {}
        said: dict[str, Any]
        for name, feature in self._features().items():
            dtype, shape = feature["dtype"], feature["shape"]
            if dtype == "video":
                continue
            if dtype == "image":
                kind, said = pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"_type": "Image"}
            else:
                kind, said = getattr(pa, dtype)(), {"dtype": dtype, "_type": "Value"}
                if len(shape) == 2:
                    kind, said = pa.list_(pa.list_(kind)), {"shape": shape, "dtype": dtype, "_type": "Array2D"}
                elif shape != [1]:
                    kind, said = pa.list_(kind, shape[0]), {"feature": said, "length": shape[0], "_type": "Sequence"}
            columns.append((name, kind))
            described[name] = said
        return pa.schema(columns, metadata={"huggingface": json.dumps({"info": {"features": described}})})

    def _features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's description of the columns."""
        width, height = self.about.size_px
        image: dict[str, Any] = {"dtype": "image", "shape": [height, width, 3], "names": ["height", "width", "channels"]}
        if self.video:
            said = {"video.height": height, "video.width": width, "video.codec": "mpeg4", "video.pix_fmt": "yuv420p", "video.channels": 3}
            image |= {"dtype": "video", "info": said | {"video.fps": self.rate_hz, "video.is_depth_map": False, "has_audio": False}}
        features = dict.fromkeys(self._images, image)
        for name in self.about.numbers:
            shape, names = list(self.about.shape(name)), list(self.about.axes(name))
            features[channel_of(name).column] = {"dtype": "float32", "shape": shape, "names": names if len(shape) == 1 else ["pin", "axis"]}
        kinds = {TIME: "float64", "timestamp": "float32"} | dict.fromkeys(COUNTERS, "int64")
        return features | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}

    def _episode_row(self, episode: Episode, number: int, start: int, length: int, at: dict[str, int]) -> dict[str, Any]:
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": length}
        row |= {"dataset_from_index": start, "dataset_to_index": start + length}
        for what in ("data", "meta/episodes", *(f"videos/{image}" for image in self._images if self.video)):
            row |= {f"{what}/{key}": value for key, value in at.items()}
        if self.video:
            before = start - self._frames  # frames of this file before it
            ends_s = {"from": before / self.rate_hz, "to": (before + length) / self.rate_hz}
            row |= {f"videos/{image}/{end}_timestamp": time_s for image in self._images for end, time_s in ends_s.items()}
        return row

    def _write_meta(self, group: list, at: dict[str, int], stats: Stats) -> None:
        """Write the data set's description. The number of episodes comes last."""
        pa = library("pyarrow")
        index = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
        column = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None}
        pandas = {"index_columns": ["__index_level_0__"], "column_indexes": [], "columns": [column, index], "pandas_version": "2.2.0"}
        tasks = pa.table({"task_index": pa.array(range(len(self._tasks)), pa.int64()), "__index_level_0__": self._tasks})
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(pandas)})
        write_tables(self.folder / TASKS, tasks)
        rows = [
            row | {f"stats/{key}/{k}": v.tolist() for key, each in found.items() for k, v in each.items()} | {FACTS: json.dumps(facts)}
            for row, facts, found in group
        ]
        write_tables(self.folder / EPISODES_PATH.format(**at), pa.Table.from_pylist(rows))
        write_json(self.folder / STATS, {key: {k: v.tolist() for k, v in each.items()} for key, each in stats.items()})
        last = group[-1][0]
        count = last["episode_index"] + 1
        info: dict[str, Any] = {"codebase_version": CODEBASE, "robot_type": self.about.robot or None}
        info |= {"total_episodes": count, "total_frames": last["dataset_to_index"], "total_tasks": len(self._tasks)}
        info |= {"chunks_size": CHUNK_FILES, "data_files_size_in_mb": DATA_MB, "video_files_size_in_mb": VIDEO_MB}
        info |= {"fps": self.rate_hz, "splits": {"train": f"0:{count}"}, "data_path": DATA_PATH}
        info |= {"video_path": VIDEO_PATH if self.video else None, "features": self._features()}
        write_json(self.folder / INFO, info)


class _Gathered:
    """Data from which an episode's statistics are computed."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._pictures: list[dict[str, np.ndarray]] = []  # of each kept step
        self._every = 1

    def add(self, row: dict[str, Any], pictures: dict[str, np.ndarray]) -> None:
        """Add a step. Of a long episode only every second picture is kept, then every fourth, and so on."""
        if len(self.rows) % self._every == 0:
            self._pictures.append({column: image[::PIXEL_STEP, ::PIXEL_STEP] for column, image in pictures.items()})
        if len(self._pictures) > 2 * SAMPLED:
            self._pictures, self._every = self._pictures[::2], 2 * self._every
        self.rows.append(row)

    def stats(self) -> Stats:
        """Statistics of each column, in LeRobot's shapes: (3, 1, 1) for pictures, with values from 0 to 1, and (2,) for pins."""
        found = {}
        for column in self._pictures[0]:
            pixels = np.stack([pictures[column] for pictures in self._pictures]).reshape(-1, 3) / 255.0
            shaped = {key: value.reshape(-1, 1, 1) for key, value in _deviations(pixels).items()}
            found[column] = shaped | {"count": np.array([len(self._pictures)])}
        for column, first in self.rows[0].items():
            numbers = np.array([row[column] for row in self.rows], float).reshape(-1, *np.shape(first)[-1:] or (1,))
            found[column] = _deviations(numbers) | {"count": np.array([len(self.rows)])}
        return found


def _deviations(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Statistics (K,) of rows (M, K), without NaN; 0 for a column of NaN only."""
    known = np.isfinite(rows)
    some = known.any(axis=0)
    safe = np.where(some, rows, 0.0)
    levels = np.nanpercentile(safe, list(QUANTILES.values()), axis=0)
    found = {name: getattr(np, f"nan{name}")(safe, axis=0) for name in ("min", "max", "mean", "std")}
    return found | dict(zip(QUANTILES, levels, strict=True))


def _together(a: Stats, b: Stats) -> Stats:
    """Statistics of the union of two sets of rows. As in LeRobot, quantiles are averaged with the numbers of rows as weights."""
    if not a:
        return b
    found = {}
    for key, new in b.items():
        old = a[key]
        n, m = float(old["count"][0]), float(new["count"][0])
        mean = (n * old["mean"] + m * new["mean"]) / (n + m)
        square = (n * (old["std"] ** 2 + old["mean"] ** 2) + m * (new["std"] ** 2 + new["mean"] ** 2)) / (n + m)
        found[key] = {
            "min": np.minimum(old["min"], new["min"]),
            "max": np.maximum(old["max"], new["max"]),
            "mean": mean,
            "std": np.sqrt(np.maximum(square - mean**2, 0.0)),
            **{q: (n * old[q] + m * new[q]) / (n + m) for q in QUANTILES},
            "count": old["count"] + new["count"],
        }
    return found


def lerobot_records(folder: Path) -> Records:
    """Records in a data set that ``LeRobotWriter`` wrote.

    Raises
    ------
    RecordError
        The data set is damaged, or LeRobot or another program wrote it.
    """
    rows = _episode_rows(folder)
    facts = [_facts_of(row) for row in rows]
    return records_in(folder, LeRobotWriter.FORMAT, facts, lambda about, index: partial(_steps_of, folder, rows[index], about))


def _steps_of(folder: Path, row: dict[str, Any], about: About) -> Iterator[RecordStep]:
    path, number = folder / DATA_PATH.format(**{key: row[f"data/{key}"] for key in ("chunk_index", "file_index")}), row["episode_index"]
    columns = [image_column(view) for view in about.views]
    films = [_film_pictures(folder, row, about, column) for column in columns if f"videos/{column}/from_timestamp" in row]
    with reading_tables(path):
        dataset = library("pyarrow.dataset")
        checked, own = dataset.ParquetFragmentScanOptions(page_checksum_verification=True), dataset.field("episode_index") == number
        for rows in dataset.dataset(path).to_batches(filter=own, batch_size=ROWS, fragment_scan_options=checked):
            for line in rows.to_pylist():
                images = [next(film) for film in films] or [image_of(line[each]["bytes"], about.gray, str(path)) for each in columns]
                found = {name: np.asarray(line[channel_of(name).column], np.float32) for name in about.numbers}
                values = {name: value.reshape(about.shape(name)) for name, value in found.items()}
                yield RecordStep(images[0], float(line[TIME]), values, tuple(images[1:]))


def _film_pictures(folder: Path, row: dict[str, Any], about: About, column: str) -> Iterator[np.ndarray]:
    """An episode's pictures from its video."""
    at = {key: row[f"videos/{column}/{key}"] for key in ("chunk_index", "file_index")}
    rate_hz = int(read_json(folder / INFO)["fps"])
    first = round(row[f"videos/{column}/from_timestamp"] * rate_hz)
    with ErrorsAs(FrameError, lambda error: RecordError(f"{folder}: {error}")):
        for k, frame in enumerate(open_recording(folder / VIDEO_PATH.format(video_key=column, **at), None, Form.RAW)):
            if first <= k < first + row["length"]:
                yield frame.image[..., 0] if about.gray and frame.image.ndim == 3 else frame.image


def _episode_rows(folder: Path) -> list[dict[str, Any]]:
    """The table of episodes without statistics, up to the number of episodes that the description states."""
    if not (folder / INFO).is_file():
        if len(list(folder.glob("data/chunk-*/file-*.parquet"))) > 1:  # only the first file is there before it
            raise RecordError(f"{folder}: {INFO} is missing; {AGAIN}")
        return []
    total = read_json(folder / INFO).get("total_episodes")
    rows: list[dict[str, Any]] = []
    with reading_tables(folder / "meta/episodes") as parquet:
        for path in sorted(folder.glob("meta/episodes/chunk-*/file-*.parquet")):
            names = [name for name in parquet.read_schema(path).names if not name.startswith("stats/")]
            rows += parquet.read_table(path, columns=names, page_checksum_verification=True).to_pylist()
    if not isinstance(total, int) or len(rows) < total:
        raise RecordError(f"{folder}: {INFO} states {total!r} episodes, the table has {len(rows)}; {AGAIN}")
    return rows[:total]


def _facts_of(row: dict[str, Any]) -> dict[str, Any]:
    why = "the table of episodes is damaged, or this data set was not written by this program; give one that it wrote"
    with ErrorsAs((KeyError, TypeError, ValueError, RecursionError), lambda _: RecordError(why)):
        return dict(json.loads(row[FACTS]))


def _colour(image: np.ndarray) -> np.ndarray:
    """The picture with three channels."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
