"""What a row of a recording's table means: where the arm was sent, and whether it had made its move when the frame was taken.

In the published Tac-VGNN recordings (Apache-2.0) the shear move had not been executed in about a third of the frames when the
frame was taken. An audit writes which ones into a file beside the table; without that file every move counts as executed.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.rig import RigSpec
from twin.errors import FrameError
from twin.frames import Recording

EXECUTED_FILES = ("labels_corrected.csv", "move_executed.csv")  # in the order in which they are looked for
EXECUTED_COLUMNS = ("executed", "executed_estimate")


@dataclass(frozen=True)
class ArmLabel:
    """One contact as a recording's table gives it.

    Attributes
    ----------
    pose, move : (6,) float
        x, y, z in mm and Rx, Ry, Rz in deg; the pose is the one after the move.
    executed : bool
        Whether the move had been made when the frame was taken.
    """

    pose: np.ndarray
    move: np.ndarray
    executed: bool = True


def read_arm_labels(recording: Recording) -> list[ArmLabel]:
    """Label of each of the recording's frames, in its order.

    A column that is missing counts as zero, because recordings leave out what they never move. A move counts as executed
    unless a file says otherwise.

    Raises
    ------
    FrameError
        There is no table, it has no pose, or a cell of a pose or move holds no number.
    """
    columns = {
        kind: [(axis, recording.labels[f"{kind}_{axis}"]) for axis in range(1, 7) if f"{kind}_{axis}" in recording.labels]
        for kind in ("pose", "move")
    }
    if not columns["pose"]:
        found = ", ".join(recording.labels) or "no table"
        raise FrameError(f"{recording.path}: no labels pose_1..6 (found {found}); targets.csv with them is expected beside the frames")
    values = {kind: np.zeros((len(recording), 6)) for kind in columns}
    for kind, named in columns.items():
        for axis, cells in named:
            values[kind][:, axis - 1] = cells if cells.dtype.kind == "f" else np.nan
    odd = ~np.isfinite(np.hstack([values["pose"], values["move"]])).all(axis=1)
    if odd.any():
        names = [recording.names[k] for k in np.flatnonzero(odd)[:3]]
        raise FrameError(f"{recording.path}: {odd.sum()} rows hold no number in a pose or move ({', '.join(names)}); mend or remove them")
    executed = read_executed(Path(recording.path), recording.problems)
    done = [executed.get(name, 1.0) > 0.5 for name in recording.names]
    return [ArmLabel(*row) for row in zip(values["pose"], values["move"], done, strict=True)]


def plate_slope(rig: RigSpec | None) -> float:
    """Depth gained for each mm across on the twin's plate, mm/mm; 0 without a rig. It holds for labels of simulated contacts."""
    return float(np.tan(np.radians(rig.plate_tilt_deg))) if rig else 0.0


def label_slope(rig: RigSpec | None) -> float:
    """The same for labels of recordings: what was measured (``RigSpec.label_depth_per_move``), or else the plate's slope."""
    return plate_slope(rig) if rig is None or rig.label_depth_per_move is None else rig.label_depth_per_move


def read_executed(folder: Path, problems: list[str]) -> dict[str, float]:
    """Whether each frame's move was executed (1 or 0, or an estimate between), by image name, from the audit's file beside the table.

    Empty without such a file. What is wrong with a file is added to ``problems``.
    """
    for name in EXECUTED_FILES:
        path = folder / name
        if not path.is_file():
            continue
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            header = reader.fieldnames or ()
            column = next((c for c in EXECUTED_COLUMNS if c in header), None)
            if column is None or "image_name" not in header:
                problems.append(f"{name}: no columns image_name and {EXECUTED_COLUMNS[0]}; not used")
                continue
            return {row["image_name"]: value for row in reader if 0 <= (value := _number(row[column])) <= 1}
    return {}


def _number(cell: str | None) -> float:
    """A cell as a number; NaN where it holds none."""
    try:
        return float(cell) if cell is not None else float("nan")
    except ValueError:
        return float("nan")
