"""Pose labels of a recording, and what of them was really executed.

In the published Tac-VGNN recordings the shear move had not been executed in about a third of the frames when the frame
was taken; there the true angle is ``pose_6 - move_6`` and both shears are zero. Depth then differs by the plate's slight
tilt, which is left as it is here (0.04 mm at most).
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.targets import read_executed
from twin.errors import FrameError


@dataclass(frozen=True)
class SurfaceLabels:
    """Labels of a flat-surface tap with shear, one row a frame.

    Attributes
    ----------
    image_name : (M,) str
    depth_mm : (M,) float
        ``pose_2``: 0 is the deepest.
    angle_deg : (M,) float
        Rotation about the vertical, corrected where the move was not executed.
    shear_mm, shear_deg : (M,) float
        Executed shear (0 where it was not).
    """

    image_name: np.ndarray
    depth_mm: np.ndarray
    angle_deg: np.ndarray
    shear_mm: np.ndarray
    shear_deg: np.ndarray


def read_surface_labels(folder: Path) -> SurfaceLabels:
    """Read ``targets.csv`` of a flat-surface recording, and ``move_executed.csv`` beside it if there is one.

    Raises
    ------
    FrameError
        If ``targets.csv`` or one of its columns is missing.
    """
    rows, executed = published_rows(folder)
    column = {key: np.array([float(row[key]) for row in rows]) for key in ("pose_2", "pose_6", "move_1", "move_6")}
    return SurfaceLabels(
        image_name=np.array([row["image_name"] for row in rows]),
        depth_mm=column["pose_2"],
        angle_deg=column["pose_6"] - (1 - executed) * column["move_6"],
        shear_mm=executed * column["move_1"],
        shear_deg=executed * column["move_6"],
    )


def published_rows(folder: Path) -> tuple[list[dict], np.ndarray]:
    """Rows of ``targets.csv`` as published, and how likely each move was executed (M,): 1 without ``move_executed.csv``.

    Raises
    ------
    FrameError
        If ``targets.csv`` or one of its columns is missing.
    """
    rows = _read_rows(folder / "targets.csv", ("image_name", "pose_2", "pose_6", "move_1", "move_6"))
    executed_of = read_executed(folder, [])
    executed = np.array([executed_of.get(row["image_name"], 1.0) for row in rows])
    return rows, executed


def _read_rows(path: Path, columns: tuple[str, ...]) -> list[dict]:
    if not path.is_file():
        raise FrameError(f"{path}: no such file; a labelled recording has it beside its images")
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        missing = [name for name in columns if name not in (reader.fieldnames or ())]
        if missing:
            raise FrameError(f"{path}: column {', '.join(missing)} is missing; found {', '.join(reader.fieldnames or ())}")
        return list(reader)
