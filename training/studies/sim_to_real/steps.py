"""The steps of the study of what the twin is worth on real frames; each can be called alone."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes.object import ObjectSpec
from training.assemble import intervals
from training.dataset import Dataset, joined, split_rows
from training.estimator import PoseEstimator
from training.evaluate import judge, leak_check
from training.gaussian_process import fit_two_fidelities
from training.identity import identity_of
from training.loop import epoch_step
from training.models import model_named, recipe_of
from training.pins import voronoi_areas
from training.recipes import TrainingError
from training.run import RunConfig, is_finished, train_run
from training.run_files import CONFIG, TENSORS, read_tensors, write_tensors
from training.simulated import config_of, is_pins_only, open_simulated
from training.studies.sim_to_real.discrepancy import Discrepancy
from training.studies.sim_to_real.twins import contact_of
from twin.frames import open_recording
from twin.judge.labelled.model import MeasuredFrames
from twin.progress import Step
from twin.rig.labels import ArmLabel, read_arm_labels
from twin.store import write_text

TWIN_EPOCHS = 60  # of a training on thousands of simulated states; more epochs change nothing
MANY = 500  # labelled frames that a morning's work with the rig gives
RANGE_MARGIN = 0.1  # simulated states may lie beyond the labelled frames' range of a label by this part of it
MODES = 20  # of the displacements, that the quadratic regression is given
RIDGES = 10.0 ** np.arange(-4, 3.1, 0.5)  # penalties that it chooses from, by the error of each frame left out


@dataclass(frozen=True)
class Frames:
    """Which frames of a recording serve what.

    Attributes
    ----------
    test : (t,) int
        The random fifth that every model is judged on and none has seen.
    few : (n,) int
        The labelled frames, drawn at random from the others.
    trained : dict of str to (m,) int
        Frames to train on without the twin: ``few`` itself, more, and all others; each holds the ones before it.
    """

    test: np.ndarray
    few: np.ndarray
    trained: dict[str, np.ndarray]


def choose_frames(count: int, labels: int, seed: int) -> Frames:
    """Draw the frames of a recording of ``count``, which is in the order of its names.

    Raises
    ------
    TrainingError
        There are not so many.
    """
    rest, test = split_rows(count, seed)
    if labels > len(rest):
        raise TrainingError(f"--labels {labels}: the recording has {len(rest)} frames beside those that are judged on")
    order = np.random.default_rng([seed, labels]).permutation(rest)
    trained = {str(n): np.sort(order[:n]) for n in (labels, MANY) if n < len(rest)}
    return Frames(test, np.sort(order[:labels]), trained | {"all": rest})


def arm_labels(data: Dataset) -> list[ArmLabel]:
    """The arm's label of each row."""
    folder, pins = data.folder, data.pins
    recording = open_simulated(folder, pins.sensor)[0] if is_pins_only(folder) else open_recording(folder, pins.sensor, pins.form)
    labels = dict(zip(recording.names, read_arm_labels(recording), strict=True))
    return [labels[name] for name in pins.image_name.tolist()]


def with_missing(
    simulated: Dataset, labels: list[ArmLabel], discrepancy: Discrepancy, seed: int, *, progress: Step | None = None
) -> Dataset:
    """A simulated data set whose pins have moved by what the twin may miss, drawn for each contact; ``labels`` are its ``arm_labels``."""
    pins = simulated.pins
    missing_px = discrepancy.draw_px(labels, pins.nodes_px - pins.reference.pins_px, contact_of(simulated), seed)
    nodes_px = pins.nodes_px + missing_px
    return replace(simulated, pins=replace(pins, nodes_px=nodes_px, area_px2=voronoi_areas(nodes_px, pins.reference, progress=progress)))


def measured_of(part: Dataset) -> MeasuredFrames:
    """Frames of a recording with the arm's labels, as contacts are fitted to them."""
    pins_px = np.where(part.pins.lost[..., None], np.nan, part.pins.nodes_px)
    return MeasuredFrames(part.pins.form, part.pins.image_name.tolist(), arm_labels(part), pins_px, part.pins.reference.pins_px, [])


def train_in_twin(
    sim: Dataset,
    out: Path,
    *,
    seed: int,
    split: int | None,
    epochs: int | None,
    labelled: Dataset | None = None,
    progress: Step | None = None,
) -> None:
    """A run on simulated contacts, or what is left of it to do.

    Parameters
    ----------
    split : int or None
        As in ``RunConfig``.
    epochs : int or None
        None: ``TWIN_EPOCHS``.
    labelled : Dataset, optional
        The real frames that told what the simulated contacts miss.
    """
    recipe = recipe_of("vgnn", members=1, epochs=epochs or TWIN_EPOCHS, kernel=False)
    taught: dict[str, object] = {}
    if labelled is not None:
        taught = identity_of(labelled, model_named("vgnn")) | {"image_names": labelled.pins.image_name.tolist()}
    _train(RunConfig("vgnn", recipe, seed=seed, split=split, labelled=taught), sim, out, progress)


def train_on_real(real: Dataset, out: Path, *, seed: int, epochs: int | None, progress: Step | None = None) -> None:
    """A run on real frames alone, all of those given, or what is left of it to do."""
    _train(RunConfig("vgnn", recipe_of("vgnn", epochs=epochs), seed=seed, split=None), real, out, progress)


def _train(config: RunConfig, data: Dataset, out: Path, progress: Step | None) -> None:
    if not is_finished(config, data, out):
        train_run(config, data, out, progress=None if progress is None else epoch_step(progress))


def states_like(simulated: Dataset, labelled: Dataset) -> np.ndarray:
    """Rows of simulated states whose labels are about those of labelled frames.

    Raises
    ------
    TrainingError
        They are fewer than the labelled frames.
    """
    told, truth = simulated.targets.corrected, labelled.targets.corrected
    margin = RANGE_MARGIN * np.ptp(truth, axis=0)
    found = np.flatnonzero(((told >= truth.min(axis=0) - margin) & (told <= truth.max(axis=0) + margin)).all(axis=1))
    if len(found) < len(labelled):
        raise TrainingError(
            f"{len(found)} simulated states have labels like those of the {len(labelled)} labelled frames, there must be as many; "
            "simulate the experiment that the frames come from (--contacts, or another --sim), or more of it (--count)"
        )
    return found


def states_touching(parts: list[Dataset], touched: ObjectSpec) -> Dataset:
    """Of simulated data sets those of one object, joined; all of them if none is."""
    return joined([part for part in parts if config_of(part.folder).object.name == touched.name] or parts)


@dataclass(frozen=True)
class Beside:
    """What became of a run that labelled frames were put beside.

    Attributes
    ----------
    left_out : (K,) float
        Mean absolute error (mm, deg) of the Gaussian process alone, on labelled frames that are left out of it one after another.
    intervals : dict of str to array
        The intervals of the run itself, widened to what the labelled frames say of it, under their names in ``weights.pt``; see
        ``widen_intervals``.
    """

    left_out: np.ndarray
    intervals: dict[str, np.ndarray]


def put_beside(run: Path, out: Path, simulated: Dataset, labelled: Dataset, *, seed: int) -> Beside:
    """Write the average of a run of ``vgnn`` and a Gaussian process that knows labelled frames, as a run, to ``out``.

    The run ``run`` stays as it is. The two models err differently. Labelled frames can't tell how much each is to count, because both
    have learnt from them, so the average is plain. The intervals of ``out`` are those of the average.

    Simulated contacts make the intervals of ``run`` too narrow. What is returned has them widened to the run's errors on the labelled
    frames, and to those of the process on frames that are left out of it one after another.

    Parameters
    ----------
    run : Path
        Folder of the finished run.
    out : Path
        Folder of the new run; made if missing.
    simulated : Dataset
        Contacts as the bare specification has them, with labels like the labelled frames' (``states_like``).
    labelled : Dataset
        n frames.
    seed : int
        Of the simulated states drawn.

    Raises
    ------
    TrainingError
        ``run`` and ``out`` are the same folder.
    """
    if run.resolve() == out.resolve():
        raise TrainingError(f"{run}: a run can't be written over itself; give another folder for the run with labelled frames beside it")
    estimator = PoseEstimator.load(run)
    ensemble, labels = estimator.ensemble, estimator.config["labels"]
    inputs, rows = estimator.inputs_of(labelled.pins, together=not labelled.pins.measured)
    mean, scale, executed = ensemble.outputs(inputs, rows)
    seen = ensemble.modes(inputs, rows).inputs
    known = ensemble.modes(*estimator.inputs_of(simulated.pins, together=not simulated.pins.measured)).inputs
    truth, raw, told = (
        (values - ensemble.shift) / ensemble.scale
        for values in (getattr(labelled.targets, labels), labelled.targets.raw, getattr(simulated.targets, labels))
    )
    process, alone = fit_two_fidelities(known, told, seen, truth, seed=seed)
    content = read_tensors(run / TENSORS)
    missed = [intervals(made, truth, raw, scale, executed) for made in (mean, alone)]
    wider = {key: np.maximum.reduce([content[key].numpy(), *(said[key] for said in missed)]) for key in missed[0]}
    content |= intervals((mean + alone) / 2, truth, raw, scale, executed) | {"beside": process.arrays()}
    out.mkdir(parents=True, exist_ok=True)
    write_tensors(out / TENSORS, content)
    about = {"data": str(labelled.folder), "frames": labelled.pins.image_name.tolist()}
    write_text(out / CONFIG, json.dumps(estimator.config | {"beside": about}, indent=1) + "\n")
    return Beside(np.abs(alone - truth).mean(axis=0) * ensemble.scale, wider)


def widen_intervals(run: Path, wider: dict[str, np.ndarray]) -> None:
    """Change a finished run: its intervals become those given (``Beside.intervals``). Its estimates stay as they are.

    Doing it once more with the same intervals changes nothing.
    """
    content = read_tensors(run / TENSORS)
    write_tensors(run / TENSORS, content | wider)


def judged(name: str, labelled: int, run: Path, real: Dataset, test: np.ndarray) -> dict[str, Any]:
    """A row of the study's table: mean errors of a run on the frames that are judged on."""
    estimator = PoseEstimator.load(run)
    found = judge(estimator.predict_rows(real, test), real, test)
    row = {"trained_on": name, "labelled_frames": labelled, "model": estimator.model}
    for kind in ("corrected", "raw"):
        row |= {f"{label}_{kind}": found[kind][label]["mae"] for label in real.targets.names}
    inside = {f"{label}_inside_90": found["corrected"][label]["coverage_90"] for label in real.targets.names}
    return row | inside | {"leak_slope": found["leak_slope"]}


def quadratic_row(name: str, real: Dataset, rows: np.ndarray, test: np.ndarray) -> dict[str, Any]:
    """The same of the plainest model: ridge regression on the displacements' first modes and their products."""
    moved = (real.pins.nodes_px - real.pins.reference.pins_px).reshape(len(real), -1)
    middle = moved[rows].mean(axis=0)
    _, sizes, directions = np.linalg.svd(moved[rows] - middle, full_matrices=False)
    keep = min(MODES, len(rows) - 1)
    modes = (moved - middle) @ directions[:keep].T * np.sqrt(len(rows)) / sizes[0]
    i, j = np.triu_indices(keep)
    x = np.concatenate([np.ones((len(real), 1)), modes, modes[:, i] * modes[:, j]], axis=1)
    known, shift = real.targets.corrected[rows], real.targets.corrected[rows].mean(axis=0)
    made = np.empty((len(test), known.shape[1]))
    left, sizes, right = np.linalg.svd(x[rows], full_matrices=False)
    for k in range(known.shape[1]):
        y, best = known[:, k] - shift[k], np.inf
        for ridge in RIDGES:
            shrunk = sizes**2 / (sizes**2 + ridge)
            fitted = left @ (shrunk * (left.T @ y))
            error = np.abs((y - fitted) / (1 - (left**2) @ shrunk)).mean()  # each frame left out
            if error < best:
                best = error
                made[:, k] = x[test] @ (right.T @ (shrunk / sizes * (left.T @ y))) + shift[k]
    row = {"trained_on": name, "labelled_frames": len(rows), "model": "quadratic regression"}
    targets = real.targets.rows(test)
    for kind in ("corrected", "raw"):
        errors = np.abs(made - getattr(targets, kind)).mean(axis=0)
        row |= {f"{label}_{kind}": float(error) for label, error in zip(targets.names, errors, strict=True)}
    return row | {"leak_slope": leak_check(made, targets).slope}
