"""The study of unseen objects: a model trained on several objects is compared with a model trained on the first of them alone.

All contacts are simulated, without pictures. Labels mean the same on every object (``twin.rig.touch``). Both models are trained on
the same number of contacts. The errors on an object are measured on other contacts with it, which neither model was trained on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scenes import ExperimentSpec, ObjectSpec, RandomisationSpec, SensorSpec, load_experiment
from training.data.dataset import Dataset, join_datasets, load_dataset
from training.data.label_code import label_error
from training.data.targets import unit_of
from training.errors import TrainingError
from training.estimate.estimator import PoseEstimator
from training.generation import GenerationConfig, generate, require_count
from training.studies.sim_to_real.steps import contact_of, train_in_twin
from twin.estimate import readable_labels
from twin.progress import Progress, silent, stage
from twin.report.charts import muted_colour, sized_figure, write_chart
from twin.report.page import BLUE, RED, Column, Page, PagePicture, number, sentence, strong, write_table
from twin.store import writes
from twin.types import FINE, ReadableResult

# Difference between the seeds of the evaluated contacts and of the training contacts, so that no evaluated contact is trained on.
TESTS_APART = 1000
# Name of the model that is trained on all objects of ``Plan.train``.
MIXED = "mixed"
# Largest ratio of the error on an unseen object to the error on the first object for which the aim counts as reached.
TIMES = 1.5


@dataclass(frozen=True)
class ObjectsPlan:
    """What is simulated, trained and evaluated.

    Attributes
    ----------
    sensor : SensorSpec
    experiment : ExperimentSpec
        Its ranges contain the labels of the evaluated contacts. Training uses its wide form, if it has one.
    randomisation : RandomisationSpec
    train, unseen : tuple of ObjectSpec
        Objects. The first of ``train`` is also trained on alone.
    count, tests : int
        Contacts to train on, and to evaluate on, for each object.
    seed, across : int
    epochs : int or None
        Epochs of both trainings; None: the model's own number.
    workers : int
        Number of simulating processes.
    """

    sensor: SensorSpec
    experiment: ExperimentSpec
    randomisation: RandomisationSpec
    train: tuple[ObjectSpec, ...]
    unseen: tuple[ObjectSpec, ...]
    count: int = 100
    tests: int = 50
    seed: int = 0
    across: int = FINE
    epochs: int | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        names = [each.name for each in (*self.train, *self.unseen)]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise TrainingError(f"{', '.join(twice)}: given twice; an object is either trained on or unseen")
        if len(self.train) < 2 or not self.unseen:
            raise TrainingError("give at least two objects to train on and an unseen one")
        require_count(self.count)
        require_count(self.tests, "`tests`")

    @property
    def wider(self) -> ExperimentSpec:
        """The experiment that is trained on."""
        return load_experiment(self.experiment, wide=bool(self.experiment.wide or self.experiment.wider))

    @property
    def alone(self) -> ObjectSpec:
        """The object that is also trained on alone."""
        return self.train[0]

    def sets(self) -> list[tuple[str, GenerationConfig, int]]:
        """Folder, configuration and number of contacts of every data set."""
        many = self.count * len(self.train)
        learnt = [(f"sim/{o.name}", self._config(o, self.wider, 0), many if o is self.alone else self.count) for o in self.train]
        tests = [(f"tests/{o.name}", self._config(o, self.experiment, TESTS_APART), self.tests) for o in (*self.train, *self.unseen)]
        return learnt + tests

    def _config(self, obj: ObjectSpec, experiment: ExperimentSpec, apart: int) -> GenerationConfig:
        parts: dict[str, Any] = {"sensor": self.sensor, "object": obj, "experiment": experiment, "randomisation": self.randomisation}
        return GenerationConfig(**parts, friction=obj.friction, seed=self.seed + apart, images="none", states="all", across=self.across)

    def trained_on(self, sets: dict[str, Dataset]) -> dict[str, Dataset]:
        """The data set that each model is trained on, by the model's name. Both have the same number of contacts."""
        parts = [sets[f"sim/{obj.name}"] for obj in self.train]
        first = parts[0].rows(np.flatnonzero(contact_of(parts[0]) < self.count))
        return {MIXED: join_datasets([first, *parts[1:]]), self.alone.name: parts[0]}


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
    sets, runs = {}, {}
    for folder, config, count in plan.sets():
        with stage(progress, folder) as step:
            generate(out / folder, config, count, workers=plan.workers, progress=step)
        with stage(progress, f"{folder}: states") as step:
            sets[folder] = load_dataset(out / folder, plan.sensor, plan.experiment.targets, progress=step)
    for name, data in plan.trained_on(sets).items():
        runs[name] = out / name
        with stage(progress, name) as step:
            train_in_twin(data, runs[name], seed=plan.seed, split=None, epochs=plan.epochs, progress=step)
    names, rows = plan.experiment.targets, table(plan, runs, sets)
    said = verdicts(plan, rows, names)
    page = write_page(out, plan, rows, said)
    return ObjectsResult(rows, said, names, [write_table(out / "objects.csv", rows), page])


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
        within = f"{'within' if held else 'not within'} {TIMES:g}"
        lines.append(f"{row['object']}, unseen: {said} times the error on {plan.alone.name} ({within})")
    return lines


def write_page(folder: Path, plan: ObjectsPlan, rows: Sequence[Mapping], verdicts: Sequence[str]) -> Path:
    """Write ``index.html`` and its chart, and return the page's path.

    Parameters
    ----------
    folder : Path
    plan : ObjectsPlan
    rows, verdicts : sequences
        As ``table`` and ``verdicts`` give them.
    """
    alone, names, ranges = plan.alone.name, plan.experiment.targets, plan.experiment.ranges()
    labels = zip(names, readable_labels(names), strict=True)
    limits = ", ".join(f"{label} {number(ranges[name][0])} to {number(ranges[name][1])} {unit_of(name)}".rstrip() for name, label in labels)
    page = Page(f"Unseen objects: {plan.sensor.name}", "twin study objects", topic="TacTip twin: study")
    page.lead = (
        f"Two models from {number(plan.count * len(plan.train))} simulated contacts each, evaluated on {number(plan.tests)} other contacts "
        "of every object, seen or not."
    )
    page.notice("Unseen objects", verdicts)
    chart = write_chart(folder / "errors.png", lambda: errors_figure(rows, names, alone))
    caption = (
        f"Mean absolute error of each label, as a multiple of the same model's error on {alone} (dashed). Filled: the object was trained "
        f"on; open: unseen. Dotted: the target, {TIMES:g} times."
    )
    page.figures(PagePicture(chart, f"Errors of both models on every object, as multiples of their error on {alone}", caption))
    page.section("Errors")
    page.table(
        [{**row, "seen": "yes" if row["seen"] else "no"} for row in rows],
        [_column(key, names) for key in rows[0]],
        caption=f"Mean absolute errors and mean errors (bias); times: over the same model's error on {alone}.",
    )
    page.section(
        "How it was made",
        sentence(
            f"Contacts: {plan.wider.name}, {plan.randomisation.name}, {plan.across} elements across, seed {plan.seed}. Model",
            strong(MIXED),
            f"was trained on {number(plan.count)} contacts of each of {_describe_objects(plan.train)}; model",
            strong(alone),
            f"on those of this object alone. Unseen: {_describe_objects(plan.unseen)}.",
        ),
        f"Evaluated on {number(plan.tests)} other contacts of each object ({plan.experiment.name}), on all their states whose labels lie "
        f"within {limits}.",
        "A label means the same on every object: it is the label of a flat plate at the same distance from the dome's centre and with the "
        "same normal.",
    )
    page.download(folder / "objects.csv", "the table, with all digits")
    return page.write(folder / "index.html")


def errors_figure(rows: Sequence[Mapping], names: Sequence[str], alone: str) -> Figure:
    """A chart with a panel for each label: each object's error as a multiple of the error on the first object."""
    objects = list(dict.fromkeys(row["object"] for row in rows))
    figure, axes = sized_figure((4.4 * len(names) + 1.0, 0.34 * len(objects) + 1.3), len(names))
    for panel, (ax, name) in enumerate(zip(axes, names, strict=True)):
        for model, color, mark, above in ((MIXED, BLUE, "o", 0.12), (alone, RED, "s", -0.12)):
            for seen in (True, False):
                part = [row for row in rows if row["model"] == model and bool(row["seen"]) is seen]
                places = [len(objects) - 1 - objects.index(row["object"]) + above for row in part]
                label = f"trained on {'several objects' if model == MIXED else model}" if seen else None
                ax.plot([row[f"{name}_times"] for row in part], places, mark, color=color, mfc=color if seen else "none", label=label)
        ax.axvline(1.0, color=muted_colour(), ls="--", lw=1.0)
        ax.axvline(TIMES, color=muted_colour(), ls=":", lw=1.2)
        ax.set_yticks(np.arange(len(objects))[::-1], objects if panel == 0 else [])
        ax.set(xlabel=f"{readable_labels(names)[panel]}: times the error on {alone}", xlim=(0, None))
    axes[0].legend()
    return figure


def _column(key: str, names: Sequence[str]) -> Column:
    for name, label in zip(names, readable_labels(names), strict=True):
        if key in (f"{name}_error", f"{name}_bias"):
            return Column(key, f"{label} {key.removeprefix(name)[1:]}", unit_of(name), digits=2, signed=key.endswith("bias"))
        if key == f"{name}_times":
            return Column(key, f"{label} times", decimals=2)
    return Column.of(key)


def _describe_objects(objects: Sequence[ObjectSpec]) -> str:
    return "; ".join(f"{obj.name} ({obj.description})" for obj in objects)
