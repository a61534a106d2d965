"""Evaluation of a trained model on a recording: errors, intervals and leaks, as numbers, a table and pictures.

The second part measures robustness. Images are changed before the pipeline reads them, in ways that no contact causes: the camera is
displaced in a random direction, or pins are removed. The result is the increase of the errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import cv2
import numpy as np
import torch

from training.data.dataset import Dataset, split_rows
from training.data.label_code import label_error
from training.data.simulated import is_pins_only
from training.data.targets import ANGLE, DEPTH, TURN, Targets, limits_of
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.models.part import Prediction
from training.runs.config import rows_named
from twin.estimate import readable_labels
from twin.frames import evenly_read, open_recording
from twin.progress import Step, unheard
from twin.report.charts import new_figure, save_figure
from twin.report.page import write_table
from twin.rig.labels import EXECUTED_FILES
from twin.store import made_by, write_json
from twin.types import Form, Frame

# Edges of the bins for which errors are reported separately: depth pose_2, absolute angle pose_6, and absolute shear move_1.
DEPTH_EDGES_MM = (-4.0, -3.0, -2.0, -1.0, 0.0)
ANGLE_EDGES_DEG = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
SHEAR_EDGES_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
# Least move, mm or deg, of frames on which the probability of an executed move is evaluated. A smaller move hardly changes the frame.
LARGE_MOVE = 1.0
# Number of frames, spread evenly over the recording, whose time to a pose is measured.
TIMED_FRAMES = 100
# Least number of frames of the leak check. Fewer frames give no reliable slope.
LEAK_FRAMES = 3
# Share by which a changed image is larger or smaller.
SCALE_CHANGE = 0.01
# Shift of a changed image, px.
SHIFT_CHANGE_PX = 2.0
# Turn of a changed image, deg.
TURN_CHANGE_DEG = 1.0
# Number of pins that are erased from a changed image.
ERASED_PINS = 5
# Side of the square that is erased around a pin, in mean rest spacings. It is larger than the pin.
ERASED_MARGIN = 1.25


def rows_to_evaluate(estimator: PoseEstimator, data: Dataset, rows: str) -> np.ndarray:
    """Rows of a data set: with ``validation`` those that the run kept out of its training, found by their names; with ``all`` every row.

    Raises
    ------
    TrainingError
        The run kept no rows out, or the data set is not the one that it was trained on.
    """
    if rows == "all":
        return np.arange(len(data))
    split, known = estimator.config["split"], estimator.config["rows"]
    if split is None:
        raise TrainingError("the run was trained on all rows; give a recording it has not seen, and `rows` all")
    if "kept_out" in known:
        return rows_named(data, known["kept_out"])
    if known.get("usable") != len(data):
        raise TrainingError(
            f"the run was trained on part of {known.get('usable')} rows, this recording has {len(data)}; "
            "give `rows` all for a recording it has not seen"
        )
    return data.natural_order()[split_rows(len(data), split, data.in_order().group)[1]]


def measure_errors(made: Prediction, data: Dataset, rows: np.ndarray) -> dict:
    """Errors against raw and corrected labels, overall and binned, the intervals' coverage and the leak check."""
    targets = data.targets.rows(rows)
    found: dict = {"frames": len(rows), "without_prediction": int((~np.isfinite(made.mean)).any(axis=1).sum())}
    for kind in ("raw", "corrected"):
        truth = getattr(targets, kind)
        error = np.abs(label_error(np.clip(made.mean, *limits_of(targets.names)), truth, targets.units))
        half_width = made.half_width_raw if kind == "raw" else made.half_width
        inside = np.abs(label_error(made.mean, truth, targets.units)) <= half_width
        found[kind] = {}
        for name, off, covered, wide in zip(targets.names, error.T, inside.T, half_width.T, strict=True):
            means = {"mae": off.mean(), "median": np.median(off), "coverage_90": covered.mean(), "half_width_90": wide.mean()}
            found[kind][name] = {key: float(value) for key, value in means.items()}
        found[kind]["bins"] = _bins(error, targets)
    leak = leak_check(made.mean, targets)
    found["leak_slope"], found["leak_not_checked"] = leak.slope, leak.reason
    known = np.isfinite(targets.executed) & np.isfinite(made.executed) & (np.abs(targets.move).max(axis=1) > LARGE_MOVE)
    if known.any():
        found["executed_agreement"] = float(((made.executed > 0.5) == (targets.executed > 0.5))[known].mean())
    return found


@dataclass(frozen=True)
class Leak:
    """Check of whether a model estimates from the time of a frame instead of from its contact. Recordings are sorted by time.

    Attributes
    ----------
    slope : float or None
        Slope of (predicted - corrected angle) on ``move_6``, over the frames whose move was not executed. A model that reads the
        contact has 0. None if the check can't be made.
    reason : str
        Why the check can't be made; empty if it was made.
    """

    slope: float | None
    reason: str = ""


def leak_check(mean: np.ndarray, targets: Targets) -> Leak:
    """Make the leak check on predicted labels (M, K) of M frames with known targets."""
    if ANGLE not in targets.names:
        return Leak(None, f"it needs the angle label {ANGLE} and its {TURN}; the labels are {', '.join(targets.names)}")
    if not np.isfinite(targets.executed).any():
        return Leak(
            None, f"no file beside the table states which moves were executed ({', '.join(EXECUTED_FILES)}; 'twin audit' makes one)"
        )
    k = targets.names.index(ANGLE)
    turn, error = targets.move[:, 1], label_error(mean, targets.corrected, targets.units)[:, k]
    usable = (targets.executed < 0.5) & np.isfinite(turn) & np.isfinite(error)
    if usable.sum() < LEAK_FRAMES:
        return Leak(None, f"{usable.sum()} frames with a prediction and a move that was not executed; {LEAK_FRAMES} are needed")
    if np.ptp(turn[usable]) == 0:
        return Leak(None, f"{TURN} is the same in all frames whose move was not executed")
    return Leak(float(np.polyfit(turn[usable], error[usable], 1)[0]))


def _bins(error: np.ndarray, targets: Targets) -> dict[str, list[dict]]:
    """MAE of each label by depth, angle and shear, as ``{by: [{from, to, frames, label: mae, ...}]}``."""
    found: dict[str, list[dict]] = {}
    known = dict(zip(targets.names, targets.corrected.T, strict=True))
    axes = {"depth_mm": (DEPTH, DEPTH_EDGES_MM, False), "angle_deg": (ANGLE, ANGLE_EDGES_DEG, True)}
    values = {key: (known[name], edges, size) for key, (name, edges, size) in axes.items() if name in known}
    if np.isfinite(targets.move).all():
        done = np.where(np.isnan(targets.executed), 1.0, targets.executed)
        values["shear_mm"] = (done * targets.move[:, 0], SHEAR_EDGES_MM, True)
    for key, (value, edges, size) in values.items():
        where = np.digitize(np.abs(value) if size else value, edges[1:-1])
        found[key] = []
        for b in range(len(edges) - 1):
            inside = where == b
            means = error[inside].mean(axis=0) if inside.any() else np.full(error.shape[1], np.nan)
            row = {"from": edges[b], "to": edges[b + 1], "frames": int(inside.sum())}
            found[key].append(row | {name: None if np.isnan(m) else float(m) for name, m in zip(targets.names, means, strict=True)})
    return found


def time_frames(estimator: Callable[[Frame], object], data: Dataset) -> float | None:
    """Median ms from frame to pose, one frame at a time on one thread.

    None if the data set has no pictures, or comes from several recordings.
    """
    if len(data.folders) > 1 or is_pins_only(data.folder):
        return None
    recording = open_recording(data.folder, data.pins.sensor, data.pins.form)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        frames = evenly_read(recording, TIMED_FRAMES)
        estimator(frames[0])
        return 1e3 * float(np.median([timeit(partial(estimator, frame), number=1) for frame in frames]))
    finally:
        torch.set_num_threads(threads)


def write_evaluation(out: Path, made: Prediction, data: Dataset, rows: np.ndarray, metrics: dict, labels: str) -> list[Path]:
    """Write ``predictions.csv``, ``metrics.json`` and ``errors.png``. The true values in the table are the ``labels``: corrected or raw."""
    targets = data.targets.rows(rows)
    truth = getattr(targets, labels)
    half_width = made.half_width_raw if labels == "raw" else made.half_width
    told = [np.clip(each, *limits_of(targets.names)) for each in (made.mean, made.mean - half_width, made.mean + half_width)]
    parts = dict(zip(("true", "pred", "lo90", "hi90"), (truth, *told), strict=True))
    table = [
        {"image_name": data.pins.image_name[row]}
        | {f"{name}_{part}": float(values[m, k]) for k, name in enumerate(targets.names) for part, values in parts.items()}
        | {"executed_probability": f"{made.executed[m]:.4g}", "valid": int(np.isfinite(made.mean[m]).all())}
        for m, row in enumerate(rows)
    ]
    path = write_table(out / "predictions.csv", table)
    write_json(out / "metrics.json", metrics | {"made_by": made_by(__name__)})
    return [path, out / "metrics.json", _draw(out / "errors.png", made, truth, targets, labels)]


def _draw(path: Path, made: Prediction, truth: np.ndarray, targets: Targets, labels: str) -> Path:
    """Draw prediction and error against truth for every label, as in the paper's test figure."""
    count = len(targets.names)
    figure, axes = new_figure(count, 2, panel_inch=3.6)
    undone = np.nan_to_num(targets.executed, nan=1.0) < 0.5
    errors = label_error(np.clip(made.mean, *limits_of(targets.names)), truth, targets.units)
    for k, (name, unit) in enumerate(zip(readable_labels(targets.names), targets.units, strict=True)):
        error = errors[:, k]
        for chosen, colour, label in ((~undone, "#1f77b4", "move executed"), (undone, "#ff7f0e", "not executed")):
            near = truth[chosen, k] + error[chosen]  # a direction is drawn within half a turn of the truth
            axes[k].plot(truth[chosen, k], near, ".", color=colour, markersize=2, label=label)
            axes[count + k].plot(truth[chosen, k], error[chosen], ".", color=colour, markersize=2)
        axes[k].set(title=f"{name}: MAE {np.abs(error).mean():.3g} {unit} ({labels})", ylabel=f"predicted, {unit}")
        axes[count + k].set(xlabel=f"label, {unit}", ylabel=f"error, {unit}")
        axes[count + k].axhline(0, color="#888888", linewidth=0.6)
    axes[0].legend(markerscale=4)
    return save_figure(path, figure, dpi=110)


# A change of an image: ``change(image, rng, estimator)`` returns the changed image.
Change = Callable[[np.ndarray, np.random.Generator, PoseEstimator], np.ndarray]


def _similar(image: np.ndarray, *, scale: float = 1.0, turn_deg: float = 0.0, shift_px: float = 0.0, towards: float = 0.0) -> np.ndarray:
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, scale)
    matrix[:, 2] += shift_px * np.cos(towards), shift_px * np.sin(towards)
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR)


def erase_pins(image: np.ndarray, rng: np.random.Generator, estimator: PoseEstimator) -> np.ndarray:
    """The image with five pins erased, sampled at random from those that the pipeline finds."""
    seen = estimator.pipeline(Frame(image, estimator.form))
    found = np.flatnonzero(np.isfinite(seen.pins_px[:, 0]))
    half = ERASED_MARGIN * float(estimator.pipeline.reference.spacing_px.mean()) / 2
    image = image.copy()
    background = int(np.median(image)) if estimator.form == Form.RAW else 0
    for pin in rng.choice(found, min(ERASED_PINS, len(found)), replace=False):
        low, high = np.round(seen.pins_px[pin] + [[-half], [half]]).astype(int).tolist()
        cv2.rectangle(image, low, high, [background] * 3, cv2.FILLED)
    return image


# The changes. The sign, the direction and the pins are sampled at random.
CHANGES: dict[str, Change] = {
    "1 % scale": lambda image, rng, _: _similar(image, scale=1 + SCALE_CHANGE * rng.choice([-1, 1])),
    "2 px shift": lambda image, rng, _: _similar(image, shift_px=SHIFT_CHANGE_PX, towards=rng.uniform(0, 2 * np.pi)),
    "1 deg turn": lambda image, rng, _: _similar(image, turn_deg=TURN_CHANGE_DEG * rng.choice([-1.0, 1.0])),
    "5 pins erased": erase_pins,
}


def measure_changes(estimator: PoseEstimator, data: Dataset, rows: np.ndarray, *, progress: Step = unheard) -> list[dict[str, Any]]:
    """Errors against corrected labels of single frames, unchanged and under every change.

    Returns
    -------
    list of dict
        ``change``, ``frames``, ``not_valid``, and for every label ``<label>_mae`` (the mean absolute error) and ``<label>_more`` (its
        relative increase over the unchanged frames).

    Raises
    ------
    TrainingError
        The data set has no pictures.
    """
    if is_pins_only(data.folder):
        raise TrainingError(f"{data.folder}: a data set of pins has no pictures to change; render it, or evaluate without `robustness`")
    recording = open_recording(data.folder, data.pins.sensor, data.pins.form)
    place = {name: k for k, name in enumerate(recording.names)}
    changes: dict[str, Change] = {"none": lambda image, rng, estimator: image} | CHANGES
    rngs = {name: np.random.default_rng([0, k]) for k, name in enumerate(changes)}
    value = {name: np.full((len(rows), len(estimator.names)), np.nan) for name in changes}
    for m, row in enumerate(rows):
        frame = recording.read(place[data.pins.image_name[row]])
        for name, change in changes.items():
            image = change(frame.image, rngs[name], estimator)
            value[name][m] = estimator(Frame(image, frame.form, name=frame.name)).value
        progress(m + 1, len(rows))
    truth = data.targets.corrected[rows]
    found = []
    for name, said in value.items():
        valid = np.isfinite(said).all(axis=1)
        error, usual = (np.abs(label_error(made, truth, estimator.units))[valid].mean(axis=0) for made in (said, value["none"]))
        labels = {f"{label}_mae": float(error[k]) for k, label in enumerate(estimator.names)}
        labels |= {f"{label}_more": float(error[k] / usual[k] - 1) for k, label in enumerate(estimator.names)}
        found.append({"change": name, "frames": len(rows), "not_valid": int((~valid).sum())} | labels)
    return found
