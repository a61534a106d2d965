"""Training of a model in one call: it reads and joins labelled recordings, and trains on them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from scenes import SensorSpec
from training.data.dataset import Dataset, join_datasets, load_dataset, with_common_labels
from training.data.simulated import is_simulated
from training.data.targets import CONTACT, PRESETS, SHEAR, TURN
from training.estimate.domain import learn_domain, write_domain
from training.estimate.estimator import PoseEstimator
from training.estimate.rest import learn_displacements, write_displacements
from training.models import TOUCH, model_named, recipe_of
from training.models.part import LIKELY
from training.runs.config import RunConfig, training_labels, training_rows
from training.runs.loop import choose_device
from training.runs.run import RUN_FILES, train_run
from training.runs.run_files import BESIDE_FILES, CHECKPOINT, DISPLACEMENTS, DOMAIN, MAPS, SLIP
from training.touch.contact_maps import FEWEST_STATES, learn_maps, write_maps
from training.touch.contact_probability import TouchAnswer
from training.touch.slip import FEWEST_DRAGS, CapView, learn_slip, name_drags, write_slip
from twin.errors import OptionError
from twin.estimate import readable_labels
from twin.progress import Progress, silent, stage
from twin.store import writes
from twin.types import Form, ReadableResult

SHEAR_PRESET = "surface-2d-shear"  # the preset whose moves are learnt as helper labels
FILES = (*RUN_FILES, *BESIDE_FILES)  # files of a finished run


@dataclass(frozen=True, repr=False)
class TrainedRun(ReadableResult):
    """A training run and its recordings.

    Attributes
    ----------
    out : Path
        The run's folder.
    finished : bool
        Whether training is finished; if not, the same call continues it.
    frames : int
        Number of usable frames.
    names : tuple of str
        The label columns.
    labels : str
        Kind of labels: corrected or raw.
    problems : list of str
        Irregularities of the recordings.
    """

    out: Path
    finished: bool
    frames: int
    names: tuple[str, ...]
    labels: str
    problems: list[str]

    @property
    def written(self) -> list[Path]:
        """The run's files."""
        return [self.out / name for name in FILES if (self.out / name).is_file()]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"note: {problem}" for problem in self.problems]
        lines.append(f"{self.frames} usable frames; labels {', '.join(readable_labels(self.names))} ({self.labels})")
        if not self.finished:
            lines.append(f"time is up: the weights so far are in {self.out}; the same command resumes from here")
        return lines


@writes(*FILES, gone_on=(CHECKPOINT,))
def train_model(
    model: str,
    sensor: SensorSpec,
    recordings: Sequence[Path],
    out: Path,
    *,
    target: str = "surface-2d",
    labels: str = "corrected",
    seed: int = 0,
    split: int | None = 0,
    epochs: int | None = None,
    batch: int | None = None,
    members: int | None = None,
    kernel: bool | None = None,
    max_minutes: float | None = None,
    threads: int | None = None,
    device: str = "auto",
    form: Form | None = None,
    progress: Progress = silent,
) -> TrainedRun:
    """Train a model on labelled recordings, or continue the run in ``out``.

    Parameters
    ----------
    model : str
        Name as for ``recipe_of``.
    recordings : sequence of Path
        Several recordings are joined to one data set.
    target : str
        A preset's name, or label columns separated by commas.
    labels : {"corrected", "raw"}
    seed : int
        Seed of the weights and of the order of rows.
    split : int or None
        Seed of the random fifth of the rows that is kept out of training; None: train on all rows.
    epochs, batch, members, kernel : optional
        Values that replace the recipe's own.
    max_minutes : float, optional
        Stop after the epoch in which this time has passed.
    threads : int, optional
        Number of CPU threads.
    device : {"auto", "cpu", "cuda"}
    form : Form, optional
        Form of the frames; recognised by size and content by default.

    Raises
    ------
    OptionError
        ``device`` has no such value, or there are no such labels.
    TrainingError
        There is no such model, PyTorch finds no GPU for ``cuda``, or ``out`` holds another run.
    FrameError
        The recordings have no such labels, or can't be joined.
    """
    if labels not in ("corrected", "raw"):
        raise OptionError(f"`label_kind` must be corrected or raw, got {labels!r}")
    recipe = recipe_of(model, epochs=epochs, batch=batch, members=members, kernel=kernel)
    if threads:
        torch.set_num_threads(threads)
    chosen, parts = choose_device(device), []
    for folder in recordings:
        with stage(progress, f"frames of {folder.name}") as step:
            parts.append(load_dataset(folder, sensor, columns_of(target), form=form, progress=step))
    found = join_datasets(with_common_labels(parts) if target == CONTACT else parts)
    config = RunConfig(model, recipe, labels, seed, split, (SHEAR, TURN) if target == SHEAR_PRESET else ())
    with stage(progress, model) as step:
        finished = train_run(config, found, out, max_minutes=max_minutes, device=chosen, progress=step)
    if finished and config.model == TOUCH.name and all(is_simulated(folder) for folder in found.folders):
        with stage(progress, "contact maps"):
            found.problems.extend(add_maps(out, config, found))
        with stage(progress, "slip"):
            found.problems.extend(add_slip(out, config, parts))
    if finished:
        add_displacements(out, config, found)
        add_domain(out, config, found)
    return TrainedRun(out, finished, len(found), found.targets.names, labels, found.problems)


def add_maps(run: Path, config: RunConfig, data: Dataset) -> list[str]:
    """Learn contact maps from the simulated contacts that a finished run was trained on, and write them beside its weights.

    Returns
    -------
    list of str
        The reason why there are no maps, at most one line.
    """
    data = data.in_order()
    rows, estimator = training_rows(config, data), PoseEstimator.load(run)
    if len(rows) < FEWEST_STATES:
        return [f"too few contact states to train contact maps ({len(rows)}; {FEWEST_STATES} are needed): the run has none"]
    write_maps(run / MAPS, learn_maps(estimator.modes_of(data.pins), data, rows, seed=config.seed))
    return []


def add_displacements(run: Path, config: RunConfig, data: Dataset) -> None:
    """Learn how contacts displace the pins from the frames that a finished run was trained on, and write the model beside its weights.

    Nothing is written if the model does not use displacements from rest, the pins at rest were not measured, or there are too few frames.
    """
    if not (model_named(config.model).counts_from_rest and data.pins.measured):
        return
    pins = data.in_order().pins.rows(training_rows(config, data.in_order()))
    if (known := learn_displacements(pins.nodes_px - pins.reference.pins_px)) is not None:
        write_displacements(run / DISPLACEMENTS, known)


def add_domain(run: Path, config: RunConfig, data: Dataset) -> None:
    """Learn the domain from the frames that a finished run was trained on, and write it beside its weights.

    Nothing is written if there are too few frames.
    """
    data = data.in_order()
    rows, estimator = training_rows(config, data), PoseEstimator.load(run)
    pins, targets = data.pins.rows(rows), data.targets.rows(rows)
    moved = (pins.nodes_px - pins.reference.pins_px) / pins.reference.spacing_px.mean()
    least = np.median(estimator.predict_rows(data, rows).half_width, axis=0)
    touched = TouchAnswer(pins.reference)
    apart = np.array([touched(nodes_px, lost) < LIKELY for nodes_px, lost in zip(pins.nodes_px, pins.lost, strict=True)])
    # A state before first touch has a label, but no pattern of its own.
    labels = np.where(apart[:, None], np.nan, training_labels(data, config)[rows])
    group = None if data.group is None else data.group[rows]
    simulated = not config.labelled and all(is_simulated(folder) for folder in data.folders)
    known = learn_domain(
        moved, labels, pins.reference, targets.units, least=least, lost=pins.lost, group=group, simulated=simulated, seed=config.seed
    )
    if known is not None:
        write_domain(run / DOMAIN, known)


def add_slip(run: Path, config: RunConfig, parts: Sequence[Dataset]) -> list[str]:
    """Learn slip from the drags among the simulated contacts that a finished run was trained on, and write it beside the weights.

    Parameters
    ----------
    parts : sequence of Dataset
        The data sets before they were joined.

    Returns
    -------
    list of str
        The reason why slip was not trained, at most one line.
    """
    estimator = PoseEstimator.load(run)
    kept_out = set(estimator.config["rows"]["kept_out"])
    drags = [drag for _, names, drag in name_drags(parts) if kept_out.isdisjoint(names)]
    slide = sum(np.isfinite(drag.whole_mm) for drag in drags)
    if slide < FEWEST_DRAGS:
        return [
            f"too few contacts are dragged until they slide ({slide}; {FEWEST_DRAGS} are needed): slip is not estimated over time; "
            "'twin dataset --experiment drag --randomise drag --states all' makes such contacts"
        ]
    sensor = parts[0].pins.sensor
    write_slip(run / SLIP, learn_slip(drags, CapView(estimator.modes_of, parts[0].pins), sensor, seed=config.seed))
    return []


def columns_of(target: str) -> str | tuple[str, ...]:
    """The ``columns`` of ``load_dataset``: the name of a preset, or a tuple of column names that are separated by commas.

    Raises
    ------
    OptionError
        A name occurs twice, or there is no name.
    """
    names = tuple(name.strip() for name in target.split(",") if name.strip())
    if not names or len(set(names)) < len(names):
        raise OptionError(f"`target` {target}: give a preset, or label columns with commas between, each once")
    return target if target in (*PRESETS, CONTACT) else names
