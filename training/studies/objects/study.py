"""The study of unseen objects: a model trained on several objects is compared with a model trained on the first of them alone.

All contacts are simulated, without pictures. Labels mean the same on every object (``twin.rig.touch``). Both models are trained on
the same number of contacts. The errors on an object are measured on other contacts with it, which neither model was trained on.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes import ExperimentSpec
from training.data.dataset import Dataset, load_dataset
from training.data.label_code import label_error
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.generation import GenerationConfig, generate
from training.studies.objects.page import write_page
from training.studies.objects.plan import MIXED, TIMES, ObjectsPlan
from training.studies.sim_to_real.steps import train_in_twin
from training.studies.sim_to_real.variants import contact_of
from twin.estimate import readable_labels
from twin.progress import Progress, silent, stage
from twin.report.table import write_table
from twin.store import writes
from twin.types import ReadableResult


@dataclass(frozen=True, repr=False)
class ObjectsResult(ReadableResult):
    """The result of the study.

    Attributes
    ----------
    rows : list of dict
        See ``table``.
    verdicts : list of str
        See ``verdicts``.
    names : tuple of str
        Names of the labels.
    written : list of Path
    """

    rows: list[dict[str, Any]]
    verdicts: list[str]
    names: tuple[str, ...]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text: one for each model and object, then the verdicts."""
        lines, labels = [], dict(zip(self.names, readable_labels(self.names), strict=True))
        for row in self.rows:
            errors = ", ".join(f"{label} {row[f'{name}_error']:.3g} ({row[f'{name}_times']:.2f} times)" for name, label in labels.items())
            lines.append(f"{row['model']}, {row['object']} ({'seen' if row['seen'] else 'unseen'}): {errors}")
        return lines + self.verdicts


@writes("objects.csv", "index.html", "errors*.png")
def run(plan: ObjectsPlan, out: Path, *, progress: Progress = silent) -> ObjectsResult:
    """Simulate contacts of all objects, train both models, and evaluate them on contacts of every object.

    Writes data sets, runs, ``objects.csv`` and ``index.html`` to ``out``. Results of an earlier call with the same plan are used again.

    Raises
    ------
    DatasetError
        A folder holds another data set, or contacts can't be made.
    TrainingError
        A folder holds another run, or no contact of an object lies within the ranges that are evaluated.
    """
    sets = {folder: _simulate(plan, out / folder, folder, config, count, progress) for folder, config, count in plan.sets()}
    runs = {}
    for name, data in plan.trained_on(sets).items():
        runs[name] = out / name
        with stage(progress, name) as step:
            train_in_twin(data, runs[name], seed=plan.seed, split=None, epochs=plan.epochs, progress=step)
    names, rows = plan.experiment.targets, table(plan, runs, sets)
    said = verdicts(plan, rows, names)
    page = write_page(out, plan, rows, said)
    return ObjectsResult(rows, said, names, [write_table(out / "objects.csv", rows), page])


def _simulate(plan: ObjectsPlan, folder: Path, title: str, config: GenerationConfig, count: int, progress: Progress) -> Dataset:
    with stage(progress, title) as step:
        generate(folder, config, count, workers=plan.workers, progress=step)
    with stage(progress, f"{title}: states") as step:
        return load_dataset(folder, plan.sensor, plan.experiment.targets, progress=step)


def rows_in_range(data: Dataset, experiment: ExperimentSpec) -> np.ndarray:
    """Indices of the rows whose corrected labels lie within the experiment's ranges.

    States on the way to a contact, and contacts beside an edge, may lie outside of them.
    """
    low, high = np.array([experiment.ranges()[name] for name in data.targets.names]).T
    return np.flatnonzero(((data.targets.corrected >= low) & (data.targets.corrected <= high)).all(axis=1))


def table(plan: ObjectsPlan, runs: dict[str, Path], sets: dict[str, Dataset]) -> list[dict[str, Any]]:
    """A row for each model and object: mean absolute errors, biases, and the ratios of the errors to those on the first object."""
    rows = []
    for model, run in runs.items():
        estimator = PoseEstimator.load(run)
        learnt = {obj.name for obj in (plan.train if model == MIXED else (plan.alone,))}
        flat: np.ndarray | None = None
        for obj in (*plan.train, *plan.unseen):
            data = sets[f"tests/{obj.name}"]
            chosen = rows_in_range(data, plan.experiment)
            if not len(chosen):
                raise TrainingError(f"{obj.name}: no contact has labels within the ranges of {plan.experiment.name}; give more `tests`")
            off = label_error(estimator.predict_rows(data, chosen).mean, data.targets.corrected[chosen], data.targets.units)
            error, bias = np.abs(off).mean(axis=0), off.mean(axis=0)
            flat = error if flat is None else flat
            row: dict[str, Any] = {"model": model, "object": obj.name, "seen": obj.name in learnt}
            row |= {"contacts": len(np.unique(contact_of(data)[chosen])), "states": len(chosen)}
            for k, name in enumerate(data.targets.names):
                row |= {f"{name}_error": float(error[k]), f"{name}_bias": float(bias[k]), f"{name}_times": float(error[k] / flat[k])}
            rows.append(row)
    return rows


def verdicts(plan: ObjectsPlan, rows: list[dict[str, Any]], names: tuple[str, ...]) -> list[str]:
    """A sentence for each unseen object: are the mixed model's errors at most ``TIMES`` its errors on the first object?"""
    lines = []
    for row in rows:
        if row["model"] != MIXED or row["object"] not in {obj.name for obj in plan.unseen}:
            continue
        held = all(row[f"{name}_times"] <= TIMES for name in names)
        said = ", ".join(f"{label} {row[f'{name}_times']:.2f}" for name, label in zip(names, readable_labels(names), strict=True))
        lines.append(
            f"{row['object']}, unseen: {said} times the error on {plan.alone.name} ({'within' if held else 'not within'} {TIMES:g})"
        )
    return lines
