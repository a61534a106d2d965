"""Records in the recordings' own format: pictures, ``targets.csv``, ``init_0.png``, and further files with what else is known.

Recordings of any origin, collections, and simulated data sets with their truth can be read. Each frame is its own episode, unless a column
``path_id`` states which frames are states of one contact.
"""

import csv
import json
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from scenes import ExperimentSpec, SensorSpec, load_sensor
from scenes.base import SpecError
from scenes.files import read_regular
from twin.errors import ErrorsAs, FrameError
from twin.frames import Recording, open_recording
from twin.frames.folders import pictures_folder
from twin.frames.images import write_image
from twin.frames.tables import numbers
from twin.records.folder import AGAIN, PicturesWriter, episode_of, format_of, read_facts, read_json, read_sidecar
from twin.records.record import CHANNELS, NOMINAL_HZ, About, Channel, Episode, RecordError, Records, RecordStep, digest, float32, seconds
from twin.rig.kinematics import Mounting
from twin.rig.labels import as_executed, read_executed
from twin.store import text_file, write_json, write_npz
from twin.types import Form

TABLE, PINS, EPISODES, META, REST = "targets.csv", "pins.npz", "episodes.json", "meta.json", "init_0.png"
MADE, TRUTH, LOG = "generation.json", "truth.zarr", "contacts.jsonl"
"""Files of simulated data sets (how the set was made, exact truth) and of collections (requested poses and their times)."""
PATH, TIME_S = "path_id", "time_s"
"""Columns of the table for the frame's episode and the frame's time."""
NOT_CARRIED = {"image_name", "sensor_image", "file_name", "data_name", "obj_id", "pose_id", "fraction", PATH, TIME_S}
"""Columns that records do not carry as numbers, because they are not needed."""


def columns_of(channel: Channel, axes: tuple[str, ...]) -> list[str]:
    """Columns of a channel in the table. Poses and moves have the columns that recordings have."""
    if channel.name in ("pose", "move"):
        return [f"{channel.name}_{k}" for k in range(1, 7)]
    return [f"{channel.name}_{axis}" for axis in axes]


def recording_records(path: Path, form: Form | None = None) -> Records:
    """A recording, a collection or a simulated data set as a record.

    Raises
    ------
    FrameError
        As for ``open_recording``, or a file beside the frames is damaged.
    RecordError
        The folder holds only pins, or is damaged.
    """
    if path.is_dir() and (path / TRUTH).is_dir() and not any((path / name).is_dir() for name in ("images", "frames_bw")):
        raise RecordError(f"{path}: holds pins without pictures; make the data set with `images` raw, gray or processed")
    stated = read_sidecar(path)[0] if path.is_dir() and format_of(path) == RecordingWriter.FORMAT else None
    if stated is not None and not (path / EPISODES).is_file():
        return Records(stated, [])
    recording = open_recording(path, None, form)
    values, estimates = _table_values(recording, {} if stated is None else stated.names)
    notes = list(recording.problems)
    _take_out_moves(path, recording, values, notes)
    values |= _read_pins(path, recording) | _read_truth(path, recording) | _read_requested_poses(path, recording)
    values = {name: values[name] for name in CHANNELS if name in values}
    found = next(iter(recording), None)
    if found is None:
        raise RecordError(f"{path}: no frame can be read; {AGAIN}")
    described = _read_description(path)
    about = stated or About(
        sensor=str(described.get("sensor", "")),
        form=recording.form,
        size_px=recording.size_px,
        gray=found.image.ndim == 2,
        numbers={name: int(np.prod(array.shape[1:])) for name, array in values.items()},
        estimates=estimates,
        robot=str(described.get("arm", "")),
    )
    if missing := set(about.numbers) - set(values):
        raise RecordError(f"{path}: {PINS if missing == {'pins'} else TABLE} is missing, or lacks columns; {AGAIN}")
    carried = {column for name in values for column in columns_of(CHANNELS[name], about.axes(name))} | NOT_CARRIED
    left = [name for name, cells in recording.labels.items() if name not in carried and cells.dtype.kind == "f"]
    notes += [f"columns {', '.join(left)} are not copied into the record"] if left else []
    records = Records(about, [], notes)
    rest = None if recording.reference is None else recording.reference.image
    facts = [] if stated is None else read_facts(path / EPISODES)
    for number, rows in enumerate(_paths(recording)):
        times_s = _times(recording, rows, notes)
        steps = partial(_steps_of, recording, values, rows, times_s, notes)
        if stated is not None:
            if number == len(facts):  # the rest was unfinished when a run was killed
                break
            records.episodes.append(episode_of(path, facts[number], steps, rest))
            continue
        labels = {name: array[rows[0]].tolist() for name, array in values.items() if name in ("pose", "move")}
        key = f"{path.name}/{recording.names[rows[0]]}#{digest(labels, len(rows))}"
        records.episodes.append(Episode(key, str(described["task"]), steps, len(rows), rest, T_tool_sensor=described.get("T_tool_sensor")))
    return records


def _steps_of(
    recording: Recording, values: dict[str, np.ndarray], rows: np.ndarray, times_s: np.ndarray, notes: list[str]
) -> Iterator[RecordStep]:
    for row, time_s in zip(rows.tolist(), times_s.tolist(), strict=True):
        try:
            frame = recording.read(row)
        except FrameError as error:
            if (note := f"skipped {error}") not in notes:
                notes.append(note)
            continue
        yield RecordStep(frame.image, seconds(time_s - times_s[0]), {name: array[row] for name, array in values.items()})


def _paths(recording: Recording) -> list[np.ndarray]:
    """Rows of each episode, in the order of their first frames."""
    if PATH not in recording.labels:
        return [np.array([row]) for row in range(len(recording))]
    rows: dict[float, list[int]] = {}
    for row, path_id in enumerate(numbers(recording.labels[PATH]).tolist()):
        rows.setdefault(path_id if np.isfinite(path_id) else -1.0 - row, []).append(row)
    return [np.array(each) for each in rows.values()]


def _times(recording: Recording, rows: np.ndarray, notes: list[str]) -> np.ndarray:
    """Times (n,) of an episode's frames. If the table has no times, or impossible ones (which are noted), nominal times are used."""
    if TIME_S in recording.labels:
        times_s = numbers(recording.labels[TIME_S][rows])
        if np.isfinite(times_s).all() and (np.diff(times_s) >= 0).all():
            return times_s
        fault = "does not increase everywhere, or has cells without a number"
        note = f"column {TIME_S} {fault}; such episodes get {NOMINAL_HZ:g} frames per second"
        if len(rows) > 1 and note not in notes:
            notes.append(note)
    return np.arange(len(rows)) / NOMINAL_HZ


def _table_values(recording: Recording, names: dict[str, tuple[str, ...]]) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """The table's numbers of each channel, and the names of estimated labels. ``names`` are those of ``About``."""
    labels = recording.labels
    estimates = tuple(name.removeprefix("estimate_") for name in labels if name.startswith("estimate_"))
    found = {}
    for channel in CHANNELS.values():
        axes = names.get(channel.name) or channel.axes or (estimates if channel.name not in ("pins", "goal") else ())
        columns = columns_of(channel, axes)
        if not any(column in labels for column in columns):
            continue
        # Recordings leave out what they never move: a coordinate of a pose or a move that has no column is 0.
        missing = np.zeros(len(recording)) if channel.name in ("pose", "move") else np.full(len(recording), np.nan)
        found[channel.name] = np.stack([numbers(labels[c]) if c in labels else missing for c in columns], axis=1).astype(np.float32)
    return found, estimates


def _take_out_moves(path: Path, recording: Recording, values: dict[str, np.ndarray], notes: list[str]) -> None:
    """Take moves that were not executed before the picture out of poses and moves, if a file beside the table names them.

    A record says where the tool stood and which move it had made. The labels of such frames say neither (``twin.rig.labels``).
    """
    if not {"pose", "move"} <= values.keys() or not path.is_dir():
        return
    known = read_executed(path, recording.names, notes)
    executed = np.array([known.get(name, 1.0) for name in recording.names], np.float32)
    if count := np.count_nonzero(executed != 1):
        notes.append(f"moves that were not, or not certainly, executed ({count}) are removed from poses and moves")
        values["pose"], values["move"] = as_executed(values["pose"], values["move"], executed)


def _read_pins(path: Path, recording: Recording) -> dict[str, np.ndarray]:
    """Pins that ``twin preprocess`` or a translation found, for the recording's frames; NaN for frames without pins."""
    if not (path / PINS).is_file():
        return {}
    # zipfile and numpy raise exceptions of any type for damaged files
    damaged = ErrorsAs(Exception, lambda error: FrameError(f"{path / PINS}: damaged; {AGAIN}"))
    with damaged, np.load(path / PINS, allow_pickle=False) as file:
        names, pins_px = file["image_name"].tolist(), file["pins_px"].astype(np.float32)
    row_of = {name: row for row, name in enumerate(names)}
    rows = np.array([row_of.get(name, -1) for name in recording.names])
    return {"pins": np.where((rows >= 0)[:, None, None], pins_px[rows], np.float32(np.nan))}


def _read_truth(path: Path, recording: Recording) -> dict[str, np.ndarray]:
    """Pins, wrench, and the pose that the arm was commanded to, of a simulated data set."""
    if not (path / TRUTH).is_dir():
        return {}
    from twin.frames.truth import arrays_of, open_truth, row_of

    truth, _, _ = open_truth(path)
    by_name = row_of(truth)
    if strange := [name for name in recording.names if name not in by_name]:
        raise FrameError(f"{path}: {TRUTH} has no row for {strange[0]}: the data set is damaged; {AGAIN}")
    rows = [by_name[name] for name in recording.names]
    arrays = arrays_of(truth, ("pins_px", "force_n", "torque_nmm", "pose"))
    wrench = np.concatenate([arrays["force_n"], arrays["torque_nmm"]], axis=1)
    return {name: a[rows].astype(np.float32) for name, a in (("pins", arrays["pins_px"]), ("wrench", wrench), ("action", arrays["pose"]))}


def _read_requested_poses(path: Path, recording: Recording) -> dict[str, np.ndarray]:
    """The poses that a collection requested."""
    if not (path / LOG).is_file():
        return {}
    asked = {}
    for line in read_regular(path / LOG, 1_000_000_000).decode("utf-8", "replace").splitlines():
        with suppress(ValueError, KeyError, TypeError, RecursionError):
            found = json.loads(line)
            asked[str(found["image_name"])] = float32(found["asked"][:6], 6)
    none = np.full(6, np.nan, np.float32)
    return {"action": np.stack([asked.get(name, none) for name in recording.names])} if asked else {}


def _read_description(path: Path) -> dict[str, Any]:
    """Sensor, arm, task and ``T_tool_sensor`` of a recording, if its files state them."""
    described: dict[str, Any] = {"task": "touch"}
    for name in (META, MADE):
        if path.is_dir() and (path / name).is_file():
            try:
                content = read_json(path / name)
            except RecordError:  # a recording of another program. Its metadata are noted when it is opened
                continue
            described |= {key: content[key] for key in ("arm", "sensor", "experiment") if key in content}
            if isinstance(content.get("comments"), str) and content["comments"]:
                described["task"] = content["comments"]
    sensor, experiment = described.get("sensor", ""), described.get("experiment")
    try:
        spec = SensorSpec.model_validate(sensor) if isinstance(sensor, dict) else load_sensor(str(sensor)) if sensor else None
        described["sensor"] = "" if spec is None else spec.name
        if spec is not None and isinstance(experiment, dict):
            described["T_tool_sensor"] = Mounting.of(spec, ExperimentSpec.model_validate(experiment)).T_tool_sensor
    except (SpecError, ValidationError):
        described["sensor"] = sensor if isinstance(sensor, str) else ""
    return described


class RecordingWriter(PicturesWriter):
    """Writes records as a recording. Numbers that recordings do not have go into further columns and into ``pins.npz``.

    A recording has one picture without contact: that of the first episode that has one.
    """

    FORMAT = "recording"
    NAMES = (TABLE, PINS, EPISODES, META, REST, "images", "frames_bw")

    @property
    def _pictures(self) -> Path:
        return self.folder / pictures_folder(self.about.form)

    def _begin(self) -> None:
        self._rows: list[list[str]] = []
        self._pins: list[np.ndarray] = []
        self._pictures.mkdir(exist_ok=True)

    def _find(self) -> list[dict[str, Any]]:
        """The listed episodes and their rows. Pictures and rows of other episodes are overwritten."""
        self._begin()
        if not (self.folder / EPISODES).is_file():
            return []
        facts = read_facts(self.folder / EPISODES)
        length = sum(int(each["length"]) for each in facts)
        # zipfile and numpy raise exceptions of any type for damaged files
        with ErrorsAs(Exception, lambda error: RecordError(f"{self.folder}: {TABLE} or {PINS} is damaged; {AGAIN}")):
            with (self.folder / TABLE).open(newline="", encoding="utf-8") as file:
                self._rows = list(csv.reader(file))[1 : length + 1]
            if "pins" in self.about.numbers:
                with np.load(self.folder / PINS, allow_pickle=False) as arrays:
                    self._pins = list(arrays["pins_px"][:length])
        return facts

    def _facts(self, episode: Episode, length: int) -> dict[str, Any]:
        if episode.rest is not None and not (self.folder / REST).is_file():
            write_image(self.folder / REST, episode.rest)
        return episode.facts() | {"length": length}

    def _write_step(self, episode: Episode, step: RecordStep, number: int, k: int) -> tuple[list[str], list[np.ndarray]]:
        """The cells of the table's row, and the pins, if the record has them."""
        data_name = f"frame_{number}"
        name = f"{data_name}_{k}.png"
        write_image(self._pictures / name, step.image)
        cells = [name, data_name, "1", str(number + 1), str(number), repr(float(step.time_s))]
        for channel in self._columns():
            cells += ["" if np.isnan(value) else repr(float(value)) for value in step.values[channel]]
        return cells, [step.values["pins"]] if "pins" in self.about.numbers else []

    def _columns(self) -> dict[str, list[str]]:
        return {name: columns_of(CHANNELS[name], self.about.axes(name)) for name in self.about.numbers if name != "pins"}

    def _commit(self, group: list[dict[str, Any]], rows: list[Any]) -> None:
        """Write the table, the pins and, last, the list of episodes. Each file is replaced as a whole."""
        self._rows += [cells for cells, _ in rows]
        self._pins += [pins_px for _, pins in rows for pins_px in pins]
        facts = [*self.facts, *group]
        if self._pins:
            write_npz(self.folder / PINS, {"image_name": np.array([row[0] for row in self._rows]), "pins_px": np.stack(self._pins)})
        with text_file(self.folder / TABLE) as text:
            writer = csv.writer(text, lineterminator="\n")
            named = [column for columns in self._columns().values() for column in columns]
            writer.writerow(["image_name", "data_name", "obj_id", "pose_id", PATH, TIME_S, *named])
            writer.writerows(self._rows)
        write_json(self.folder / META, {"comments": facts[0]["task"], "sensor": self.about.sensor, "num_poses": len(facts)})
        write_json(self.folder / EPISODES, {"episodes": facts})
