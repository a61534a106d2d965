"""What a model loses when the picture changes in ways that are not the contact's: the camera sits otherwise, pins are gone.

Each change is made to the image itself, frame by frame and in a random direction, before the pipeline sees it.
"""

from collections.abc import Callable

import cv2
import numpy as np

from training.dataset import Dataset
from training.estimator import PoseEstimator
from training.recipes import TrainingError
from training.simulated import is_pins_only
from twin.recordings import open_recording
from twin.types import Form, Frame

ERASED_MARGIN = 1.25  # of a pin's spacing, the side of the square that is wiped out around it: more than the pin


def _similar(image: np.ndarray, *, scale: float = 1.0, turn_deg: float = 0.0, shift_px=(0.0, 0.0)) -> np.ndarray:
    height, width = image.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, scale)
    matrix[:, 2] += shift_px
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_LINEAR)


def scaled(image: np.ndarray, rng: np.random.Generator, estimator: PoseEstimator) -> np.ndarray:
    """One per cent larger or smaller."""
    return _similar(image, scale=1 + 0.01 * rng.choice([-1, 1]))


def shifted(image: np.ndarray, rng: np.random.Generator, estimator: PoseEstimator) -> np.ndarray:
    """Two px away, in any direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return _similar(image, shift_px=(2 * np.cos(angle), 2 * np.sin(angle)))


def turned(image: np.ndarray, rng: np.random.Generator, estimator: PoseEstimator) -> np.ndarray:
    """One degree, either way."""
    return _similar(image, turn_deg=rng.choice([-1.0, 1.0]))


def erased(image: np.ndarray, rng: np.random.Generator, estimator: PoseEstimator) -> np.ndarray:
    """Five of the pins that were found are wiped out."""
    seen = estimator.pipeline(Frame(image, estimator.form))
    found = np.flatnonzero(np.isfinite(seen.pins_px[:, 0]))
    half = ERASED_MARGIN * float(estimator.pipeline.reference.spacing_px.mean()) / 2
    image = image.copy()
    background = int(np.median(image)) if estimator.form == Form.RAW else 0
    for pin in rng.choice(found, min(5, len(found)), replace=False):
        low, high = np.maximum(np.round(seen.pins_px[pin] - half), 0).astype(int), np.round(seen.pins_px[pin] + half).astype(int)
        image[low[1] : high[1] + 1, low[0] : high[0] + 1] = background
    return image


CHANGES: dict[str, Callable] = {"1 % scale": scaled, "2 px shift": shifted, "1 deg turn": turned, "5 pins erased": erased}


def judge_changes(
    estimator: PoseEstimator, data: Dataset, rows: np.ndarray, *, seed: int = 0, progress: Callable | None = None
) -> list[dict]:
    """Errors against corrected labels of single frames as they are and under every change.

    Returns
    -------
    list of dict
        ``change``, ``frames``, ``not_valid``, and for every label ``<label>_mae`` and ``<label>_more``, the part by which the
        mean absolute error is larger than that of the same frames as they are.

    Raises
    ------
    TrainingError
        If the data set has no pictures.
    """
    if is_pins_only(data.folder):
        raise TrainingError(f"{data.folder}: a data set of pins has no pictures to change; render it, or judge without --robustness")
    recording = open_recording(data.folder, data.pins.sensor, data.pins.form)
    place = {name: k for k, name in enumerate(recording.names)}
    changes: dict = {"none": lambda image, rng, estimator: image} | CHANGES
    rngs = {name: np.random.default_rng([seed, k]) for k, name in enumerate(changes)}
    value = {name: np.full((len(rows), len(estimator.names)), np.nan) for name in changes}
    for m, row in enumerate(rows):
        frame = recording.read(place[data.pins.image_name[row]])
        for name, change in changes.items():
            image = change(frame.image, rngs[name], estimator)
            value[name][m] = estimator(Frame(image, frame.form, name=frame.name)).value
        if progress:
            progress(m + 1, len(rows))
    truth = data.targets.corrected[rows]
    found = []
    for name, said in value.items():
        valid = np.isfinite(said).all(axis=1)
        error, usual = np.abs(said - truth)[valid].mean(axis=0), np.abs(value["none"] - truth)[valid].mean(axis=0)
        labels = {f"{label}_mae": float(error[k]) for k, label in enumerate(estimator.names)}
        labels |= {f"{label}_more": float(error[k] / usual[k] - 1) for k, label in enumerate(estimator.names)}
        found.append({"change": name, "frames": len(rows), "not_valid": int((~valid).sum())} | labels)
    return found
