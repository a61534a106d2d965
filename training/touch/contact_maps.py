"""Contact maps from the pins of one frame: the deformed skin, and pressure and shear over it. They are trained on simulated contacts.

The finite elements give the force at every place of the skin, and the places themselves. Both are written as a mean and a few principal
directions on the sensor's grid (``twin.mechanics.skin_map``). A small network computes their amplitudes from the model's modes of the pins.
Forces are first averaged over a millimetre of skin, because pins two millimetres apart show no finer detail. Then the map is corrected to
the model's estimates of the whole force and torque, because these are more accurate than the map's sum.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import nn

from scenes.sensor import GeometrySpec
from training.data.dataset import Dataset, name_prefixes
from training.errors import TrainingError
from training.runs.run_files import AGAIN
from twin.frames.truth import arrays_of, open_truth, row_of
from twin.mechanics.skin_map import SIDE, ContactMaps, between_nodes, skin_grid
from twin.store import ArrayFile, Layers, layers_from, layers_to, silu, through_layers

"""File of a run with its maps."""
FILE = ArrayFile("file of contact maps", "twin train", version=1, error=TrainingError, again=AGAIN)
DETAIL_MM = 1.0
"""Standard deviation, mm, of the Gaussian over which forces are averaged."""
FORCE_DIRECTIONS, SKIN_DIRECTIONS = 120, 40
"""Numbers of principal directions of the forces and of the skin's places. They leave 2 % and 0.02 % of the variance."""
MOST_STATES, MOST_FOR_DIRECTIONS = 6000, 1500
"""Most contact states from which the network learns (100 MB of forces), and most of these states from which the directions are computed."""
FEWEST_STATES = 50
"""Least number of states from which maps can be learnt."""
UNITS, EPOCHS, BATCH, RATE, DECAY, JITTER = 384, 40, 128, 3e-3, 0.02, 0.02
"""Training: units of both layers, epochs, states of a step, highest learning rate, weight decay, noise of the inputs."""
GAIN = 3.0
"""Standard deviation of the largest mode at the network's input. With it, the network learns fastest from small modes."""
HEADROOM = 1.2
"""Largest size of a mode, relative to its largest size in training. Larger values are clipped, because the network does not extrapolate."""
PLAIN_N = 0.3
"""Least normal force, N, of states on which maps are evaluated. Lighter contacts move the pins by less than their noise."""
FORCES = ("force_x", "force_y", "force_z")
"""Labels of the whole force."""
TORQUE = "torque_z"
"""Label of the torque about the sensor's axis."""


@dataclass(frozen=True)
class Directions:
    """Mean (V,) and principal directions (k, V) of values, scaled so that the network's amplitudes are about 1."""

    mean: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray, most: int, rng: np.random.Generator) -> "Directions":
        """At most ``most`` principal directions of values (M, V), the largest first, computed from some of the rows."""
        mean = values.mean(axis=0)
        away = values[np.sort(rng.permutation(len(values))[:MOST_FOR_DIRECTIONS])] - mean
        square, vectors = np.linalg.eigh(away @ away.T)
        keep = square[::-1][:most] > square[-1] * 1e-9
        chosen = vectors[:, ::-1][:, :most][:, keep]
        size = np.sqrt(square[::-1][:most][keep])
        return cls(mean, (chosen / size).T @ away * size[0] / np.sqrt(len(away)))

    def amplitudes(self, values: np.ndarray) -> np.ndarray:
        """Amplitudes (M, k) of values (M, V)."""
        return (values - self.mean) @ self.rows.T / (self.rows[0] @ self.rows[0])


@dataclass(frozen=True)
class MapModel:
    """Maps of a sensor's contacts from the modes (D,) of its pins.

    Attributes
    ----------
    geometry : GeometrySpec
    gain, limit : (1,), (D,) float
        Factor on the modes, and largest size of each mode.
    layers : tuple of (weights, offset)
        Layers of the network.
    force, skin : Directions
        Directions of the forces (3 G values, N, divided by the root of each node's area) and of the skin nodes' places (3 c values, mm).
    """

    geometry: GeometrySpec
    gain: np.ndarray
    limit: np.ndarray
    layers: Layers = field(repr=False)
    force: Directions = field(repr=False)
    skin: Directions = field(repr=False)

    def __call__(self, modes: np.ndarray, told: Mapping[str, float]) -> ContactMaps:
        """The maps of one frame.

        Parameters
        ----------
        modes : (D,) float
        told : dict of str to float
            The model's estimates for the frame, by label. If they include the whole force or torque, the maps are corrected to these.
        """
        said = through_layers(self.layers, self.gain * np.clip(modes, -self.limit, self.limit), silu)
        count = len(self.force.rows)
        grid = skin_grid(self.geometry)
        per_root = (self.force.mean + said[:count] @ self.force.rows).reshape(SIDE * SIDE, 3)
        places = (self.skin.mean + said[count:] @ self.skin.rows).reshape(-1, 3)
        maps = ContactMaps(between_nodes(places), grid.area_mm2, per_root * np.sqrt(grid.area_mm2)[:, None])
        force = [told[name] for name in FORCES] if set(FORCES) <= set(told) else None
        return maps.with_resultants(None if force is None else np.array(force), told.get(TORQUE))


def _truth(data: Dataset, rows: np.ndarray, geometry: GeometrySpec) -> tuple[np.ndarray, np.ndarray]:
    """Known forces and places of rows (m,) of a data set. In joined data sets the folder stands before a frame's name."""
    grid = skin_grid(geometry)
    names = data.pins.image_name[rows]
    force = np.zeros((len(rows), 3, SIDE * SIDE), np.float32)
    skin: np.ndarray | None = None
    for folder, prefix in zip(data.folders, name_prefixes(data.folders), strict=True):
        mine = np.flatnonzero([name[: name.rfind("/") + 1] == prefix for name in names.tolist()])
        if not len(mine):
            continue
        truth, _, _ = open_truth(folder)
        known = row_of(truth)
        found = [known[name.rpartition("/")[2]] for name in names[mine].tolist()]
        arrays = arrays_of(truth, ("map_force_n", "skin_mm"))
        force[mine] = arrays["map_force_n"][found].transpose(0, 2, 1)
        if skin is None:
            skin = np.zeros((len(rows), arrays["skin_mm"][0].size), np.float32)
        skin[mine] = arrays["skin_mm"][found].reshape(len(mine), -1)
    assert skin is not None  # every row is of one of the folders
    smooth = grid.smooth_values(force.reshape(-1, SIDE * SIDE), DETAIL_MM).reshape(len(rows), 3, SIDE * SIDE)
    return (smooth / np.sqrt(grid.area_mm2)).transpose(0, 2, 1).reshape(len(rows), -1), skin


def learn_maps(modes: np.ndarray, data: Dataset, rows: np.ndarray, *, seed: int = 0) -> MapModel:
    """Learn maps from rows (m,) of simulated contacts, at least ``FEWEST_STATES``, and the model's modes (M, D) of all rows."""
    rng = np.random.default_rng([seed, 4])
    rows = np.sort(rng.permutation(rows)[:MOST_STATES])
    geometry = data.pins.sensor.geometry
    known_force, known_skin = _truth(data, rows, geometry)
    force, skin = Directions.of(known_force, FORCE_DIRECTIONS, rng), Directions.of(known_skin, SKIN_DIRECTIONS, rng)
    x = modes[rows]
    gain = np.array([GAIN / max(float(x.std(axis=0).max()), 1e-12)])
    limit = HEADROOM * np.abs(x).max(axis=0)
    y = np.concatenate([force.amplitudes(known_force), skin.amplitudes(known_skin)], axis=1)
    return MapModel(geometry, gain, limit, _layers(gain * x, y, seed), force, skin)


def _layers(x: np.ndarray, y: np.ndarray, seed: int) -> Layers:
    """Layers of a network trained to compute y (M, k) from x (M, D)."""
    generator = torch.Generator().manual_seed(seed)
    sizes = [x.shape[1], UNITS, UNITS, y.shape[1]]
    layers = [nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False)]
    for layer in layers:
        nn.init.normal_(layer.weight, std=layer.in_features**-0.5, generator=generator)
        nn.init.zeros_(layer.bias)
    network = nn.Sequential(layers[0], nn.SiLU(), layers[1], nn.SiLU(), layers[2])
    inputs, wanted = torch.from_numpy(x.astype(np.float32)), torch.from_numpy(y.astype(np.float32))
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=EPOCHS * -(-len(x) // BATCH))
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(x), generator=generator).split(BATCH):
            noise = JITTER * torch.randn(len(chosen), x.shape[1], generator=generator)
            loss = ((network(inputs[chosen] + noise) - wanted[chosen]) ** 2).sum(dim=1).mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return tuple((layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers)


def write_maps(path: Path, model: MapModel) -> None:
    """Write maps in the form that ``read_maps`` reads: large arrays in half precision."""
    arrays = {"gain": model.gain, "limit": model.limit, **layers_to(model.layers)}
    for name, directions in (("force", model.force), ("skin", model.skin)):
        arrays |= {f"{name}.mean": directions.mean, f"{name}.rows": directions.rows}
    FILE.write(path, {key: array.astype(np.float16 if array.ndim == 2 else np.float32) for key, array in arrays.items()}, {})


def read_maps(path: Path, geometry: GeometrySpec) -> MapModel:
    """Read the maps that ``write_maps`` wrote, for the sensor of the run.

    Raises
    ------
    TrainingError
        The file can't be read, or is damaged.
    """
    with FILE.open_arrays(path) as (_, found):
        layers = layers_from(found)
        force, skin = (Directions(found[f"{name}.mean"], found[f"{name}.rows"]) for name in ("force", "skin"))
        fits = len(force.mean) == 3 * SIDE * SIDE and len(layers[-1][1]) == len(force.rows) + len(skin.rows)
        if not (fits and layers[0][0].shape[1] == len(found["limit"])):
            raise ValueError("its arrays do not fit together")
        return MapModel(geometry, found["gain"], found["limit"], layers, force, skin)


def compare_maps(made: list[ContactMaps], data: Dataset, rows: np.ndarray) -> dict[str, float] | None:
    """Compare maps with the known forces and places of rows (m,) of a simulated data set.

    Returns
    -------
    dict or None
        Errors on states with more than ``PLAIN_N`` of normal force, with forces averaged over ``DETAIL_MM``; None if all are lighter.

        states : int
        patch_iou : float
            Mean of intersection over union of the contact patches (see ``ContactMaps.patch``).
        pressure_correlation, shear_correlation : float
            Mean correlation of pressures, and of shear tractions, over the skin's nodes.
        resultant : float
            Median of the difference between the map's sum and the true force, relative to the true force.
        skin_mm : float
            Mean distance of the skin's nodes from their true places.
    """
    geometry = data.pins.sensor.geometry
    grid, truth = skin_grid(geometry), _truth(data, rows, geometry)
    rated = []
    for maps, per_root, places in zip(made, *truth, strict=True):
        force = per_root.reshape(-1, 3).astype(float) * np.sqrt(grid.area_mm2)[:, None]
        true = ContactMaps(between_nodes(places.reshape(-1, 3).astype(float)), grid.area_mm2, force)
        if true.resultant_n[2] <= PLAIN_N:
            continue
        iou = (maps.patch & true.patch).sum() / max((maps.patch | true.patch).sum(), 1)
        pressure = np.corrcoef(maps.pressure_mpa, true.pressure_mpa)[0, 1]
        shear = np.corrcoef(maps.traction_mpa.ravel(), true.traction_mpa.ravel())[0, 1]
        resultant = np.linalg.norm(maps.resultant_n - true.resultant_n) / np.linalg.norm(true.resultant_n)
        rated.append((iou, pressure, shear, resultant, np.linalg.norm(maps.nodes_mm - true.nodes_mm, axis=1).mean()))
    if not rated:
        return None
    names = ("patch_iou", "pressure_correlation", "shear_correlation", "resultant", "skin_mm")
    columns = zip(names, np.array(rated).T, strict=True)
    return {"states": len(rated)} | {name: float(np.median(c) if name == "resultant" else c.mean()) for name, c in columns}
