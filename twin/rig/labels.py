"""Labels of the arm: the commanded pose in each row of a table, and whether the move was executed before the frame was taken.

In the published Tac-VGNN recordings (Apache-2.0), about a third of the frames were taken before the shear move was executed. An audit
writes into a file beside the table which frames these are. Without this file every move counts as executed.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.experiment import LABELS, ExperimentSpec
from scenes.rig import RigSpec
from twin.errors import FrameError
from twin.frames import Recording
from twin.frames.tables import bare_name, describe_count, numbers, pair_rows, read_table

EXECUTED_FILES = ("labels_corrected.csv", "move_executed.csv")  # in the order of precedence
EXECUTED_COLUMNS = ("executed", "executed_estimate")
HELD = 0.5  # mm or deg; permitted range of a label that the experiment does not vary, because poses that an arm reports scatter
NOT_USED = "it is not used, and every move counts as executed"


@dataclass(frozen=True)
class ArmLabel:
    """Label of one contact in a recording's table.

    Attributes
    ----------
    pose, move : (6,) float
        x, y, z in mm and Rx, Ry, Rz in deg. The pose is the pose after the move.
    executed : bool
        Whether the move was executed before the frame was taken.
    """

    pose: np.ndarray
    move: np.ndarray
    executed: bool = True


def read_arm_labels(recording: Recording, experiment: ExperimentSpec | None = None) -> list[ArmLabel]:
    """Label of each frame of a recording, in the recording's order.

    A missing column counts as zero, because recordings omit the axes that they never move. A move counts as executed unless the audit's
    file contradicts.

    Parameters
    ----------
    experiment : ExperimentSpec, optional
        Experiment of the recording. The columns of all poses that it varies must be present.

    Raises
    ------
    FrameError
        If there is no table, if it has no column of a pose or lacks one that the experiment varies, or if a cell of a pose or move is not a
        number.
    """
    if not any(name in recording.labels for name in LABELS[:6]):
        found = recording.labels_found()
        raise FrameError(f"{recording.path}: no labels pose_1..6 ({found}); targets.csv with them is expected beside the frames")
    varied = [] if experiment is None else [name for name, (low, high) in experiment.pose.model_dump().items() if high > low]
    if experiment is not None and (missing := [name for name in varied if name not in recording.labels]):
        raise FrameError(
            f"{recording.path}: no label {', '.join(missing)}, which the experiment {experiment.name} varies ({recording.labels_found()}); "
            "add the column, or give the experiment that the frames were recorded with (`experiment`)"
        )
    none = np.zeros(len(recording))
    values = {name: numbers(recording.labels[name]) if name in recording.labels else none for name in LABELS}
    table = np.column_stack(list(values.values()))
    odd = ~np.isfinite(table).all(axis=1)
    if odd.any():
        shown = ", ".join(recording.names[k] for k in np.flatnonzero(odd)[:3])
        raise FrameError(f"{recording.path}: rows without a number in a pose or move ({shown}); repair or remove them")
    if experiment is not None and (fixed := _varied_beyond(experiment, values)):
        recording.problems.append(
            f"{', '.join(fixed)} varies in the table, and not in the experiment {experiment.name}: what is simulated by this experiment "
            "lacks it; give the experiment that the frames were recorded with, or add the range to it"
        )
    executed = read_executed(Path(recording.path), recording.names, recording.problems)
    done = [executed.get(name, 1.0) > 0.5 for name in recording.names]
    return [ArmLabel(*row) for row in zip(table[:, :6], table[:, 6:], done, strict=True)]


def as_executed(pose: np.ndarray, move: np.ndarray, executed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the arm stood, and the move that it had made, each (K, 6), by the labels' poses and moves (K, 6).

    ``executed`` (K,) is 1 if the move was executed, 0 if it was not. Of an estimate between them, this share of the move counts.
    """
    done = executed[:, None]
    return pose - np.where(done < 1, (1 - done) * move, 0.0), np.where(done > 0, done * move, 0.0)  # a move may be unknown (NaN)


def poses_and_moves(labels: Sequence[ArmLabel]) -> tuple[np.ndarray, np.ndarray]:
    """Where the arm stood at each label, and the move that it had made, each (K, 6) (see ``as_executed``)."""
    pose, move = (np.array([getattr(label, kind) for label in labels], float).reshape(-1, 6) for kind in ("pose", "move"))
    return as_executed(pose, move, np.array([label.executed for label in labels], float))


def _varied_beyond(experiment: ExperimentSpec, values: dict[str, np.ndarray]) -> list[str]:
    """Names of the labels that vary in a table (``values``: (M,) for each label), although the experiment keeps them constant."""
    ranges = experiment.ranges()
    return [name for name, each in values.items() if ranges[name][0] == ranges[name][1] and np.ptp(each) > HELD]


def plate_slope(rig: RigSpec | None) -> float:
    """Change of depth per mm across on the twin's plate, mm/mm; 0 without a rig. It applies to labels of simulated contacts.

    A move across decreases the depth by this value per mm. A move that the label contains, but that was not executed, increases it.
    """
    return float(np.tan(np.radians(rig.plate_tilt_deg))) if rig else 0.0


def label_slope(rig: RigSpec | None) -> float:
    """Change of depth per mm across for labels of recordings, mm/mm (see ``plate_slope``).

    It is the measured value (``RigSpec.label_depth_per_move``), or the slope of the twin's plate if there is none.
    """
    return plate_slope(rig) if rig is None or rig.label_depth_per_move is None else rig.label_depth_per_move


def read_executed(folder: Path, names: Sequence[str], problems: list[str]) -> dict[str, float]:
    """Whether the move of each frame was executed, from the audit's file beside the table.

    The file has the same format as the table: any of its separators and encodings, and frames' names in any case, with or without a path.

    Parameters
    ----------
    folder : Path
    names : sequence of str
        Names of the frames.
    problems : list of str
        The function adds messages about rows that it does not use and about frames without a row.

    Returns
    -------
    dict of str to float
        By frame's name: 1 for executed, 0 for not executed, or an estimate between them. Empty without such a file.
    """
    for name in EXECUTED_FILES:
        path = folder / name
        if not os.path.lexists(path):
            continue
        if not path.is_file():
            problems.append(f"{name}: not a regular file; {NOT_USED}")
            continue
        table = read_table(path, problems, otherwise=NOT_USED)
        if table is None:
            continue
        column = next((cells for key, cells in table.columns.items() if key.casefold() in EXECUTED_COLUMNS), None)
        if column is None:
            problems.append(f"{name}: no column {' or '.join(EXECUTED_COLUMNS)}; {NOT_USED}")
            continue
        return _pair_shares(name, table.name_lists[0], [_share(cell) for cell in column], names, problems)
    return {}


def _pair_shares(file: str, listed: list[str], shares: list[float], names: Sequence[str], problems: list[str]) -> dict[str, float]:
    """``shares`` by frame's name. Messages about rows that do not fit are added to ``problems``."""
    pictures, loose, doubled, missing = pair_rows(listed, [Path(name) for name in names])
    found = {picture.name: shares[row] for row, picture in pictures.items()}
    same = {bare_name(name): name for name in found}
    contradicting = [row for row in doubled if shares[row] != found.get(same.get(bare_name(listed[row]), ""))]
    for row in contradicting:
        found.pop(same.get(bare_name(listed[row]), ""), None)
    unreadable = [row for row, share in enumerate(shares) if np.isnan(share)]
    odd = {
        "rows without a number from 0 to 1, true or false, or yes or no, not used": unreadable,
        "rows against an earlier row of the same frame, neither used": contradicting,
        "rows for no frame here": missing,
        "rows for a frame with another suffix or case": loose,
        "rows like an earlier row": [row for row in doubled if row not in contradicting],
    }
    problems += [f"{file}: {describe_count(what, [listed[k] for k in rows])}" for what, rows in odd.items() if rows]
    known = {name: share for name, share in found.items() if not np.isnan(share)}
    if without := [name for name in names if name not in known]:
        problems.append(f"{file}: {describe_count('frames without a usable row, counted as executed', without)}")
    return known


def _share(cell: str) -> float:
    """Value of a cell from 0 (not executed) to 1 (executed); NaN if the cell is not such a value."""
    text = cell.strip().casefold()
    share = float(numbers(np.array([{"true": "1", "yes": "1", "false": "0", "no": "0"}.get(text, text)]))[0])
    return share if 0 <= share <= 1 else float("nan")
