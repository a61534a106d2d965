"""Training runs: a folder with the configuration, the learning curves, the weights, and what continuing after a kill needs.

- ``config.json``: the resolved configuration (model, recipe, sensor, pipeline, labels, rows).
- ``curves.csv``: the learning curves.
- ``checkpoint.pt``: the state of training, while the run goes on.
- ``weights.pt``: the trained model, when the run is done.

Every file is written whole or not at all.
"""

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic

import numpy as np
import torch

from training.assemble import calibrate
from training.dataset import Dataset, split_rows
from training.loop import Loop, Rows
from training.models import model_named
from training.models.part import Prepared
from training.networks import parameter_count
from training.recipes import Recipe, TrainingError, as_dict
from twin.frames.forms import blob_spec
from twin.store import fingerprint, write_text, write_with

FOLDS = 10  # parts of the training rows; each network of an ensemble watches another part
KEEP_EVERY_S = 20.0  # s between two checkpoints
EXTRA_WEIGHT = 0.3  # of a helper label in the loss, beside 1 of a label that is asked for


@dataclass(frozen=True)
class RunConfig:
    """What a run is told.

    Attributes
    ----------
    model : str
    recipe : Recipe
    labels : {"corrected", "raw"}
    seed : int
        Of weights and order; also shifts which fold is watched.
    split : int or None
        Seed of the validation fifth that is kept out of training; None trains on all rows.
    helpers : tuple of str
        Label columns that are learnt only because they help the others; they have less weight.
    size : dict
        Sizes of the network that differ from the model's own.
    labelled : tuple of str
        Names of the real frames from which was learnt what simulated pins miss; empty for other runs.
    """

    model: str
    recipe: Recipe
    labels: str = "corrected"
    seed: int = 0
    split: int | None = 0
    helpers: tuple[str, ...] = ()
    size: dict[str, int] = field(default_factory=dict)
    labelled: tuple[str, ...] = ()


def train_run(
    config: RunConfig,
    data: Dataset,
    out: Path,
    *,
    max_minutes: float | None = None,
    device: str = "cpu",
    progress: Callable | None = None,
) -> bool:
    """Train, or continue what ``out`` holds.

    Parameters
    ----------
    progress : callable, optional
        Called with (epochs done, epochs in all, the curve's last row) over all networks.
    max_minutes : float, optional
        Stop after the epoch in which this time has passed. The weights so far are written all the same.
    device : {"cpu", "cuda"}
        Where the networks learn; what is kept runs anywhere.

    Returns
    -------
    bool
        Whether training came to its end.

    Raises
    ------
    TrainingError
        ``out`` holds another run.
    """
    started = monotonic()
    out.mkdir(parents=True, exist_ok=True)
    train = training_rows(config, data)
    resolved = resolve(config, data, train)
    state = _opened(out, resolved)
    prepared = model_named(config.model).prepare(data, train)
    scaled, shift, scale = scaled_labels(data, config, train)
    done: list = state["done"] if state else []
    loop = None
    all_epochs = config.recipe.members * config.recipe.epochs
    while len(done) < config.recipe.members:
        member = len(done)
        loop = _member(config, data, prepared, scaled, train, member, device)
        if state and state["loop"] is not None:
            loop.load(state["loop"])
        state, kept = None, monotonic()
        while not loop.finished:
            point = loop.epoch()
            if progress:
                progress(member * config.recipe.epochs + point["epoch"], all_epochs, point)
            out_of_time = max_minutes is not None and monotonic() - started > 60 * max_minutes
            if out_of_time or monotonic() - kept > KEEP_EVERY_S:
                _keep(out, resolved, done, loop)
                kept = monotonic()
            if out_of_time and not loop.finished:
                networks = [*done, _finished(loop)]
                _assemble(out, resolved, config, data, prepared, train, networks, (shift, scale))
                return False
        done.append(_finished(loop))
        _keep(out, resolved, done, None)
    _assemble(out, resolved, config, data, prepared, train, done, (shift, scale))
    (out / "checkpoint.pt").unlink(missing_ok=True)
    return True


def is_finished(config: RunConfig, data: Dataset, out: Path) -> bool:
    """Whether a folder holds this very run, and it is finished.

    Raises
    ------
    TrainingError
        The folder holds another finished run.
    """
    if not (out / "weights.pt").is_file() or (out / "checkpoint.pt").is_file():
        return False
    train = training_rows(config, data)
    wanted = json.loads(json.dumps(resolve(config, data, train)))
    found = json.loads((out / "config.json").read_text())
    if _identity(wanted) != _identity({key: found.get(key) for key in wanted}):
        raise TrainingError(
            f"{out}: holds a finished run with other settings or data, or of another version of the program; give another --out"
        )
    return True


def training_rows(config: RunConfig, data: Dataset) -> np.ndarray:
    """Rows (m,) of a data set that a run learns from."""
    return np.arange(len(data)) if config.split is None else split_rows(len(data), config.split, data.group)[0]


def resolve(config: RunConfig, data: Dataset, train: np.ndarray) -> dict:
    """The whole configuration as ``config.json`` holds it."""
    pins = data.pins
    return {
        "model": config.model,
        "recipe": as_dict(config.recipe),
        "labels": config.labels,
        "columns": list(data.targets.names),
        "units": list(data.targets.units),
        "helpers": list(config.helpers),
        "seed": config.seed,
        "split": config.split,
        "size": config.size,
        "rows": {"usable": len(data), "train": len(train)},
        "sensor": pins.sensor.model_dump(mode="json"),
        "pipeline": {
            "form": str(pins.form),
            "graph": "voronoi",
            "detection": blob_spec(pins.sensor.pipeline, pins.form).model_dump(mode="json"),
        },
        "data": ", ".join(map(str, data.folders)),
        "problems": data.problems,
        "code": fingerprint(__name__),
    } | ({"labelled": list(config.labelled)} if config.labelled else {})


def scaled_labels(data: Dataset, config: RunConfig, train: np.ndarray) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
    """Labels (M, K) as the network learns them, float32, and shift and scale (K,) back to mm and deg: ``label = shift + scale x``."""
    labels = data.targets.corrected if config.labels == "corrected" else data.targets.raw
    known, k = labels[train], labels.shape[1]
    if config.recipe.scaling == "standard":
        shift, scale = known.mean(axis=0), known.std(axis=0)
    elif config.recipe.scaling == "unit":
        shift, scale = (known.max(axis=0) + known.min(axis=0)) / 2, np.ptp(known, axis=0) / 2
    else:
        shift, scale = np.zeros(k), np.ones(k)
    scale = np.where(scale > 0, scale, 1.0)
    return torch.from_numpy(((labels - shift) / scale).astype(np.float32)), shift, scale


def _member(
    config: RunConfig, data: Dataset, prepared: Prepared, scaled: torch.Tensor, train: np.ndarray, member: int, device: str
) -> Loop:
    seed, model, views = 1000 * config.seed + member, model_named(config.model), prepared.views
    torch.manual_seed(seed)
    network = model.build(data.pins.reference, scaled.shape[1], config.size)
    held, learnt = fold_rows(train, config.seed, member, data.group)
    model.initialise(network, prepared.inputs, torch.from_numpy(train))
    network.to(device)
    weight = torch.tensor([EXTRA_WEIGHT if name in config.helpers else 1.0 for name in data.targets.names])
    executed = torch.from_numpy(data.targets.executed.astype(np.float32))
    learnt = np.concatenate([view * len(data) + learnt for view in range(views)])  # frames are watched as they are, in view 0 only
    rows = Rows(prepared.inputs, scaled.repeat(views, 1), weight, executed.repeat(views), torch.from_numpy(learnt), torch.from_numpy(held))
    return Loop(network, config.recipe, rows, seed, model.penalty)


def fold_rows(train: np.ndarray, seed: int, member: int, group: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The tenth of the training rows that a network watches, and the rows that it learns from; ``group`` as in ``Dataset``."""
    parts = train if group is None else np.unique(group[train])
    held = np.random.default_rng([seed, 1]).permutation(parts)[member % FOLDS :: FOLDS]
    if group is not None:
        held = train[np.isin(group[train], held)]
    return np.sort(held), np.setdiff1d(train, held)


def _finished(loop: Loop) -> dict:
    network = loop.result()
    return {
        "weights": {key: value.cpu().clone() for key, value in network.state_dict().items()},
        "held": loop.rows.held,
        "curves": loop.curves,
    }


def _assemble(
    out: Path,
    resolved: dict,
    config: RunConfig,
    data: Dataset,
    prepared: Prepared,
    train: np.ndarray,
    networks: list[dict],
    scaling: tuple[np.ndarray, np.ndarray],
) -> None:
    model = model_named(config.model)
    content = calibrate(
        model,
        data,
        prepared,
        train,
        networks,
        scaling,
        labels=config.labels,
        helpers=config.helpers,
        kernel=config.recipe.kernel,
        size=config.size,
        seed=config.seed,
    )
    content |= {"aside": dict(prepared.learnt), "reference_px": data.pins.reference.pins_px}
    content["parameters"] = parameter_count(model.build(data.pins.reference, len(data.targets.names), config.size))
    write_tensors(out / "weights.pt", content)
    write_text(out / "config.json", json.dumps(resolved | {"parameters": content["parameters"]}, indent=1) + "\n")
    write_curves(out, [network["curves"] for network in networks])


def _keep(out: Path, resolved: dict, done: list, loop: Loop | None) -> None:
    write_tensors(out / "checkpoint.pt", {"identity": _identity(resolved), "done": done, "loop": None if loop is None else loop.state()})
    write_curves(out, [network["curves"] for network in done] + ([] if loop is None else [loop.curves]))


def _opened(out: Path, resolved: dict) -> dict | None:
    """The checkpoint of an interrupted run of the same configuration; None where there is nothing to continue."""
    path = out / "checkpoint.pt"
    if not path.is_file():
        if (out / "weights.pt").is_file():
            raise TrainingError(f"{out}: holds a finished run; give another --out")
        write_text(out / "config.json", json.dumps(resolved, indent=1) + "\n")
        return None
    state = torch.load(path, weights_only=True, map_location="cpu")
    if state["identity"] != _identity(resolved):
        raise TrainingError(
            f"{out}: holds a run with other settings or data, or of another version of the program, begun and not finished; "
            "give another --out, or the same settings"
        )
    return state


def write_tensors(path: Path, content: dict) -> None:
    """Write a dict of numbers, text, lists, arrays and tensors so that ``torch.load`` reads it with ``weights_only``."""
    write_with(path, lambda file: torch.save(_as_tensors(content), file))


def _as_tensors(value: object) -> object:
    """The same content with arrays as tensors: PyTorch reads tensors back without running code that a file may hold."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    if isinstance(value, dict):
        return {key: _as_tensors(part) for key, part in value.items()}
    return [_as_tensors(part) for part in value] if isinstance(value, list) else value


def write_curves(out: Path, curves: list[list[dict]]) -> None:
    """Write ``curves.csv``: the curves of all networks, one network after the other."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["network", "epoch", "loss", "held_out_error", "rate", "seconds"])
    for k, points in enumerate(curves):
        writer.writerows([k, *point.values()] for point in points)
    write_text(out / "curves.csv", text.getvalue())


def _identity(resolved: dict) -> str:
    return json.dumps({key: value for key, value in resolved.items() if key not in ("problems", "data")}, sort_keys=True)
