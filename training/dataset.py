"""Labelled recordings, real and simulated, as data sets: the pins of every usable frame, and its labels."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from training.pins import PIN_COLUMNS, PinTable, pin_table, voronoi_areas
from training.simulated import is_pins_only, is_simulated, open_simulated, touched_labels
from training.targets import Targets, choose_targets, joined_targets
from twin.errors import FrameError
from twin.frames import Recording, open_recording
from twin.pins import nominal_reference
from twin.progress import Step
from twin.rig.labels import label_slope, plate_slope
from twin.types import Form

HELD_OUT = 5  # one row in so many is held out for validation
GROUP_COLUMN = "path_id"  # column of a simulated data set's table that numbers the contacts


@dataclass(frozen=True)
class Dataset:
    """Pins and labels of the usable rows of a recording, in the recording's order.

    Attributes
    ----------
    pins : PinTable
        M valid frames with complete labels.
    targets : Targets
        M rows of labels, raw and corrected.
    folders : tuple of Path
        Folders that it was read from.
    group : (M,) array or None
        Rows of one value belong together (the states of one simulated contact): they are never split.
    problems : list of str
        What is odd about the recording, and what was left out because of it; one line each.
    """

    pins: PinTable
    targets: Targets
    folders: tuple
    group: np.ndarray | None = None
    problems: list = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.pins)

    @property
    def folder(self) -> Path:
        """The one folder that it was read from, for callers that read its pictures.

        Raises
        ------
        FrameError
            The data set was joined from several recordings.
        """
        if len(self.folders) > 1:
            raise FrameError(f"pictures are read from one recording at a time, these are {len(self.folders)}; give one --data")
        return self.folders[0]

    def rows(self, index: np.ndarray) -> "Dataset":
        """The same data set with only some rows."""
        group = None if self.group is None else self.group[index]
        return replace(self, pins=self.pins.rows(index), targets=self.targets.rows(index), group=group)

    def beside(self, pins: "list[PinTable]") -> "Dataset":
        """This data set once with its own pins and once more with each of ``pins``; all copies of a row belong together."""
        copies = np.tile(np.arange(len(self)), 1 + len(pins))
        every = self.rows(copies)
        tables = {key: np.concatenate([getattr(table, key) for table in (self.pins, *pins)]) for key in PIN_COLUMNS}
        return replace(every, pins=every.pins.with_columns(tables), group=copies if self.group is None else every.group)


def load_dataset(
    folder: str | Path,
    spec: SensorSpec,
    columns: str | tuple = "surface-2d",
    *,
    form: Form | None = None,
    progress: Step | None = None,
) -> Dataset:
    """Read a labelled recording, real or simulated.

    Parameters
    ----------
    folder : path
        Anything ``open_recording`` takes that has a table of labels, or a simulated data set without pictures.
    columns : str or tuple of str
        A name of ``training.targets.PRESETS``, or the table's columns themselves.
    progress : callable, optional
        Called with (done, total) while the pipeline runs.

    Raises
    ------
    FrameError
        There is no table, a chosen column is missing, or no row is usable.

    Notes
    -----
    The corrected labels of a simulated data set are depth and angle of the surface that was touched: see ``touched_labels``.
    """
    problems: list[str] = []
    simulated = is_simulated(Path(folder))
    depth_per_move = plate_slope(spec.rig) if simulated else label_slope(spec.rig)
    if is_pins_only(Path(folder)):
        recording, truth = open_simulated(Path(folder), spec)
        pins = simulated_table(recording, spec, truth, progress=progress)
    else:
        recording = open_recording(folder, spec, form)
        pins = pin_table(recording, spec, problems=problems, progress=progress)
    row_of = {name: k for k, name in enumerate(recording.names)}
    rows = np.array([row_of[name] for name in pins.image_name], int)
    targets = choose_targets(recording, columns, rows, depth_per_move, problems)
    if simulated:
        targets = targets.instead(touched_labels(Path(folder), pins.image_name))
    unseen = ~pins.valid
    if unseen.any():
        problems.append(f"{_named(pins.image_name[unseen])}: pins not found; left out of training")
    unlabelled = pins.valid & ~np.isfinite(targets.raw).all(axis=1)
    if unlabelled.any():
        problems.append(f"{_named(pins.image_name[unlabelled])}: no number in {', '.join(targets.names)}; left out")
    good = np.flatnonzero(pins.valid & ~unlabelled)
    if not len(good):
        raise FrameError(f"{folder}: no frame has both pins and labels; {'; '.join(problems[:3])}")
    group = recording.labels[GROUP_COLUMN][rows][good] if GROUP_COLUMN in recording.labels else None
    kept = folder if isinstance(folder, Path) else Path(folder)  # a path of frames_at stays one
    return Dataset(pins.rows(good), targets.rows(good), (kept,), group, list(recording.problems) + problems)


def joined(parts: list[Dataset]) -> Dataset:
    """Several data sets of one sensor as one; rows that form a group in one of them form the same group in the whole.

    They are put in the order of their folders' names, so that the order in which they are given does not matter. Displacements are
    counted from the no-contact layout of the first one.

    Raises
    ------
    FrameError
        Their sensors, forms or labels differ, or one is given twice.
    """
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda part: part.folder.resolve().as_posix())
    first = parts[0]
    for before, part in zip(parts, parts[1:], strict=False):
        if part.folder.resolve() == before.folder.resolve():
            raise FrameError(f"{part.folder}: given twice; give every recording once")
        for what, mine, others in (
            ("sensor", part.pins.sensor.name, first.pins.sensor.name),
            ("form", part.pins.form, first.pins.form),
            ("labels", part.targets.names, first.targets.names),
        ):
            if mine != others:
                raise FrameError(f"{part.folder}: its {what} ({mine}) differs from that of {first.folder} ({others}); train on one kind")
    tables = [part.pins.seen_from(first.pins.reference) for part in parts]
    columns = {key: np.concatenate([getattr(table, key) for table in tables]) for key in PIN_COLUMNS}
    columns["image_name"] = np.concatenate([np.char.add(f"{part.folder.name}/", part.pins.image_name) for part in parts])
    pins = replace(first.pins.with_columns(columns), measured=all(table.measured for table in tables))
    targets = joined_targets([part.targets for part in parts])
    groups: list[np.ndarray] = []
    taken = 0  # numbers of groups that the parts before have used
    for part in parts:
        own = np.arange(len(part)) if part.group is None else np.unique(part.group, return_inverse=True)[1]
        groups.append(taken + own)
        taken += int(own.max()) + 1
    problems = [f"{part.folder.name}: {problem}" for part in parts for problem in part.problems]
    return Dataset(pins, targets, tuple(part.folder for part in parts), np.concatenate(groups), problems)


def split_rows(count: int, seed: int, group: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Training and validation rows: a random fifth is held out. The rows of recordings are sorted by label, so no block of rows would do.

    With ``group`` (count,) a fifth of the groups is held out, with all their rows.
    """
    if group is not None:
        names, of_row = np.unique(group, return_inverse=True)
        _, held = split_rows(len(names), seed)
        out = np.isin(of_row, held)
        return np.flatnonzero(~out), np.flatnonzero(out)
    shuffled = np.random.default_rng(seed).permutation(count)
    out_count = -(-count // HELD_OUT)
    return np.sort(shuffled[out_count:]), shuffled[:out_count]


def simulated_table(
    recording: Recording,
    spec: SensorSpec,
    truth: dict[str, np.ndarray],
    *,
    progress: Step | None = None,
) -> PinTable:
    """The table that a perfect pipeline would make of simulated frames, from their known pins; hidden caps count as lost.

    Each contact may have a sensor of its own (longer pins, a thinner skin). Its displacements are counted from this sensor's pins at rest,
    as those of a real sensor are counted from its own no-contact frame.
    """
    reference = nominal_reference(spec, recording.form)
    nodes = reference.pins_px + (truth["pins_px"].astype(float) - truth["rest_px"])
    area_px2 = voronoi_areas(nodes, reference, progress=progress)
    seen = np.ones(len(nodes), bool)
    return PinTable(
        spec, recording.form, reference, np.array(recording.names, str), nodes, area_px2, ~truth["visible"], seen, measured=True
    )


def _named(names: np.ndarray) -> str:
    return f"{len(names)} frames ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"
