"""Classification of a frame's contact: one of the kinds that a sensor's models were trained on (plate, edge, ...), or none of them.

Kinds are distinguished by a small network on the modes of the displacements. A second test asks whether the frame is typical of its kind.
Within a kind, the first modes depend on pose, friction and path of a contact, and they determine the further modes. A polynomial that is
fitted to the kind's frames describes this dependence. A frame belongs to no kind if its further modes differ from the polynomial's, or if
its first modes are far from those of every known frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import torch
from torch import nn

from training.dataset import Dataset, split_rows
from training.pins import PinTable
from training.recipes import TrainingError
from training.run_files import AGAIN
from twin.store import ArrayFile, Layers, layers_from, layers_to

CONTACTS = "contacts.safetensors"
FILE = ArrayFile("file of kinds of contact", "training.contact_estimator.put_together", version=1, error=TrainingError, again=AGAIN)
# Number of modes of the displacements of all kinds together, which the network uses.
COMMON_MODES = 60
# Number of first modes of a kind, and number of all its modes that are used.
FREE_MODES, KIND_MODES = 12, 60
# Number of first modes whose third-order products are terms of the polynomial. Second-order products use all first modes.
CUBED = 6
# Penalty of the polynomial's fit, per frame, for modes of standard deviation 1.
RIDGE = 1e-3
# Most frames of a kind that are kept as known frames.
KNOWN = 2000
# Share of the frames left out of the fit that lie within their kind's limits.
TYPICAL = 0.99
# Ratio to the limits above which a frame belongs to no kind.
MARGIN = 1.15
# Training of the network: units, epochs, batch, learning rate, weight decay.
UNITS, EPOCHS, BATCH, RATE, DECAY = 64, 30, 128, 3e-3, 1e-3
# Least standard deviation of a mode relative to the largest one. Smaller modes are rounding errors.
LEAST_DEVIATION = 1e-6


@dataclass(frozen=True)
class Modes:
    """Principal components of displacements (M, N, 2), each of standard deviation 1: ``mean`` (2 N,) and ``components`` (2 N, K)."""

    mean: np.ndarray
    components: np.ndarray

    def __call__(self, moved: np.ndarray) -> np.ndarray:
        """(M, K) amplitudes."""
        return (moved.reshape(len(moved), -1) - self.mean) @ self.components

    @classmethod
    def fit(cls, moved: np.ndarray, most: int) -> "Modes":
        """The first modes of displacements, at most ``most``."""
        flat = moved.reshape(len(moved), -1)
        mean = flat.mean(axis=0)
        square, direction = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
        deviation = np.sqrt(np.maximum(square[::-1][:most], 0))
        keep = deviation > LEAST_DEVIATION * deviation[0]
        return cls(mean, direction[:, ::-1][:, :most][:, keep] / deviation[keep])


@dataclass(frozen=True)
class Kind:
    """Common properties of frames of one kind.

    Attributes
    ----------
    modes : Modes
    weight : (T, K - free) float
        Coefficients from the polynomial's terms to the further modes.
    usual : (K - free,) float
        Root mean square of the polynomial's residual.
    known : (n, free) float
        First modes of known frames.
    limits : (2,) float
        Limits of the further modes' misfit, and of the distance to the nearest known frame.
    """

    modes: Modes
    weight: np.ndarray
    usual: np.ndarray
    known: np.ndarray
    limits: np.ndarray

    def strangeness(self, moved: np.ndarray) -> np.ndarray:
        """(M,) dissimilarity of frames (M, N, 2) to this kind: at most 1 for typical frames."""
        return (self._measures(moved) / self.limits).max(axis=1)

    def _measures(self, moved: np.ndarray) -> np.ndarray:
        seen = self.modes(moved)
        free = self.known.shape[1]
        left = (seen[:, free:] - _terms(seen[:, :free]) @ self.weight) / self.usual
        first = seen[:, :free]
        square = (first**2).sum(axis=1)[:, None] + (self.known**2).sum(axis=1) - 2 * first @ self.known.T
        return np.column_stack([np.sqrt((left**2).mean(axis=1)), np.sqrt(np.maximum(square.min(axis=1), 0))])

    @classmethod
    def fit(cls, moved: np.ndarray, seed: int, group: np.ndarray | None = None) -> "Kind":
        """Fit the kind of displacements (M, N, 2). A fifth of them is left out of the fit and sets the limits.

        Parameters
        ----------
        group : (M,) int, optional
            Frames with the same value, such as the states of one contact, are either all fitted or all left out.

        Raises
        ------
        TrainingError
            There are too few frames, or too few pins.
        """
        if 2 * moved.shape[1] <= FREE_MODES:
            raise TrainingError(f"{moved.shape[1]} pins are too few to know a kind of contact by; {FREE_MODES // 2 + 1} are needed")
        fitted, held = split_rows(len(moved), seed, group)
        terms = _terms(np.zeros((1, FREE_MODES))).shape[1]
        if len(fitted) < 2 * terms:
            raise TrainingError(f"{len(moved)} frames are too few to know a kind of contact by; {2 * terms * 5 // 4} are needed")
        modes = Modes.fit(moved[fitted], KIND_MODES)
        if modes.components.shape[1] <= FREE_MODES:
            raise TrainingError(
                f"the frames of a kind of contact differ in {modes.components.shape[1]} ways, more than {FREE_MODES} are needed to know it "
                "by; give frames of more places, depths and moves"
            )
        seen = modes(moved[fitted])
        inputs = _terms(seen[:, :FREE_MODES])
        weight = np.linalg.solve(inputs.T @ inputs + RIDGE * len(inputs) * np.eye(terms), inputs.T @ seen[:, FREE_MODES:])
        usual = np.sqrt(((seen[:, FREE_MODES:] - inputs @ weight) ** 2).mean(axis=0))
        known = seen[np.random.default_rng(seed).permutation(len(seen))[:KNOWN], :FREE_MODES]
        kind = cls(modes, weight, usual, known, np.ones(2))
        return cls(modes, weight, usual, known, np.quantile(kind._measures(moved[held]), TYPICAL, axis=0))


def _terms(first: np.ndarray) -> np.ndarray:
    columns = [np.ones(len(first)), *first.T]
    columns += [first[:, i] * first[:, j] for i, j in combinations_with_replacement(range(first.shape[1]), 2)]
    columns += [first[:, list(each)].prod(axis=1) for each in combinations_with_replacement(range(min(CUBED, first.shape[1])), 3)]
    return np.column_stack(columns)


@dataclass(frozen=True)
class Contacts:
    """The known kinds of contact of one sensor.

    Attributes
    ----------
    kinds : dict of str to Kind
    modes : Modes
        Modes of all kinds together.
    layers : tuple of (weights, offset)
        The network that distinguishes the kinds.
    """

    kinds: dict[str, Kind]
    modes: Modes
    layers: Layers = field(repr=False)

    def likeliest(self, pins: PinTable, among: Sequence[str]) -> np.ndarray:
        """(M,) str: the most probable of some kinds for each valid frame of a table."""
        names = [name for name in self.kinds if name in among]
        columns = [list(self.kinds).index(name) for name in names]
        return np.array(names)[self._scores(moved_of(pins))[:, columns].argmax(axis=1)]

    def tell(self, pins: PinTable) -> np.ndarray:
        """(M,) str: the kind of each valid frame of a table; "" if it belongs to none."""
        moved = moved_of(pins)
        likeliest = self._scores(moved).argmax(axis=1)
        names = np.array(list(self.kinds), object)[likeliest]
        for name, kind in self.kinds.items():
            here = np.flatnonzero(names == name)
            if len(here):
                names[here[kind.strangeness(moved[here]) > MARGIN]] = ""
        return names.astype(str)

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
        There are fewer than two kinds, or too few frames of one.
    """
    if len(frames) < 2:
        raise TrainingError("to tell kinds of contact apart, frames of at least two are needed")
    moved = {name: np.concatenate([moved_of(each.pins) for each in frames[name]]) for name in sorted(frames)}
    kinds = {name: Kind.fit(each, seed, groups_of(frames[name])) for name, each in moved.items()}
    together = np.concatenate(list(moved.values()))
    modes = Modes.fit(together, COMMON_MODES)
    right = np.repeat(np.arange(len(moved)), [len(each) for each in moved.values()])
    return Contacts(kinds, modes, _layers(modes(together), right, seed))


def groups_of(parts: Sequence[Dataset]) -> np.ndarray | None:
    """The group of each row of consecutive data sets; None if no data set has groups. A row without a group forms its own group."""
    if all(part.group is None for part in parts):
        return None
    found, first = [], 0
    for part in parts:
        own = np.arange(len(part)) if part.group is None else np.unique(part.group, return_inverse=True)[1]
        found.append(first + own)
        first += int(own.max()) + 1
    return np.concatenate(found)


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
    """Write contacts in the form that ``read_contacts`` reads: arrays in half precision, except the few that need more."""
    arrays = {"modes.mean": contacts.modes.mean, "modes.components": contacts.modes.components, **layers_to(contacts.layers)}
    for name, kind in contacts.kinds.items():
        parts = {"mean": kind.modes.mean, "components": kind.modes.components}
        parts |= {key: getattr(kind, key) for key in ("weight", "usual", "known", "limits")}
        arrays |= {f"kinds.{name}.{key}": array for key, array in parts.items()}
    large = ("components", "known")
    FILE.write(path, {key: array.astype(np.float16 if key.rsplit(".", 1)[1] in large else np.float32) for key, array in arrays.items()}, {})


def read_contacts(path: Path) -> Contacts:
    """Read the contacts that ``write_contacts`` wrote.

    Raises
    ------
    TrainingError
        The file can't be read, or is damaged.
    """
    with FILE.opened(path) as (_, single):
        found = {key: array.astype(float) for key, array in single.items()}
        names = sorted({key.split(".")[1] for key in found if key.startswith("kinds.")})
        kinds = {}
        for name in names:
            part = {key.rsplit(".", 1)[1]: array for key, array in found.items() if key.startswith(f"kinds.{name}.")}
            kinds[name] = Kind(Modes(part["mean"], part["components"]), part["weight"], part["usual"], part["known"], part["limits"])
        return Contacts(kinds, Modes(found["modes.mean"], found["modes.components"]), layers_from(found))
