"""The models of the paper's comparison. All are trained and evaluated on the same rows, and timed at several batch sizes."""

import ctypes
import gc
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch

from training.data.dataset import Dataset
from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.estimate.estimator import PoseEstimator
from training.models import model_named, recipe_of, variant_named
from training.models.part import Inputs
from training.runs.config import RunConfig
from training.runs.loop import Loop, TrainingRows, parameter_count
from training.runs.run import is_finished, train_run
from training.runs.run_files import CHECKPOINT, TENSORS, read_config
from training.studies.judging import measure_errors, rows_to_evaluate
from twin.progress import Progress, silent, stage

# Number of rows from which a timed network takes its scales and modes. Its speed does not depend on this number.
INITIAL_ROWS = 500
# Bytes of a MiB.
MIB = 2.0**20
# Files of the Linux kernel with this process's peak of memory (VmHWM), and that takes "5" to let the peak begin anew.
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class PlannedRun:
    """One run of the study.

    Attributes
    ----------
    name : str
        Name of a model, or of one without an ingredient, such as ``vgnn-without-graph``.
    config : RunConfig
    """

    name: str
    config: RunConfig

    @property
    def folder(self) -> str:
        """Name of the run's folder."""
        return f"{self.name}-{self.config.labels}-{self.config.seed}"


def plan_run(name: str, *, labels: str, seed: int, split: int, epochs: int | None = None) -> PlannedRun:
    """The run of a model with this name.

    Raises
    ------
    TrainingError
        There is no model of this name.
    """
    model, variant = variant_named(name)
    recipe = recipe_of(model.name, epochs=epochs, **variant.recipe)
    return PlannedRun(name, RunConfig(model.name, recipe, labels, seed, split, size=dict(variant.size)))


def train_all(
    plans: list[PlannedRun], data: Dataset, out: Path, *, max_minutes: float | None, device: str = "cpu", progress: Progress = silent
) -> dict[str, float]:
    """Train or continue every run. The remaining time is divided evenly among the remaining runs.

    Returns
    -------
    dict
        Minutes that this call spent on each run, by the run's folder. Runs for which no time was left are missing.
    """
    started, spent = monotonic(), {}
    for k, plan in enumerate(plans):
        folder = out / plan.folder
        if is_finished(plan.config, data, folder):
            spent[plan.folder] = 0.0
            continue
        begun = monotonic()
        share = None if max_minutes is None else (max_minutes - (begun - started) / 60) / (len(plans) - k)
        if share is not None and share <= 0:
            continue
        with stage(progress, plan.name) as step:
            train_run(plan.config, data, folder, max_minutes=share, device=device, progress=step)
        spent[plan.folder] = (monotonic() - begun) / 60
    return spent


def table_row(plan: PlannedRun, data: Dataset, out: Path, minutes: float | None) -> dict[str, Any]:
    """One run's row of the table, with its errors on the rows kept out of training. If it was not begun, the row states only that."""
    folder = out / plan.folder
    row: dict[str, Any] = {"model": plan.name, "seed": plan.config.seed, "labels": plan.config.labels}
    row |= {"minutes_now": minutes, "state": "not begun"}
    if not (folder / TENSORS).is_file():
        return row
    estimator = PoseEstimator.load(folder)
    rows = rows_to_evaluate(estimator, data, "validation")
    metrics = measure_errors(estimator.predict_rows(data, rows), data, rows)
    curves = read_curves(folder)
    row |= {"state": "ended early" if (folder / CHECKPOINT).exists() else "finished", "parameters": read_config(folder)["parameters"]}
    row |= {"epochs": len(curves), "epochs_allowed": plan.config.recipe.epochs * plan.config.recipe.members}
    row |= {"training_minutes": float(curves["seconds"].sum()) / 60, "s_per_epoch": float(np.median(curves["seconds"]))}
    row |= {key: metrics[key] for key in ("frames", "without_prediction", "leak_slope")}
    for kind in ("raw", "corrected"):
        for name in data.targets.names:
            row[f"{name}_{kind}"] = metrics[kind][name]["mae"]
            row[f"{name}_{kind}_inside_90"] = metrics[kind][name]["coverage_90"]
    model = model_named(plan.config.model)
    paper = model.published_mm_deg if plan.name == model.name and model.published_mm_deg else (None, None)
    return row | {"paper_mm": paper[0], "paper_deg": paper[1]}


def read_curves(folder: Path) -> np.ndarray:
    """The learning curve of a run: a record of named numbers for each epoch, one network after the other."""
    return np.atleast_1d(np.genfromtxt(folder / "curves.csv", delimiter=",", names=True))


class PeakMemory:
    """Context that measures the peak memory, in MiB above that at its start: of the GPU, or of the process's resident set on a CPU.

    The kernel's own peak of the resident set is read, which only Linux has. Elsewhere the peak is NaN.
    """

    def __init__(self, device: str = "cpu") -> None:
        self.device, self.peak = device, float("nan")

    def __enter__(self) -> "PeakMemory":
        gc.collect()
        # Freed memory that was not given back to the system would be reused, and the resident set would not grow.
        if FORGET.exists() and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
            trim(0)
        self.start = self._peak(anew=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.peak = self._peak() - self.start

    def _peak(self, *, anew: bool = False) -> float:
        """The peak since it was measured ``anew``, MiB."""
        if self.device == "cuda":
            if anew:
                torch.cuda.reset_peak_memory_stats()
            return torch.cuda.max_memory_allocated() / MIB
        try:
            if anew:
                FORGET.write_text("5", encoding="utf-8")
            return int(STATUS.read_text(encoding="utf-8").partition("VmHWM:")[2].split()[0]) * 1024 / MIB
        except (OSError, IndexError):  # no such files, or no such line
            return float("nan")


def measure_training(model: str, pins: PinTable, inputs: Inputs, batch: int, *, device: str = "cpu") -> dict[str, Any]:
    """Time and memory of training a model for an epoch, or for some batches if an epoch takes many minutes.

    Parameters
    ----------
    pins : PinTable
        M frames.
    inputs : Inputs
        Inputs of an epoch. It may hold each frame several times.

    Returns
    -------
    dict
        ``model``, ``parameters``, ``batch``, ``rows_timed``, ``ms_per_frame`` (in an epoch, all its rows together),
        ``s_per_epoch`` (None if only some batches were timed) and ``memory_mib``. A first pass is not timed.
    """
    torch.manual_seed(0)
    part, count = model_named(model), len(inputs)
    network = part.build(pins.reference, 2, {})
    labels = torch.randn(count, 2)
    part.initialise(network, inputs, torch.arange(min(INITIAL_ROWS, count)), labels, LabelCode((False, False)))
    timed = count if part.timed_batches is None else min(part.timed_batches * batch, count)
    executed, none = torch.full((count,), torch.nan), torch.zeros(0, dtype=torch.long)
    rows = TrainingRows(inputs, labels, torch.ones(2), executed, torch.arange(timed), none)
    loop = Loop(network.to(device), recipe_of(model, batch=batch), rows, 0, part.penalty)
    with PeakMemory(device) as memory:
        loop.epoch()
        seconds = loop.epoch()["seconds"]
    row: dict[str, Any] = {"model": model, "parameters": parameter_count(network), "batch": batch, "rows_timed": timed}
    row |= {"ms_per_frame": 1e3 * seconds / timed * count / len(pins), "s_per_epoch": seconds if timed == count else None}
    return row | {"memory_mib": memory.peak}
