"""Classification of a frame's contact: one of the kinds that a sensor's models were trained on (plate, edge, ...).

Kinds are distinguished by a small network on the modes of the displacements. Whether the frame shows a contact of this kind at all is for
the domain of the kind's model to say (``training.estimate.domain``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import nn

from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.errors import TrainingError
from training.runs.run_files import AGAIN
from twin.store import ArrayFile, Layers, layers_from, layers_to

CONTACTS = "contacts.safetensors"
FILE = ArrayFile(
    "file of kinds of contact", "training.estimate.contact_estimator.put_together", version=1, error=TrainingError, again=AGAIN
)
# Number of modes of the displacements of all kinds together, which the network uses.
COMMON_MODES = 60
# Training of the network: units, epochs, batch, learning rate, weight decay.
UNITS, EPOCHS, BATCH, RATE, DECAY = 64, 30, 128, 3e-3, 1e-3
# Least standard deviation of a mode relative to the largest one. Smaller modes are rounding errors.
LEAST_DEVIATION = 1e-6


@dataclass(frozen=True)
class DisplacementModes:
    """Principal components of displacements (M, N, 2), each of standard deviation 1: ``mean`` (2 N,) and ``components`` (2 N, K)."""

    mean: np.ndarray
    components: np.ndarray

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        """(M, K) amplitudes."""
        return (moved.reshape(len(moved), -1) - self.mean) @ self.components

    @classmethod
    def fit_modes(cls, moved: np.ndarray, most: int) -> "DisplacementModes":
        """The first modes of displacements, at most ``most``."""
        flat = moved.reshape(len(moved), -1)
        mean = flat.mean(axis=0)
        square, direction = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
        deviation = np.sqrt(np.maximum(square[::-1][:most], 0))
        keep = deviation > LEAST_DEVIATION * deviation[0]
        return cls(mean, direction[:, ::-1][:, :most][:, keep] / deviation[keep])


@dataclass(frozen=True)
class Contacts:
    """The known kinds of contact of one sensor.

    Attributes
    ----------
    kinds : tuple of str
    modes : Modes
        Modes of all kinds together.
    layers : tuple of (weights, offset)
        The network that distinguishes the kinds.
    """

    kinds: tuple[str, ...]
    modes: DisplacementModes
    layers: Layers = field(repr=False)

    def likeliest(self, pins: PinTable, among: Sequence[str]) -> np.ndarray:
        """(M,) str: the most probable of some kinds for each valid frame of a table."""
        names = [name for name in self.kinds if name in among]
        columns = [self.kinds.index(name) for name in names]
        return np.array(names)[self._scores(moved_of(pins))[:, columns].argmax(axis=1)]

    def _scores(self, moved: np.ndarray) -> np.ndarray:
        h = self.modes(moved)
        for weight, bias in self.layers[:-1]:
            h = np.maximum(h @ weight.T + bias, 0)
        weight, bias = self.layers[-1]
        return h @ weight.T + bias


def moved_of(pins: PinTable) -> np.ndarray:
    """(M, N, 2) displacements from rest, in mean rest spacings."""
    return (pins.nodes_px - pins.reference.pins_px) / pins.reference.spacing_px.mean()


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
    modes = DisplacementModes.fit_modes(together, COMMON_MODES)
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
    steps = EPOCHS * -(-len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(x), generator=generator).split(BATCH):
            loss = nn.functional.cross_entropy(network(x[chosen]), y[chosen])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return tuple((layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers)


def write_contacts(path: Path, contacts: Contacts) -> None:
    """Write contacts in the form that ``read_contacts`` reads: components in half precision."""
    arrays = {"modes.mean": contacts.modes.mean, "modes.components": contacts.modes.components, **layers_to(contacts.layers)}
    half = {key: array.astype(np.float16 if key == "modes.components" else np.float32) for key, array in arrays.items()}
    FILE.write(path, half, {"kinds": list(contacts.kinds)})


def read_contacts(path: Path) -> Contacts:
    """Read the contacts that ``write_contacts`` wrote, also with version 1.0.0.

    Raises
    ------
    TrainingError
        The file can't be read, or is damaged.
    """
    with FILE.open_arrays(path) as (about, single):
        found = {key: array.astype(float) for key, array in single.items()}
        kinds = about.get("kinds") or sorted({key.split(".")[1] for key in found if key.startswith("kinds.")})
        return Contacts(tuple(kinds), DisplacementModes(found["modes.mean"], found["modes.components"]), layers_from(found))
