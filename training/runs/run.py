"""Training runs. A run's folder holds the following files, so that training can be continued after it was killed:

- ``config.json``: the resolved configuration (model, recipe, sensor, pipeline, labels), the names of the frames that were kept out of
  training, and digests of names, labels and frames.
- ``curves.csv``: the learning curves.
- ``checkpoint.pt``: the state of training while the run is in progress.
- ``weights.pt``: the trained model, when the run is finished.

Every file is written as a whole or not at all.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic

import numpy as np
import torch

from training.data.dataset import Dataset
from training.data.label_code import LabelCode, goes_round
from training.errors import TrainingError
from training.models import model_named
from training.models.part import Prepared
from training.runs.assemble import calibrate
from training.runs.config import ASIDE, RunConfig, difference, frame_marks, identity_of, training_labels, training_rows
from training.runs.loop import Loop, TrainingRows, parameter_count
from training.runs.run_files import CHECKPOINT, CONFIG, TENSORS, damage_error, read_config, read_tensors, write_tensors
from twin.errors import ErrorsAs
from twin.frames.forms import blob_spec
from twin.progress import Step, unheard
from twin.report.page import write_rows
from twin.store import fingerprint, write_text, writes

RUN_FILES = (CONFIG, "curves.csv", TENSORS)
FOLDS = 10  # parts of the training rows; each network of an ensemble holds out another part
KEEP_EVERY_S = 20.0  # s between two checkpoints
FEWEST_PARTS = 3  # least number of rows, or groups of rows: with fewer, almost no rows are left beside the held-out part
BEGIN_ANEW = "remove it to begin again, or give another `out`"  # remedy for a damaged checkpoint
EXTRA_WEIGHT = 0.3  # weight of a helper label in the loss; requested labels have the weight 1


@dataclass(frozen=True)
class _Lesson:
    """What the networks of a run are taught: data in order, training rows (m,), inputs, and the labels' numbers (M, E) as standardised."""

    out: Path
    resolved: dict
    config: RunConfig
    data: Dataset
    train: np.ndarray
    prepared: Prepared
    code: LabelCode
    scaled: torch.Tensor
    scaling: tuple

    def member(self, member: int, device: str) -> Loop:
        """The training of a network, from its beginning."""
        config, data, views = self.config, self.data, self.prepared.views
        seed, model = 1000 * config.seed + member, model_named(config.model)
        torch.manual_seed(seed)
        network = model.build(data.pins.reference, self.scaled.shape[1], config.size)
        held, learnt = fold_rows(self.train, config.seed, member, data.group)
        model.initialise(network, self.prepared.inputs, torch.from_numpy(self.train), self.scaled, self.code)
        network.to(device)
        weight = torch.tensor([EXTRA_WEIGHT if name in config.helpers else 1.0 for name in data.targets.names])[self.code.label_of]
        executed = torch.from_numpy(data.targets.executed.astype(np.float32)).repeat(views)
        learnt = np.concatenate([view * len(data) + learnt for view in range(views)])  # held-out frames are used in view 0 only
        rows = [torch.from_numpy(each) for each in (learnt, held)]
        taught = TrainingRows(self.prepared.inputs, self.scaled.repeat(views, 1), weight, executed, *rows)
        return Loop(network, config.recipe, taught, seed, model.penalty)

    def keep(self, done: list, loop: Loop | None) -> None:
        """Write the checkpoint and the curves."""
        state = None if loop is None else loop.state()
        write_tensors(self.out / CHECKPOINT, {"identity": _identity(self.resolved), "done": done, "loop": state})
        write_curves(self.out, [network["curves"] for network in done] + ([] if loop is None else [loop.curves]))

    def assemble(self, networks: list[dict]) -> None:
        """Write the run's files from networks, trained or not to the end."""
        data, config = self.data, self.config
        content = calibrate(config, data, self.prepared, self.train, networks, self.code, self.scaling)
        content |= {"aside": dict(self.prepared.learnt), "reference_px": data.pins.reference.pins_px}
        content |= {"learnt_from": frame_marks(data)[self.train]}
        network = model_named(config.model).build(data.pins.reference, len(self.code.label_of), config.size)
        content["parameters"] = parameter_count(network)
        write_tensors(self.out / TENSORS, content)
        write_text(self.out / CONFIG, json.dumps(self.resolved | {"parameters": content["parameters"]}, indent=1) + "\n")
        write_curves(self.out, [network["curves"] for network in networks])


@writes(*RUN_FILES, gone_on=(CHECKPOINT,))
def train_run(
    config: RunConfig, data: Dataset, out: Path, *, max_minutes: float | None = None, device: str = "cpu", progress: Step = unheard
) -> bool:
    """Train a run, or continue the one in ``out``. The order of the data set's rows does not matter.

    Parameters
    ----------
    progress : callable, optional
        Called with (epochs done, epochs of all networks, error on the held-out rows).
    max_minutes : float, optional
        Stop after the epoch in which this time has passed. The weights so far are written.
    device : {"cpu", "cuda"}
        Device for training. The written weights can be used on any device.

    Returns
    -------
    bool
        Whether training is finished.

    Raises
    ------
    TrainingError
        ``out`` holds another run, there are too few frames, or ``max_minutes`` is not a valid time.
    """
    started, out_of_time = monotonic(), False
    if max_minutes is not None and not max_minutes >= 0:  # also true for NaN, with which the training would never stop
        raise TrainingError(f"`max_minutes` {max_minutes}: give a time of 0 or more")
    data = data.in_order()
    train = training_rows(config, data)
    parts = len(train if data.group is None else np.unique(data.group[train]))
    if parts < FEWEST_PARTS:
        said = f" ({'; '.join(data.problems[:3])})" if data.problems else ""
        what = "frames" if data.group is None else "contacts"
        raise TrainingError(
            f"{', '.join(map(str, data.folders))}: {parts} {what} for training in {len(data)} usable frames are too few; {FEWEST_PARTS} "
            f"are needed{said}"
        )
    resolved = resolve(config, data, train)
    state = _open_checkpoint(out, resolved)
    prepared = model_named(config.model).prepare(data, train)
    code = LabelCode(goes_round(data.targets.units, training_labels(data, config)[train]))
    lesson = _Lesson(out, resolved, config, data, train, prepared, code, *scaled_labels(data, config, train, code))
    done: list = state["done"] if state else []
    members, epochs = config.recipe.members, config.recipe.epochs
    while len(done) < members and not out_of_time:
        member = len(done)
        loop = lesson.member(member, device)
        if state and state["loop"] is not None:
            loop.load(state["loop"])
        state, kept = None, monotonic()
        while not loop.finished and not out_of_time:
            point = loop.epoch()
            progress(member * epochs + point["epoch"], members * epochs, f"{point['held_out_error']:.4f}")
            out_of_time = max_minutes is not None and monotonic() - started > 60 * max_minutes
            if out_of_time or monotonic() - kept > KEEP_EVERY_S:
                lesson.keep(done, loop)
                kept = monotonic()
        if not loop.finished:
            lesson.assemble([*done, _collect_weights(loop)])
            return False
        done.append(_collect_weights(loop))
        lesson.keep(done, None)
    lesson.assemble(done)
    if len(done) < members:
        return False
    (out / CHECKPOINT).unlink(missing_ok=True)
    return True


def is_finished(config: RunConfig, data: Dataset, out: Path) -> bool:
    """Whether a folder holds this run (the same settings, data and code) and the run is finished.

    Raises
    ------
    TrainingError
        The folder holds another run, finished or not.
    """
    begun = (out / CHECKPOINT).is_file()
    if not begun and not (out / TENSORS).is_file():
        return False
    data = data.in_order()
    wanted = resolve(config, data, training_rows(config, data))
    _require_same(out, wanted, read_config(out), "not finished" if begun else "finished")
    return not begun


def resolve(config: RunConfig, data: Dataset, train: np.ndarray) -> dict:
    """The whole configuration as in ``config.json``; ``data`` are in order, and ``train`` (m,) are the training rows."""
    pins = data.pins
    kept_out = np.setdiff1d(np.arange(len(data)), train)
    rows: dict = {"usable": len(data), "train": len(train)} | identity_of(data, model_named(config.model))
    rows |= {"kept_out": list(dict.fromkeys(pins.image_name[kept_out].tolist()))}
    detection = blob_spec(pins.sensor.pipeline, pins.form).model_dump(mode="json")
    found: dict = {"model": config.model, "recipe": asdict(config.recipe), "labels": config.labels}
    found |= {"columns": list(data.targets.names), "units": list(data.targets.units), "helpers": list(config.helpers)}
    found |= {"seed": config.seed, "split": config.split, "size": config.size, "rows": rows}
    found |= {"sensor": pins.sensor.model_dump(mode="json")}
    found |= {"pipeline": {"form": str(pins.form), "graph": "voronoi", "detection": detection}}
    found |= {"data": ", ".join(map(str, data.folders)), "problems": data.problems, "code": fingerprint(__name__)}
    return found | ({"labelled": dict(config.labelled)} if config.labelled else {})


def scaled_labels(data: Dataset, config: RunConfig, train: np.ndarray, code: LabelCode) -> tuple[torch.Tensor, tuple]:
    """Labels (M, E) for the network, float32, and shift and scale (E,) for the code's numbers: ``number = shift + scale x``."""
    labels = code.encode(training_labels(data, config))
    known, k = labels[train], labels.shape[1]
    if config.recipe.scaling == "standard":
        shift, scale = known.mean(axis=0), known.std(axis=0)
    elif config.recipe.scaling == "unit":
        shift, scale = (known.max(axis=0) + known.min(axis=0)) / 2, np.ptp(known, axis=0) / 2
    else:
        shift, scale = np.zeros(k), np.ones(k)
    scale = np.where(scale > 0, scale, 1.0)
    pair = np.array(code.circular)[code.label_of]
    shift, scale = np.where(pair, 0.0, shift), np.where(pair, np.sqrt(0.5), scale)  # sine and cosine of a direction need a common scale
    return torch.from_numpy(((labels - shift) / scale).astype(np.float32)), (shift, scale)


def fold_rows(train: np.ndarray, seed: int, member: int, group: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Held-out rows (a tenth) and training rows of a network, from the rows ``train``; ``group`` as in ``Dataset``."""
    parts = train if group is None else np.unique(group[train])
    held = np.random.default_rng([seed, 1]).permutation(parts)[member % FOLDS :: FOLDS]
    if group is not None:
        held = train[np.isin(group[train], held)]
    return np.sort(held), np.setdiff1d(train, held)


def _collect_weights(loop: Loop) -> dict:
    network = loop.result()
    weights = {key: value.cpu().clone() for key, value in network.state_dict().items()}
    return {"weights": weights, "held": loop.rows.held, "curves": loop.curves}


def _open_checkpoint(out: Path, resolved: dict) -> dict | None:
    """The checkpoint of an interrupted run with the same configuration; None if there is nothing to continue."""
    path = out / CHECKPOINT
    if not path.is_file():
        if (out / TENSORS).is_file():
            raise TrainingError(f"{out}: holds a finished run; give another `out`")
        write_text(out / CONFIG, json.dumps(resolved, indent=1) + "\n")
        return None
    state = read_tensors(path, BEGIN_ANEW)
    with ErrorsAs((KeyError, TypeError, ValueError), lambda error: damage_error(path, "it does not state of which run it is", BEGIN_ANEW)):
        before = dict(json.loads(state["identity"]))
    _require_same(out, resolved, before, "not finished")
    return state


def _require_same(out: Path, wanted: dict, found: Mapping, state: str) -> None:
    if differs := difference(json.loads(_identity(wanted)), found):
        raise TrainingError(
            f"{out}: holds a run with other settings or data, {state} ({differs}); give another `out`, or the same settings and data"
        )


def write_curves(out: Path, curves: list[list[dict]]) -> None:
    """Write the points of each network's training: ``network``, and the keys of ``Loop.epoch``."""
    write_rows(out / "curves.csv", [{"network": k, **point} for k, points in enumerate(curves) for point in points])


def _identity(resolved: dict) -> str:
    return json.dumps({key: value for key, value in resolved.items() if key not in ASIDE}, sort_keys=True)
