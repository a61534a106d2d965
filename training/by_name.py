"""Several trained models under the names that results give them."""

from collections.abc import Sequence
from pathlib import Path

from training.estimator import PoseEstimator


def load_by_name(runs: Sequence[Path]) -> dict[str, PoseEstimator]:
    """Models by the names of their folders, or by their whole paths where two folders are called alike.

    Raises
    ------
    TrainingError
        A folder holds no run.
    """
    names = [run.name for run in runs]
    if len(set(names)) < len(names):
        names = [str(run) for run in runs]
    return {name: PoseEstimator.load(run) for name, run in zip(names, runs, strict=True)}
