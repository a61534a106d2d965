"""Settings of a training run, and what they choose of a data set."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from training.data.dataset import Dataset, split_rows
from training.errors import TrainingError
from training.models.part import Recipe

MOST_SEED = 2**32 - 1  # largest seed. PyTorch takes seeds of 64 bits, and each network has its own seed


@dataclass(frozen=True)
class RunConfig:
    """Settings of a run.

    Attributes
    ----------
    model : str
    recipe : Recipe
    labels : {"corrected", "raw"}
    seed : int
        Seed of weights and order. It also shifts which fold is held out.
    split : int or None
        Seed of the validation fifth that is kept out of training; None trains on all rows.
    helpers : tuple of str
        Auxiliary label columns, which are trained only because they improve the others; they have less weight.
    size : dict
        Sizes of the network that differ from the model's own.
    labelled : dict
        ``identity_of`` the real frames from which the errors of simulated pins were fitted, and their ``image_names``; empty for other
        runs.

    Raises
    ------
    TrainingError
        A seed is out of range.
    """

    model: str
    recipe: Recipe
    labels: str = "corrected"
    seed: int = 0
    split: int | None = 0
    helpers: tuple[str, ...] = ()
    size: dict[str, int] = field(default_factory=dict)
    labelled: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, seed in (("seed", self.seed), ("split", self.split)):
            if seed is not None and not 0 <= seed <= MOST_SEED:
                raise TrainingError(f"--{name} {seed}: give a whole number from 0 to {MOST_SEED}")


def training_rows(config: RunConfig, data: Dataset) -> np.ndarray:
    """Rows (m,) of a data set in order (``Dataset.in_order``) on which a run is trained."""
    return np.arange(len(data)) if config.split is None else split_rows(len(data), config.split, data.group)[0]


def training_labels(data: Dataset, config: RunConfig) -> np.ndarray:
    """Labels (M, K) of the kind that a run is trained on, mm and deg."""
    return data.targets.corrected if config.labels == "corrected" else data.targets.raw
