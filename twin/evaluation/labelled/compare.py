"""Pin errors of the twin on labelled frames: without any fit, and with an individual friction for each frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.errors import ContactError
from twin.evaluation.labelled.model import ContactModel, MeasuredFrames
from twin.progress import Step, unheard
from twin.rig.labels import poses_and_moves

FRICTIONS = (0.0, 0.15, 0.25, 0.32, 0.4, 0.5, 0.65, 1.0, 2.0)
"""Coefficients of friction among which a frame's individual friction is chosen."""
BINS = 4
"""Number of bins of a measure in the table of mean errors."""
MEASURES = {"depth_mm": "depth, mm", "angle_deg": "turn, deg", "shear_mm": "shear, mm"}
"""Measures by which the errors are tabled, and their titles."""


@dataclass(frozen=True)
class Comparison:
    """Simulated and recorded pins of M frames with N pins.

    Attributes
    ----------
    measured : MeasuredFrames
    simulated_px : (M, N, 2) float
        NaN if the contact failed.
    error_px : (M,) float
        Mean error over the pins; NaN if the contact failed.
    executed : (M,) bool
        Whether the arm executed the frame's move.
    by : dict of str to (M,) float
        ``depth_mm`` (the label along the approach), ``angle_deg`` (size of all turns), ``shear_mm`` (size of the executed move).
    friction, friction_error_px : (M,) float
        Individual friction of a frame, and the error with it; NaN for frames for which it was not fitted.
    failures : dict of str to str
        Reasons of failed contacts, by image name.
    """

    measured: MeasuredFrames
    simulated_px: np.ndarray
    error_px: np.ndarray
    executed: np.ndarray
    by: dict[str, np.ndarray]
    friction: np.ndarray
    friction_error_px: np.ndarray
    failures: dict[str, str]


def compare(model: ContactModel, measured: MeasuredFrames, *, friction_frames: int = 0, progress: Step = unheard) -> Comparison:
    """Simulate every frame's contact, and fit an individual friction to some frames.

    ``friction_frames`` is the number of frames whose friction is fitted. They are spread evenly over the frames with an executed move.
    """
    executed = np.array([label.executed for label in measured.labels])
    moved = np.flatnonzero(executed)
    sought = moved[np.linspace(0, len(moved) - 1, min(friction_frames, len(moved))).astype(int)]
    total, done = len(measured) + len(sought) * len(FRICTIONS), 0
    simulated, failures = np.full(measured.pins_px.shape, np.nan), {}

    def simulate(row: int, friction: float | None = None) -> np.ndarray:
        nonlocal done
        done += 1
        progress(done, total)
        return measured.no_contact_px + model.displacement_px(measured.labels[row], friction)

    for row, name in enumerate(measured.names):
        try:
            simulated[row] = simulate(row)
        except ContactError as failure:
            failures[name] = str(failure)
    errors, best, best_error = np.full((3, len(measured)), np.nan)
    solved = ~np.isnan(simulated[:, 0, 0])
    errors[solved] = pin_errors(simulated[solved], measured.pins_px[solved])
    best[sought], best_error[sought] = model.rig.friction, errors[sought]
    for row in sought.tolist():
        for friction in FRICTIONS:
            try:
                error = float(pin_errors(simulate(row, friction), measured.pins_px[row]))
            except ContactError:
                continue
            if not error >= best_error[row]:  # also true if the contact failed with the rig's friction (NaN)
                best[row], best_error[row] = friction, error
    axis, (poses, moves) = model.experiment.axis, poses_and_moves(measured.labels)
    depth, across = poses[:, axis], np.delete(moves[:, :3], axis, axis=1)
    by = {"depth_mm": depth, "angle_deg": np.linalg.norm(poses[:, 3:], axis=1), "shear_mm": np.linalg.norm(across, axis=1)}
    return Comparison(measured, simulated, errors, executed, by, best, best_error, failures)


def table_of(found: Comparison) -> list[dict]:
    """Mean errors of executed, not executed and all moves: ``group``, ``frames``, ``error_px`` and ``by`` each measure."""
    rows = []
    for group, chosen in (("move executed", found.executed), ("move not executed", ~found.executed), ("all", np.ones_like(found.executed))):
        solved = chosen & np.isfinite(found.error_px)
        if not solved.any():
            continue
        by = {}
        for key, values in found.by.items():
            edges = np.linspace(values.min(), values.max(), BINS + 1).tolist()
            if edges[0] < edges[-1]:
                by[key] = {"edges": edges, "means": binned_means(found.error_px[solved], values[solved], edges).tolist()}
        rows.append({"group": group, "frames": int(solved.sum()), "error_px": float(found.error_px[solved].mean()), "by": by})
    return rows


def pin_errors(simulated_px: np.ndarray, measured_px: np.ndarray) -> np.ndarray:
    """Mean distance of the pins for each frame, (..., M), from places (..., M, N, 2). Lost pins (NaN) are ignored."""
    return np.nanmean(np.linalg.norm(simulated_px - measured_px, axis=-1), axis=-1)


def binned_means(values: np.ndarray, by: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    """Mean of the values whose ``by`` is in each bin (the last bin includes its upper edge); NaN for an empty bin."""
    where = np.clip(np.searchsorted(edges, by, side="right") - 1, 0, len(edges) - 2)
    return np.array([values[where == k].mean() if (where == k).any() else np.nan for k in range(len(edges) - 1)])
