"""The paper's whole comparison, from its plan to its tables, figures and page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenes import SensorSpec
from training.data.dataset import Dataset, load_dataset
from training.models import model_named
from training.runs.networks import choose_device
from training.studies.tac_vgnn.contacts import AreaChange, compare_graphs, contacts_figure, recorded_contacts, twin_contacts
from training.studies.tac_vgnn.models import SHOWN, PlannedRun, error_columns, measure_training, plan_run, table_row, train_all
from training.studies.tac_vgnn.page import curves_figure, efficiency_figure, write_page
from twin.errors import OptionError
from twin.estimate import readable_labels
from twin.progress import Progress, silent, stage
from twin.report.charts import write_chart
from twin.report.table import write_table
from twin.store import writes
from twin.types import Form, ReadableResult

MODELS = ("gnn", "tac-vgnn", "vgnn", "cnn-v2", "cnn-v1")
# Batch sizes of the efficiency figure.
BATCHES = (64, 256, 512)

FILES = (
    "index.html",
    *(f"{name}{ending}" for name in ("models", "graphs", "curves", "efficiency", "contacts") for ending in (".csv", ".png", "-dark.png")),
)


@dataclass(frozen=True)
class TacVgnnPlan:
    """Settings of the comparison.

    Attributes
    ----------
    data : Path
        A labelled recording.
    sensor : SensorSpec
    models : tuple of str
        Names of models, as ``plan_run`` takes them.
    seeds : tuple of int
        Seeds of the weights and of the order of rows; every model is trained with each seed.
    labels : {"raw", "corrected"}
        Kind of labels that are trained on.
    target : str or tuple of str
        A preset, or the label columns.
    split : int
        Seed of the random fifth of the rows that is kept out of training.
    epochs : int or None
        Number of epochs; None: each model's own number.
    max_minutes : float or None
        Time for all trainings together.
    batches : tuple of int
        Batch sizes of the efficiency figure; if empty, there is no figure.
    contacts : bool
        Simulate and render the contacts of the area figure.
    device : {"auto", "cpu", "cuda"}
    threads : int or None
        Number of CPU threads.
    form : Form or None
        Form of the frames; None: recognised by size and content.
    """

    data: Path
    sensor: SensorSpec
    models: tuple[str, ...] = MODELS
    seeds: tuple[int, ...] = (0,)
    labels: str = "raw"
    target: str | tuple[str, ...] = "surface-2d"
    split: int = 0
    epochs: int | None = None
    max_minutes: float | None = None
    batches: tuple[int, ...] = BATCHES
    contacts: bool = True
    device: str = "auto"
    threads: int | None = None
    form: Form | None = None

    def __post_init__(self) -> None:
        if self.labels not in ("corrected", "raw"):
            raise OptionError(f"`label_kind` must be corrected or raw, got {self.labels!r}")
        if not self.models or not self.seeds:
            raise OptionError("nothing to compare: give at least one of `models` and of `seeds`")
        if any(batch < 1 for batch in self.batches):
            raise OptionError(f"`batches` {','.join(map(str, self.batches))}: a batch has at least 1 frame")

    def runs(self) -> list[PlannedRun]:
        """Every run of the study."""
        return [
            plan_run(name, labels=self.labels, seed=seed, split=self.split, epochs=self.epochs)
            for seed in self.seeds
            for name in self.models
        ]


@dataclass(frozen=True, repr=False)
class TacVgnnResult(ReadableResult):
    """The result of the comparison.

    Attributes
    ----------
    rows : list of dict
        A row for each run, see ``table_row``.
    graphs, efficiency, contacts : list of dict
        Rows of the other tables; the last two are empty if they were not requested.
    names : tuple of str
        Names of the labels.
    frames : int
        Labelled frames that the models were trained on and were evaluated on.
    written : list of Path
    """

    rows: list[dict[str, Any]]
    graphs: list[dict[str, Any]]
    efficiency: list[dict[str, Any]]
    contacts: list[dict[str, Any]]
    names: tuple[str, ...]
    frames: int
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text: the number of frames, then one for each run."""
        runs = [f"{row['model']}, seed {row['seed']}: {row['state']}{self._errors(row)}" for row in self.rows]
        return [f"{self.frames} labelled frames", *runs]

    def _errors(self, row: dict[str, Any]) -> str:
        if "epochs" not in row:
            return ""
        known = zip(self.names, readable_labels(self.names), strict=True)
        return ", " + "; ".join(f"{label} {row[f'{k}_raw']:.4g} raw, {row[f'{k}_corrected']:.4g} corrected" for k, label in known)


@writes(*FILES)
def run(plan: TacVgnnPlan, out: Path, *, progress: Progress = silent) -> TacVgnnResult:
    """Compare graphs, models and training efficiency, and show the Voronoi areas of contacts.

    Writes ``runs/``, ``models.csv``, ``graphs.csv``, ``efficiency.csv``, ``contacts.csv``, their figures and ``index.html`` to ``out``.
    An interrupted run is continued.

    Raises
    ------
    TrainingError
        A model or the device does not exist, or a folder holds another run.
    """
    device, runs = choose_device(plan.device), plan.runs()
    if plan.threads:
        torch.set_num_threads(plan.threads)
    with stage(progress, "frames") as step:
        data = load_dataset(plan.data, plan.sensor, plan.target, form=plan.form, progress=step)
    folder = out / "runs"
    graphs = compare_graphs(data.pins)
    spent = train_all(runs, data, folder, max_minutes=plan.max_minutes, device=device, progress=progress)
    rows = [table_row(each, data, folder, spent.get(each.folder)) for each in runs]
    written = [
        write_table(out / "models.csv", rows),
        write_table(out / "graphs.csv", graphs),
        write_chart(out / "curves.png", lambda: curves_figure(runs, folder)),
    ]
    efficiency = _efficiency(plan, runs, data, device, progress)
    if efficiency:
        chart = write_chart(out / "efficiency.png", lambda: efficiency_figure(efficiency))
        written += [write_table(out / "efficiency.csv", efficiency), chart]
    changes = _contacts(plan, data, progress)
    contacts = [change.figures() for change in changes]
    if contacts:
        written += [write_table(out / "contacts.csv", contacts), write_chart(out / "contacts.png", lambda: contacts_figure(changes))]
    notes = {"device": device, "threads": torch.get_num_threads(), "labels": plan.labels, "max_minutes": plan.max_minutes}
    notes["columns"] = [*SHOWN, *error_columns(data)]
    written.append(write_page(out, data=data, models=rows, graphs=graphs, efficiency=efficiency, contacts=contacts, notes=notes))
    return TacVgnnResult(rows, graphs, efficiency, contacts, data.targets.names, len(data), written)


def _efficiency(plan: TacVgnnPlan, runs: list[PlannedRun], data: Dataset, device: str, progress: Progress) -> list[dict[str, Any]]:
    """Time and memory of training for each model and batch size."""
    if not plan.batches:
        return []
    models, rows = list(dict.fromkeys(each.config.model for each in runs)), []
    with stage(progress, "training efficiency") as step:
        for model in models:
            inputs = model_named(model).prepare(data, np.arange(len(data))).inputs
            for batch in plan.batches:
                rows.append(measure_training(model, data.pins, inputs, batch, device=device))
                step(len(rows), len(models) * len(plan.batches))
    return rows


def _contacts(plan: TacVgnnPlan, data: Dataset, progress: Progress) -> list[AreaChange]:
    """Contacts of the twin if they are asked for, and recorded contacts."""
    recorded = recorded_contacts(data)
    if not plan.contacts:
        return recorded
    with stage(progress, "contacts") as step:
        return twin_contacts(data.pins.sensor, data.pins.form, progress=step) + recorded
