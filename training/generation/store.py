"""The folder of a simulated data set. Work on it can be stopped at any moment and continued.

A contact is done when its record exists in ``records/``. The record is written after the contact's pictures, whole or not at all. When
all records exist, the tables and ``truth.zarr`` are made from them in the order of the contacts. Therefore a data set does not depend on
the order in which its contacts were made, on the number of workers, or on interruptions.

``truth.zarr`` holds everything that is known about the frames, row by row as in the table ``targets.csv``.
"""

import csv
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from scenes.experiment import LABELS
from scenes.files import read_regular
from training.generation.config import DatasetError, GenerationConfig
from training.generation.make import REST, UNITS, Outcome, make_contact
from twin import store
from twin.errors import ErrorsAs, StoreError, format_count
from twin.frames.truth import TRUTH, image_name
from twin.store import atomic, write_text

# Largest size of a JSON file of a data set, bytes. A sensor's measured tables are its largest part.
LARGEST_RECORD = 100_000_000
# File of the data set's configuration.
CONFIG = "generation.json"
# Folder that holds a record of each contact that is done.
RECORDS = "records"
# Table of the values that were sampled for each contact.
DRAWS = "draws.csv"
# Columns of the table of draws that failed.
FAILURE_COLUMNS = ("path_id", "attempt", "reason")
# Files and folders of a data set, except CONFIG and MADE_BY.
FILES = (*("meta.json", "init_0.png", "images", "frames_bw", RECORDS, TRUTH), *("targets.csv", "move_executed.csv", DRAWS, "failures.csv"))
# Number of rows in a chunk of this group's arrays.
CHUNK_ROWS = 256


class Store:
    """A data set's folder. The caller holds its lock (``twin.store.locked``).

    Parameters
    ----------
    folder : Path
        An existing folder that is empty or holds a data set; ``refuse_foreign`` checks this.
    config : GenerationConfig

    Raises
    ------
    DatasetError
        The folder holds another data set, or can't be written to.
    StoreError
        Another version of the program made the contacts in the folder, so new ones would differ from them.
    """

    def __init__(self, folder: Path, config: GenerationConfig) -> None:
        self.folder, self.config = folder, config
        self.pictures = folder / config.image_folder
        self._check_config()
        try:
            for place in (folder, folder / RECORDS, self.pictures):
                atomic.remove_parts(place)
            (folder / RECORDS).mkdir(exist_ok=True)
            if config.images != "none":
                self.pictures.mkdir(exist_ok=True)
        except OSError as error:
            raise DatasetError(f"{folder}: can't be written to ({error.strerror}); give another folder with `out`") from error

    def list_finished(self) -> set[int]:
        """Indices of the contacts that are done. They include ``REST`` if the frame without contact is done or no pictures are wanted."""
        done = {int(path.stem) for path in (self.folder / RECORDS).glob("*.npz")}
        if self.config.images != "none":
            done = {index for index in done if (self.pictures / image_name(index, 0)).is_file()}
        if self.config.images == "none" or (self.folder / "init_0.png").is_file():
            done.add(REST)
        return done

    def check_count(self, count: int) -> None:
        """Raise DatasetError if the folder holds more contacts than the ``count`` that are wanted."""
        highest = max(self.list_finished(), default=REST)
        if highest >= count:
            raise DatasetError(f"{self.folder}: holds contacts up to {highest}; give `count` {highest + 1} or more, or another `out`")

    def add(self, outcome: Outcome) -> None:
        """Write the pictures and the record of a contact.

        Raises
        ------
        DatasetError
            The files can't be written: the disk is full, or the folder no longer exists.
        """
        with ErrorsAs(StoreError, self._unfinished_error):
            if outcome.index == REST:
                store.write_bytes(self.folder / "init_0.png", outcome.images[0])
                return
            for state, image in enumerate(outcome.images):
                store.write_bytes(self.pictures / image_name(outcome.index, state), image)
            record = {"notes": np.array(json.dumps({"draw": outcome.draw, "failures": outcome.failures})), **outcome.arrays}
            store.write_npz(self.folder / RECORDS / f"{outcome.index:06d}.npz", record, compressed=True)

    def finish(self, count: int) -> int:
        """Write tables and truth of the contacts 0 to ``count`` - 1, and return the number of frames."""
        tables: dict[str, list[dict]] = {"targets.csv": [], "move_executed.csv": [], DRAWS: [], "failures.csv": []}
        truth = TruthFile(self.folder / f".{TRUTH}.part")
        try:
            for index in range(count):
                with np.load(self.folder / RECORDS / f"{index:06d}.npz") as file:
                    arrays = {key: file[key] for key in file.files}
                notes = json.loads(str(arrays.pop("notes")))
                truth.append(arrays)
                self._add_rows(tables, index, arrays, notes)
            truth.close({"sensor": self.config.sensor.name, "form": str(self.config.form)})
            write_text(self.folder / "meta.json", json.dumps(self._meta(count)))
            for name, rows in tables.items():
                write_text(self.folder / name, _csv(rows, FAILURE_COLUMNS if name == "failures.csv" else None))
            atomic.replace_folder(truth.path, self.folder / TRUTH)
        except StoreError as error:
            raise self._unfinished_error(error) from error
        except OSError as error:
            raise self._unfinished_error(atomic.unwritten(self.folder / TRUTH, error)) from error
        return len(tables["targets.csv"])

    def _add_rows(self, tables: dict, index: int, arrays: dict, notes: dict) -> None:
        tables[DRAWS].append({"path_id": index, "attempt": len(notes["failures"]), **notes["draw"]})
        for attempt, reason in enumerate(notes["failures"]):
            tables["failures.csv"].append(dict(zip(FAILURE_COLUMNS, (index, attempt, reason), strict=True)))
        for state in range(len(arrays["path_id"])):
            name = image_name(index, state)
            labels = dict(zip(LABELS, (*arrays["pose"][state].tolist(), *arrays["move"][state].tolist()), strict=True))
            head = {"image_name": name, "data_name": name.rpartition("_")[0], "obj_id": 1, "pose_id": index + 1}
            tables["targets.csv"].append(head | labels | {"path_id": index, "fraction": float(arrays["fraction"][state])})
            tables["move_executed.csv"].append({"image_name": name, "executed": int(arrays["executed"][state])})

    def _meta(self, count: int) -> dict:
        """Content of ``meta.json``, with the keys that recordings have."""
        experiment, recording = self.config.experiment, self.config.sensor.recording
        low, high = np.array(list(experiment.ranges().values())).T.tolist()
        meta: dict[str, Any] = {"image_dir": self.config.image_folder, "target_df_file": "targets.csv", "tap_move": list(experiment.tap)}
        meta |= {"poses_rng": [high[:6], low[:6]], "moves_rng": [high[6:], low[6:]], "num_poses": count, "num_frames": 1}
        meta |= {"comments": f"simulated: {experiment.name}, {self.config.sensor.name}, {self.config.object.name}"}
        if recording and self.config.images == "processed":
            meta["threshold"] = [recording.threshold_block_px, recording.threshold_offset]
            meta["crop"] = list(recording.crop_px)
            meta["size"] = [recording.width_px, recording.height_px]
        return meta

    def _check_config(self) -> None:
        path, text = self.folder / CONFIG, self.config.text()
        begun, now = path.is_file(), json.loads(text)
        if begun and (before := read_record(path)) != now:
            other = ", ".join(key for key in {**now, **before} if before.get(key) != now.get(key))
            raise DatasetError(f"{self.folder}: holds a data set with other settings ({other}); repeat them, or give another `out`")
        store.require_same_code(self.folder, make_contact, begun=begun)
        if not begun:
            write_text(path, text)  # written last, so that a folder with a configuration also states what code made it

    def _unfinished_error(self, error: StoreError) -> DatasetError:
        done = len(self.list_finished() - {REST})
        return DatasetError(f"{error}; {format_count(done, 'contacts')} kept, and the same command resumes from there")


def read_record(path: Path) -> dict[str, Any]:
    """Content of a JSON file of a data set.

    Raises
    ------
    DatasetError
        The file can't be read, or holds something else.
    """
    try:
        found = json.loads(read_regular(path, LARGEST_RECORD).decode())
        if isinstance(found, dict):
            return found
        how = "it holds no record"
    except (OSError, ValueError, RecursionError) as error:
        how = getattr(error, "strerror", None) or "no readable JSON"
    raise DatasetError(f"{path}: damaged ({how}); copy the data set again, or make it again in another `out`")


def refuse_foreign(folder: Path) -> None:
    """Raise DatasetError if a folder holds files but no configuration of a data set."""
    found = store.contents(folder)
    if CONFIG in found:
        return
    ours = store.written_by_us(folder)  # files of a run that was killed before it wrote its configuration
    strange = [name for name in found if name not in ours]
    if strange:
        raise DatasetError(f"{folder}: holds something else ({', '.join(strange[:3])}); give an empty or a new folder with `out`")


class TruthFile:
    """A Zarr group to which rows are added. A chunk of ``CHUNK_ROWS`` rows is written once, when it is full."""

    def __init__(self, path: Path) -> None:
        self.path = path
        shutil.rmtree(path, ignore_errors=True)
        self._group = zarr.create_group(path, zarr_format=3)
        self._waiting: dict[str, list] = {}

    def append(self, arrays: dict) -> None:
        """Add S rows; ``arrays`` holds an array (S, ...) for each key."""
        for key, rows in arrays.items():
            self._waiting.setdefault(key, []).extend(rows)
        while len(self._waiting["path_id"]) >= CHUNK_ROWS:
            self._flush(CHUNK_ROWS)

    def close(self, attributes: dict) -> None:
        """Write the remaining rows and the attributes."""
        if self._waiting["path_id"]:
            self._flush(len(self._waiting["path_id"]))
        self._group.attrs.update(attributes)

    def _flush(self, rows: int) -> None:
        for key, waiting in self._waiting.items():
            block = np.stack(waiting[:rows])
            del waiting[:rows]
            array = self._group.get(key)
            if not isinstance(array, zarr.Array):
                shape, chunks = (0, *block.shape[1:]), (CHUNK_ROWS, *block.shape[1:])
                array = self._group.create_array(key, shape=shape, chunks=chunks, dtype=block.dtype, attributes={"meaning": UNITS[key]})
            array.append(block)


def _csv(rows: list[dict], columns: tuple | None = None) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
