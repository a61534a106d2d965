"""Make one estimator of several kinds of contact of a sensor from finished runs: the folder that ``ContactEstimator.load`` reads.

The shipped models of several kinds (``training/weights/ur5-331/contacts``) were made with ``put_together``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import nn

from training.data.dataset import Dataset
from training.data.label_code import label_error
from training.errors import TrainingError
from training.estimate.contact_estimator import CONTACTS, FILE, KINDS, ContactEstimator, Contacts, DisplacementModes, moved_of
from training.estimate.estimator import PoseEstimator
from training.runs.assemble import conformal_quantile
from training.runs.run_files import pack
from twin.store import Layers, layers_to, write_json, writes

COMMON_MODES = 60
"""Number of modes of the displacements of all kinds together, which the network uses."""
UNITS, EPOCHS, BATCH, RATE, DECAY = 64, 30, 128, 3e-3, 1e-3
"""Training of the network: units, epochs, batch, learning rate, weight decay."""
LEAST_DEVIATION = 1e-6
"""Least standard deviation of a mode relative to the largest one. Smaller modes are rounding errors."""


def fit_modes(moved: np.ndarray, most: int) -> DisplacementModes:
    """The first modes of displacements (M, N, 2), at most ``most``."""
    flat = moved.reshape(len(moved), -1)
    mean = flat.mean(axis=0)
    square, direction = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    deviation = np.sqrt(np.maximum(square[::-1][:most], 0))
    keep = deviation > LEAST_DEVIATION * deviation[0]
    return DisplacementModes(mean, direction[:, ::-1][:, :most][:, keep] / deviation[keep])


def fit_contacts(frames: Mapping[str, Sequence[Dataset]], *, seed: int) -> Contacts:
    """Learn to classify kinds of contact, each given by one or more data sets of one sensor.

    Raises
    ------
    TrainingError
        There are fewer than two kinds.
    """
    if len(frames) < 2:
        raise TrainingError("to distinguish kinds of contact, frames of at least two are needed")
    moved = {name: np.concatenate([moved_of(each.pins) for each in frames[name]]) for name in sorted(frames)}
    together = np.concatenate(list(moved.values()))
    modes = fit_modes(together, COMMON_MODES)
    right = np.repeat(np.arange(len(moved)), [len(each) for each in moved.values()])
    return Contacts(tuple(moved), modes, _layers(modes(together), right, seed))


def _layers(seen: np.ndarray, right: np.ndarray, seed: int) -> Layers:
    """Layers of a network trained to classify the kind (M,), given as numbers, from modes (M, K)."""
    generator = torch.Generator().manual_seed(seed)
    sizes = [seen.shape[1], UNITS, UNITS, int(right.max()) + 1]
    layers = [nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
    for layer in layers:
        nn.init.normal_(layer.weight, std=(2 / layer.in_features) ** 0.5, generator=generator)
        nn.init.zeros_(layer.bias)
    network = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
    x, y = torch.from_numpy(seen.astype(np.float32)), torch.from_numpy(right)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS * -(-len(x) // BATCH))
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(x), generator=generator).split(BATCH):
            optimiser.zero_grad()
            nn.functional.cross_entropy(network(x[chosen]), y[chosen]).backward()
            optimiser.step()
            schedule.step()
    return tuple((layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers)


def write_contacts(path: Path, contacts: Contacts) -> None:
    """Write contacts in the form that ``read_contacts`` reads: components in half precision."""
    arrays = {"modes.mean": contacts.modes.mean, "modes.components": contacts.modes.components, **layers_to(contacts.layers)}
    half = {key: array.astype(np.float16 if key == "modes.components" else np.float32) for key, array in arrays.items()}
    FILE.write(path, half, {"kinds": list(contacts.kinds)})


@dataclass(frozen=True)
class KindOfContact:
    """A kind of contact, as input of ``put_together``.

    Attributes
    ----------
    model : str
        Name of the run that estimates it.
    frames : sequence of Dataset
        Frames of this kind, on which the classifier is trained. Give the training frames of the run.
    intervals : dict of str to array
        The run's interval quantiles for this kind, from frames that it did not learn from (``intervals_on``). If empty, the run's own
        intervals are used.
    """

    model: str
    frames: Sequence[Dataset]
    intervals: Mapping[str, np.ndarray] = field(default_factory=dict)


@writes(CONTACTS, KINDS)
def put_together(runs: Mapping[str, Path], kinds: Mapping[str, KindOfContact], out: Path, *, seed: int = 0) -> ContactEstimator:
    """Make one estimator of several kinds of contact, and write it to a folder.

    Parameters
    ----------
    runs : dict of str to Path
        Finished runs by name; each must have a small copy (``training.runs.run_files.pack``).
    kinds : dict of str to KindOfContact

    Raises
    ------
    TrainingError
        A run has no small copy, or there are too few frames or kinds.
    """
    contacts = fit_contacts({name: kind.frames for name, kind in kinds.items()}, seed=seed)
    for name, run in runs.items():
        pack(run, out / name)
    write_contacts(out / CONTACTS, contacts)
    said: dict[str, dict[str, object]] = {}
    for name, kind in kinds.items():
        said[name] = {"model": kind.model} | {key: np.asarray(value).tolist() for key, value in kind.intervals.items()}
    write_json(out / KINDS, said)
    return ContactEstimator.load(out)


def intervals_on(run: Path, data: Dataset, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Interval quantiles of a finished run, by their names in ``weights.pt``, that contain 90 % of the labels of some rows.

    Give rows from which the run did not learn. ``widen_intervals`` stores the quantiles.
    """
    estimator = PoseEstimator.load(run)
    made, targets = estimator.predict_rows(data, rows), data.targets.rows(rows)
    found = {}
    for name, key, half_width in (("quantile", estimator.config["labels"], made.half_width), ("raw_quantile", "raw", made.half_width_raw)):
        ratio = np.abs(label_error(made.mean, getattr(targets, key), targets.units)) / half_width
        found[name] = getattr(estimator.ensemble, name) * conformal_quantile(ratio)
    return found
