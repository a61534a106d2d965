"""Loads trained models: by run, by sensor, several at once."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.runs.run_files import CONFIG, DOMAIN, TENSORS, WEIGHTS, folder_of, shipped_names
from twin.store import fingerprint


def models_by_sensor(run: str | Path | None = None, first: str = "") -> Callable[[str], PoseEstimator | None]:
    """A function from a sensor's name to a trained model of it: that of a run, else the shipped one, else None.

    After the first model is loaded, the networks of this process run in one thread: for networks of this size, more threads cost more time
    than they save.

    Parameters
    ----------
    run : path, optional
    first : str
        Name of the sensor to which the run must belong; "" for any.

    Raises
    ------
    TrainingError
        The run holds no trained model, or one of another sensor than ``first``.
    """
    given = None if run is None else PoseEstimator.load(run)
    if given is not None and first not in ("", given.sensor.name):
        raise TrainingError(f"{run}: a model of '{given.sensor.name}', not of '{first}'; give its --sensor, or another --model")

    def model_of(sensor: str) -> PoseEstimator | None:
        torch.set_num_threads(1)
        if given is not None and given.sensor.name == sensor:
            return given
        return PoseEstimator.load(sensor) if sensor in shipped_names() else None

    return model_of


def digest_of(run: str | Path) -> str:
    """Digest of everything that affects a model's estimates: its weights, its configuration, and the code that runs it."""
    folder, digest = folder_of(run), hashlib.sha256(fingerprint(PoseEstimator).encode())
    for name in (CONFIG, WEIGHTS, TENSORS, DOMAIN):
        if (folder / name).is_file():
            digest.update(name.encode() + hashlib.sha256((folder / name).read_bytes()).digest())
    return digest.hexdigest()


def load_with_history(run: str | Path) -> PoseEstimator:
    """A trained model for consecutive frames: ``PoseEstimator.load`` and ``PoseEstimator.remembering``.

    Raises
    ------
    TrainingError
        The folder holds no run.
    """
    return PoseEstimator.load(run).with_history()


def load_by_name(runs: Sequence[Path]) -> dict[str, PoseEstimator]:
    """Load several trained models. The keys are the names of their folders, or their whole paths if two folders have the same name.

    Raises
    ------
    TrainingError
        A folder holds no run.
    """
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run) for run in runs]
    return {name: PoseEstimator.load(run) for name, run in zip(names, runs, strict=True)}
