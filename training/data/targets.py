"""The labels that a model is trained on: columns of a recording's table, as published (raw) and corrected.

Labels are corrected for this reason: about a third of the frames in the published Tac-VGNN recordings were taken before the shear move
was executed. In these frames both shears are zero, and the angle is ``pose_6 - move_6``. Because the plate is slightly tilted, their
depth is ``pose_2 + c move_1``, and the depth of a tap at ``pose_1`` is ``pose_2 - c pose_1``. For recordings c is the rig's
``label_depth_per_move``; for simulated contacts it is the slope of the plate.
"""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scenes.files import quote
from twin.errors import FrameError
from twin.frames import Recording
from twin.frames.tables import numbers
from twin.rig.labels import read_executed

# Columns by their role in recordings of an arm that holds the sensor level: depth and angle of the surface, shear along it and turn.
DEPTH, ANGLE = "pose_2", "pose_6"
SHEAR, TURN = "move_1", "move_6"
PRESETS = {
    "surface-2d": (DEPTH, ANGLE),
    "surface-2d-shear": (DEPTH, ANGLE, SHEAR, TURN),
    "surface-3d": ("pose_3", "pose_4", "pose_5"),
    "edge-2d": ("pose_1", "pose_6"),
    "edge-3d": ("pose_1", "pose_3", "pose_6"),
    "edge-circle": ("pose_2", "pose_3", "pose_6"),
}
# Preset whose columns depend on the recording: all columns of its table about the contact (``contact_columns``).
CONTACT = "contact"
# Known properties of a simulated contact besides the arm's pose: name of the label and its unit. Forces act from the skin on the object, in
# the sensor frame (z out of the tip). The torque is about the sensor's axis. The area is that of the skin at rest.
CONTACT_UNITS = {"force_x": "N", "force_y": "N", "force_z": "N", "torque_z": "Nmm", "contact_area": "mm2", "slip_share": "", "contact": ""}
# Least and greatest value that a label can have.
BOUNDS = {"contact_area": (0.0, np.inf), "slip_share": (0.0, 1.0), "contact": (0.0, 1.0)}
# Columns of measured forces and torques in recordings (N, N mm), with the names of published recordings.
MEASURED_UNITS = {"Fx": "N", "Fy": "N", "Fz": "N", "Tx": "Nmm", "Ty": "Nmm", "Tz": "Nmm"}
# Fields of Targets that hold a row for each frame.
TARGET_COLUMNS = ("raw", "corrected", "executed", "move")
# Units of pose_1 to pose_6, and of move_1 to move_6.
UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
# Kinds of columns about the arm, and the units of their axes.
KINDS = ("pose", "move", "shear")
AXES = dict(zip(("1", "2", "3", "4", "5", "6", "x", "y", "z", "Rx", "Ry", "Rz"), 2 * UNITS, strict=True))


def limits_of(names: Sequence[str]) -> np.ndarray:
    """Least and greatest values (2, K) that labels can have; infinite where there is no limit."""
    return np.array([BOUNDS.get(name, (-np.inf, np.inf)) for name in names]).T


@dataclass(frozen=True)
class Targets:
    """Labels of M frames, K of them.

    Attributes
    ----------
    names : tuple of str
        The table's columns.
    raw : (M, K) float
        Labels as in the table, mm and deg; NaN if a cell holds no number.
    corrected : (M, K) float
        ``raw`` without moves that were not executed; equal to ``raw`` if nothing is known about the moves. For simulated contacts: the
        depth and the angle of the touched surface, of any shape.
    executed : (M,) float
        Whether each move was executed: 1, 0, or NaN if that is not known.
    move : (M, 2) float
        ``move_1`` (mm) and ``move_6`` (deg) as in the table; NaN if the table does not have them.
    """

    names: tuple[str, ...]
    raw: np.ndarray
    corrected: np.ndarray
    executed: np.ndarray
    move: np.ndarray

    def rows(self, index: np.ndarray) -> "Targets":
        """The labels of the rows with these indices."""
        return Targets(self.names, **{key: getattr(self, key)[index] for key in TARGET_COLUMNS})

    def only(self, names: tuple[str, ...]) -> "Targets":
        """The same frames with fewer labels, in the order of ``names``."""
        chosen = [self.names.index(name) for name in names]
        return replace(self, names=names, raw=self.raw[:, chosen], corrected=self.corrected[:, chosen])

    def instead(self, known: Mapping[str, np.ndarray]) -> "Targets":
        """These targets with other corrected labels: ``known`` holds values (M,) by the names of label columns."""
        columns = [known.get(name, self.corrected[:, k]) for k, name in enumerate(self.names)]
        return replace(self, corrected=np.column_stack(columns))

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each label: mm, deg, or "" if it does not follow from the column's name."""
        return tuple(unit_of(name) for name in self.names)


def joined_targets(parts: Sequence[Targets]) -> Targets:
    """Labels of several data sets one after the other; all have the same label columns."""
    return Targets(parts[0].names, **{key: np.concatenate([getattr(part, key) for part in parts]) for key in TARGET_COLUMNS})


def unit_of(name: str) -> str:
    """Unit of a column: mm for ``pose_1..3``, ``move_1..3`` and tactile_data's ``pose_x``; deg for ``..4..6`` and ``pose_Rx``."""
    if name in CONTACT_UNITS or name in MEASURED_UNITS:
        return (CONTACT_UNITS | MEASURED_UNITS)[name]
    kind, _, axis = name.partition("_")
    return AXES.get(axis, "") if kind in KINDS else {"force": "N", "torque": "Nmm"}.get(kind, "")


def choose_targets(recording: Recording, columns: str | tuple, rows: np.ndarray, depth_per_move: float, problems: list[str]) -> Targets:
    """Labels of the recording's frames ``rows`` (M,); ``depth_per_move`` is c above.

    Raises
    ------
    FrameError
        The recording has no table, or a column is missing.
    """
    if columns == CONTACT:
        names = contact_columns(recording)
    else:
        names = PRESETS.get(columns, (columns,)) if isinstance(columns, str) else tuple(columns)
    if not recording.labels:
        raise FrameError(
            f"{recording.path}: no labels ({recording.labels_found()}); targets.csv with {', '.join(names)} is expected beside the frames"
        )
    missing = [name for name in names if name not in recording.labels]
    if missing:
        near = [n for name in missing for n in difflib.get_close_matches(name, recording.labels, n=2)]
        nearest = f"nearest: {', '.join(dict.fromkeys(near))}; " if near else ""
        raise FrameError(
            f"{recording.path}: column {', '.join(missing)} is missing; {recording.labels_found()}; {nearest}"
            f"choose columns of these, or one of {', '.join((*PRESETS, CONTACT))}"
        )
    raw = np.column_stack([_numbers(recording.labels[name], name, problems) for name in names])[rows]
    move, executed = np.full((len(rows), 2), np.nan), np.full(len(rows), np.nan)
    if SHEAR in recording.labels and TURN in recording.labels:
        move = np.column_stack([numbers(recording.labels[name]) for name in (SHEAR, TURN)])[rows]
        known = read_executed(recording.path, [recording.names[row] for row in rows], problems)
        executed = np.array([known.get(recording.names[row], np.nan) for row in rows])
    x_mm = numbers(recording.labels["pose_1"])[rows] if "pose_1" in recording.labels else np.zeros(len(rows))
    right = correct_labels(names, raw, executed, move, depth_per_move, np.nan_to_num(x_mm))
    undone = 1.0 - np.where(np.isnan(executed), 1.0, executed)
    for k, name in enumerate(names):  # further labels, which published recordings lack: subtract a move that was not executed from each
        made = f"move_{name.removeprefix('pose_')}"
        if name.startswith("pose_") and name != ANGLE and made in recording.labels:
            right[:, k] -= undone * np.nan_to_num(numbers(recording.labels[made])[rows])
    return Targets(names, raw, right, executed, move)


def contact_columns(recording: Recording) -> tuple[str, ...]:
    """Varying columns of a recording's table that describe its contacts: poses, moves, shears, forces, torques, areas and slip.

    Raises
    ------
    FrameError
        The table has no such column.
    """
    names: list[str] = []
    for name, cells in recording.labels.items():
        if name in CONTACT_UNITS or name in MEASURED_UNITS or (name.partition("_")[0] in KINDS and unit_of(name)):
            values = np.nan_to_num(numbers(cells))
            twice = any(np.array_equal(values, np.nan_to_num(numbers(recording.labels[other]))) for other in names)
            if np.ptp(values) > 0 and not twice:  # a column of another convention exists under two names and is used once
                names.append(name)
    if not names:
        raise FrameError(f"{recording.path}: no column with different values describes the contacts; {recording.labels_found()}")
    return tuple(names)


def correct_labels(
    names: tuple[str, ...], raw: np.ndarray, executed: np.ndarray, move: np.ndarray, depth_per_move: float, x_mm: np.ndarray | float = 0.0
) -> np.ndarray:
    """Labels (M, K) without moves (M, 2) that were not executed. A move whose ``executed`` (M,) is not known counts as executed.

    ``x_mm`` (M,) is the table's ``pose_1``: 0 in the published recordings.
    """
    undone = 1.0 - np.where(np.isnan(executed), 1.0, executed)
    out = raw.copy()
    for k, name in enumerate(names):
        if name == ANGLE:
            out[:, k] -= undone * np.nan_to_num(move[:, 1])
        elif name == DEPTH:
            out[:, k] += depth_per_move * (undone * np.nan_to_num(move[:, 0]) - x_mm)
        elif name in (SHEAR, TURN):
            out[:, k] *= 1 - undone
    return out


def _numbers(cells: np.ndarray, name: str, problems: list[str]) -> np.ndarray:
    """A column as floats; a cell without a finite number becomes NaN, and such cells are counted in ``problems``."""
    values = numbers(cells)
    if (bad := np.isnan(values)).any():
        problems.append(f"column {name}: {bad.sum()} cells hold no finite number, the first '{quote(cells[bad][0])}'")
    return values
