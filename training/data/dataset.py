"""Labelled recordings, real and simulated, as data sets: the pins of every usable frame, and its labels."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from training.data.pins import PIN_COLUMNS, PinTable, pin_table, voronoi_areas
from training.data.simulated import contact_labels, is_pins_only, is_simulated, labels_of_surface, open_simulated
from training.data.targets import CONTACT, CONTACT_UNITS, Targets, choose_targets, joined_targets
from twin.errors import FrameError
from twin.frames import natural_key, open_recording
from twin.frames.tables import describe_count
from twin.pins import nominal_reference
from twin.progress import Step, unheard
from twin.rig.labels import label_slope, plate_slope
from twin.types import Form

# One row in this many is held out for validation.
HELD_OUT = 5
# Column of a simulated data set's table that holds the number of the contact.
GROUP_COLUMN = "path_id"


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
        Folders that the data set was read from.
    group : (M,) array or None
        Rows with the same value form a group (the states of one simulated contact). A group is never divided between training and
        validation.
    problems : list of str
        One line for each irregularity of the recording, and what was left out because of it.
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
        """The only folder that the data set was read from, for callers that read its pictures.

        Raises
        ------
        FrameError
            The data set was joined from several recordings.
        """
        if len(self.folders) > 1:
            raise FrameError(f"pictures are read from one recording at a time, these are {len(self.folders)}; give one `data`")
        return self.folders[0]

    def rows(self, index: np.ndarray) -> "Dataset":
        """The data set of the rows with these indices."""
        group = None if self.group is None else self.group[index]
        return replace(self, pins=self.pins.rows(index), targets=self.targets.rows(index), group=group)

    def natural_order(self) -> np.ndarray:
        """(M,) int: indices that put the rows in the natural order of their frames' names. For copied rows all first copies come first."""
        copies: dict[str, int] = {}
        keys = []
        for name in self.pins.image_name.tolist():
            copies[name] = copies.get(name, -1) + 1
            keys.append((copies[name], natural_key(name), name))
        return np.array(sorted(range(len(keys)), key=keys.__getitem__), int)

    def in_order(self) -> "Dataset":
        """The same data set in the natural order of its frames' names, whatever order the table has. Groups are numbered in this order."""
        ordered = self.rows(self.natural_order())
        if ordered.group is None:
            return ordered
        _, first, of_row = np.unique(ordered.group, return_index=True, return_inverse=True)
        return replace(ordered, group=np.argsort(np.argsort(first))[of_row.ravel()])

    def with_copies(self, pins: "list[PinTable]") -> "Dataset":
        """This data set, followed by copies with each of ``pins`` instead of its own. All copies of a row form a group."""
        copies = np.tile(np.arange(len(self)), 1 + len(pins))
        every = self.rows(copies)
        tables = {key: np.concatenate([getattr(table, key) for table in (self.pins, *pins)]) for key in PIN_COLUMNS}
        return replace(every, pins=every.pins.with_columns(tables), group=copies if self.group is None else every.group)


def load_dataset(
    folder: str | Path, spec: SensorSpec, columns: str | tuple = "surface-2d", *, form: Form | None = None, progress: Step = unheard
) -> Dataset:
    """Read a labelled recording, real or simulated.

    Parameters
    ----------
    folder : path
        Anything ``open_recording`` takes that has a table of labels, or a simulated data set without pictures.
    columns : str or tuple of str
        Key of ``training.data.targets.PRESETS``, or names of columns of the table.
    progress : callable, optional
        Called with (done, total) while the pipeline runs.

    Raises
    ------
    FrameError
        There is no table, a chosen column is missing, or no row is usable.

    Notes
    -----
    The corrected labels of a simulated data set are depth and angle of the touched surface: see ``labels_of_surface``.
    """
    problems: list[str] = []
    simulated = is_simulated(Path(folder))
    depth_per_move = plate_slope(spec.rig) if simulated else label_slope(spec.rig)
    if is_pins_only(Path(folder)):
        recording, truth = open_simulated(Path(folder), spec, form)
        reference = nominal_reference(spec, recording.form)
        # The displacements of each contact are relative to its own sensor's pins at rest, because its pins may be longer, its skin thinner.
        nodes_px = reference.pins_px + (truth["pins_px"].astype(float) - truth["rest_px"])
        known = {"image_name": np.array(recording.names, str), "valid": np.ones(len(nodes_px), bool), "lost": ~truth["visible"]}
        known |= {"nodes_px": nodes_px, "area_px2": voronoi_areas(nodes_px, reference, progress=progress)}
        pins = PinTable(spec, recording.form, reference, **known, measured=True)
    else:
        recording = open_recording(folder, spec, form)
        pins = pin_table(recording, spec, problems=problems, progress=progress)
    if simulated and (columns == CONTACT or set(CONTACT_UNITS) & set(columns)):
        recording.labels.update(contact_labels(Path(folder), recording.names))
    row_of = {name: k for k, name in enumerate(recording.names)}
    rows = np.array([row_of[name] for name in pins.image_name], int)
    targets = choose_targets(recording, columns, rows, depth_per_move, problems)
    if simulated:
        targets = targets.instead(labels_of_surface(Path(folder), pins.image_name))
    unseen = ~pins.valid
    if unseen.any():
        problems.append(f"{describe_count('frames', pins.image_name[unseen])}: pins not found; left out of training")
    unlabelled = pins.valid & ~np.isfinite(targets.raw).all(axis=1)
    if unlabelled.any():
        problems.append(f"{describe_count('frames', pins.image_name[unlabelled])}: no number in {', '.join(targets.names)}; left out")
    good = np.flatnonzero(pins.valid & ~unlabelled)
    if not len(good):
        raise FrameError(f"{folder}: no frame has both pins and labels; {'; '.join(problems[:3])}")
    group = recording.labels[GROUP_COLUMN][rows][good] if GROUP_COLUMN in recording.labels else None
    kept = folder if isinstance(folder, Path) else Path(folder)  # a path of ``frames_at`` keeps its table and no-contact frame
    return Dataset(pins.rows(good), targets.rows(good), (kept,), group, list(recording.problems) + problems)


def join_datasets(parts: list[Dataset]) -> Dataset:
    """Join several data sets of one sensor. Rows that form a group in one of them form a group in the result.

    The data sets are joined in the order of their folders' names, whatever the order in which they are given. Displacements are counted
    from the first data set's layout without contact.

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
    tables = [part.pins.relative_to(first.pins.reference) for part in parts]
    columns = {key: np.concatenate([getattr(table, key) for table in tables]) for key in PIN_COLUMNS}
    named = zip(name_prefixes([part.folder for part in parts]), parts, strict=True)
    columns["image_name"] = np.concatenate([np.char.add(prefix, part.pins.image_name) for prefix, part in named])
    pins = replace(first.pins.with_columns(columns), measured=all(table.measured for table in tables))
    targets = joined_targets([part.targets for part in parts])
    groups: list[np.ndarray] = []
    taken = 0  # number of groups in the parts before
    for part in parts:
        own = np.arange(len(part)) if part.group is None else np.unique(part.group, return_inverse=True)[1]
        groups.append(taken + own)
        taken += int(own.max()) + 1
    problems = [f"{part.folder.name}: {problem}" for part in parts for problem in part.problems]
    return Dataset(pins, targets, tuple(part.folder for part in parts), np.concatenate(groups), problems)


def with_common_labels(parts: Sequence[Dataset]) -> list[Dataset]:
    """Data sets reduced to the labels that all of them have. A label may vary in one data set and be constant in another.

    Raises
    ------
    FrameError
        They have no common label.
    """
    common = tuple(name for name in parts[0].targets.names if all(name in part.targets.names for part in parts))
    if not common:
        folders = ", ".join(str(part.folder) for part in parts)
        raise FrameError(f"{folders}: no label varies in all of them; train on each alone")
    return [replace(part, targets=part.targets.only(common)) for part in parts]


def name_prefixes(folders: Sequence[Path]) -> list[str]:
    """Text before the names of each folder's frames in a joined data set: the shortest distinct end of its path; of one folder none."""
    if len(folders) == 1:
        return [""]
    parts = [folder.resolve().parts for folder in folders]
    ends = (["/".join((*each[-count:], "")) for each in parts] for count in range(1, max(map(len, parts)) + 1))
    return next(names for names in ends if len(set(names)) == len(names))


def split_rows(count: int, seed: int, group: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Training and validation rows: a random fifth of the rows is held out.

    Rows are chosen by their number, so number them in the order of their names (``Dataset.in_order``). With ``group`` (count,) a fifth of
    the groups is held out, with all their rows.
    """
    if group is not None:
        names, of_row = np.unique(group, return_inverse=True)
        _, held = split_rows(len(names), seed)
        out = np.isin(of_row, held)
        return np.flatnonzero(~out), np.flatnonzero(out)
    shuffled = np.random.default_rng(seed).permutation(count)
    out_count = -(-count // HELD_OUT)
    return np.sort(shuffled[out_count:]), shuffled[:out_count]
