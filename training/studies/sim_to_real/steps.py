"""The plan of the sim-to-real study, the names in its tables, and its steps. Each step can be called alone.

``Twin`` is one twin of the study: the one with all ingredients, or one without one ingredient.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes import ExperimentSpec, ObjectSpec, RandomisationSpec, RigSpec, SensorSpec, load_experiment, load_object, load_randomisation
from scenes.experiment import MoveRanges
from scenes.randomisation import FrictionSpread
from training.data.audit import polynomials
from training.data.dataset import Dataset, join_datasets, load_dataset, split_rows
from training.data.design import nearest_to_even
from training.data.label_code import LabelCode, goes_round, label_error
from training.data.pins import voronoi_areas
from training.data.simulated import config_of, is_pins_only, is_simulated, open_simulated
from training.data.targets import Targets
from training.errors import TrainingError
from training.estimate.contact_estimator import DisplacementModes
from training.estimate.estimator import PoseEstimator
from training.generation import GenerationConfig, generate, require_count
from training.models import STEERED, VGNN, model_named, recipe_of
from training.runs.assemble import intervals
from training.runs.config import RunConfig, frame_marks, identity_of
from training.runs.gaussian_process import fit_two_fidelities
from training.runs.run import is_finished, train_run
from training.runs.run_files import CONFIG, TENSORS, read_tensors, write_tensors
from training.studies.judging import leak_check
from training.studies.sim_to_real.discrepancy import FRICTIONS, Discrepancy
from twin.errors import DatasetError
from twin.evaluation.labelled.model import MeasuredFrames
from twin.frames import open_recording
from twin.progress import Progress, Step, stage, unheard
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel, poses_and_moves, read_arm_labels
from twin.store import output, overwriting, write_text, writes
from twin.types import FINE, Form

FULL = "sim_only"
"""Name and folder of the twin with all ingredients."""
MOST_DRAWS = 1000
"""Most draws of what the twin misses, for each contact. More would not fit into memory."""
REAL, BOTH = "real", "simulated and real"
"""Names of rows of models that were trained on real frames alone, and from simulated contacts and real frames."""
EVENLY = ", even"
"""What is added to these where the frames are not sampled at random, but nearest to an even sequence."""
WITHOUT = ", {count} without labels"
"""What is added to these where the model also learnt from ``count`` frames without labels."""
# Elements across the skin of the twin with a coarse mesh.
COARSE = 12
# Share of the contacts that the twin with few contacts is trained on.
FEW = 0.2
# Angle in deg to whose multiples the axes of an uncalibrated sensor are rounded.
QUARTER_DEG = 90.0
# Epochs of a training on thousands of simulated states. More epochs do not change the errors.
TWIN_EPOCHS = 60
# Number of labelled frames that can be recorded with the rig in a morning.
MANY = 500
# Numbers of labelled frames that models are compared with, beside the study's own number and ``MANY``.
COUNTS = (5, 10, 20, 100)
# Number of frames, nearest to an even sequence, of which the first ones are taken where labels are designed.
DESIGNED = (5, 10, 20, 40, 100)
# Share of the labelled frames' range of a label by which simulated states may lie outside of it.
RANGE_MARGIN = 0.1
# Number of modes of the displacements that are inputs of the quadratic regression.
MODES = 20
# Penalties of the quadratic regression that are tried; the one with the smallest leave-one-out error is used.
RIDGES = 10.0 ** np.arange(-4, 3.1, 0.5)


@dataclass(frozen=True)
class SimToRealPlan:
    """Settings of a study.

    Attributes
    ----------
    sensor : SensorSpec
    frames : Path
        A labelled real recording.
    experiment : ExperimentSpec
        The experiment that the recording was made with. It also names the labels that are trained on.
    contacts : ExperimentSpec or None
        The experiment that is simulated; None: ``experiment`` with its wider ranges.
    labels : int
        Number of labelled frames that are used with the simulated contacts.
    seed : int
        Seed of the choice of frames, the contacts and the weights.
    draws : int
        Number of discrepancies that are sampled for each contact.
    count : int
        Number of contacts to simulate.
    simulated : tuple of Path
        Finished data sets to use instead of simulating contacts for the twin with all ingredients; several are joined.
    calibrate : bool
        Fit the specification to the labelled frames first.
    ablate : bool
        Also train without one ingredient at a time.
    epochs : int or None
        Epochs of every training; None: the default of that training.
    workers : int
        Processes that simulate.
    across : int
        Elements along each side of the skin's grid.

    Raises
    ------
    DatasetError
        ``draws`` or ``count`` is out of range.
    TrainingError
        A folder of ``simulated`` holds no simulated data set.
    """

    sensor: SensorSpec
    frames: Path
    experiment: ExperimentSpec
    contacts: ExperimentSpec | None = None
    labels: int = 40
    seed: int = 0
    draws: int = 2
    count: int = 500
    simulated: tuple[Path, ...] = ()
    calibrate: bool = False
    ablate: bool = False
    epochs: int | None = None
    workers: int = 1
    across: int = FINE

    def __post_init__(self) -> None:
        require_count(self.count)
        if not 1 <= self.draws <= MOST_DRAWS:
            raise DatasetError(f"`draws` {self.draws}: expected 1 to {MOST_DRAWS} for each contact")
        for folder in self.simulated:
            if not is_simulated(folder):
                raise TrainingError(f"`sim` {folder}: no simulated data set; give the folder of one that 'twin dataset' has finished")

    @property
    def target_object(self) -> ObjectSpec:
        """The object of the recording's experiment."""
        return load_object(self.experiment.object)

    @property
    def wider(self) -> ExperimentSpec:
        """The experiment that is simulated."""
        if self.contacts is not None:
            return self.contacts
        return load_experiment(self.experiment, wide=bool(self.experiment.wide or self.experiment.wider))


@dataclass(frozen=True)
class Twin:
    """How contacts are simulated, and which of them are used for training.

    Attributes
    ----------
    name : str
        Name of the run's folder.
    says : str
        Name in the study's table.
    contacts : str
        Name of the set of contacts; several twins may have the same set.
    randomisation : RandomisationSpec
    across : int
        Elements along each side of the skin's grid.
    learns : bool
        Whether a discrepancy is fitted to the labelled frames and added to the pins.
    share : float
        Share of the set's contacts, the first ones, that are used for training.
    """

    name: str
    says: str
    contacts: str
    sensor: SensorSpec
    experiment: ExperimentSpec
    randomisation: RandomisationSpec
    across: int
    learns: bool = True
    share: float = 1.0

    @property
    def frictions(self) -> tuple[float, ...]:
        """The frictions with which labelled frames are simulated, so that the residuals do not include the effect of friction."""
        return FRICTIONS if self.randomisation.friction else (rig_of(self.sensor).friction,)

    def config(self, obj: ObjectSpec, seed: int) -> GenerationConfig:
        """Configuration of the twin's contacts, without pictures."""
        parts: dict[str, Any] = {"sensor": self.sensor, "object": obj, "experiment": self.experiment, "randomisation": self.randomisation}
        return GenerationConfig(**parts, friction=rig_of(self.sensor).friction, seed=seed, images="none", states="all", across=self.across)

    def simulated_sets(self, plan: SimToRealPlan, out: Path, sensor: SensorSpec, form: Form, progress: Progress) -> list[Dataset]:
        """Contacts as a sensor's data sets: for the full twin the plan's finished ones; if there are none, one simulated to ``out``."""
        folders = list(plan.simulated) if self.name == FULL else []
        if not folders:
            folders = [out / self.contacts]
            with stage(progress, f"{self.name}: {self.experiment.name}") as step:
                generate(folders[0], self.config(plan.target_object, plan.seed), plan.count, workers=plan.workers, progress=step)
        found = []
        for folder in folders:
            with stage(progress, f"states of {folder.name}") as step:
                found.append(load_dataset(folder, sensor, plan.experiment.targets, form=form, progress=step))
        return found

    def part(self, contacts: Dataset) -> Dataset:
        """The states of the contacts that are used for training."""
        group = contact_of(contacts)
        numbers = np.unique(group)
        return contacts.rows(np.flatnonzero(np.isin(group, numbers[: int(np.ceil(self.share * len(numbers)))])))


def contact_of(simulated: Dataset) -> np.ndarray:
    """(M,) int: the number of the contact that each state of a simulated data set belongs to.

    Raises
    ------
    TrainingError
        The data set is not one of simulated contacts.
    """
    if simulated.group is None:
        raise TrainingError(f"{', '.join(map(str, simulated.folders))}: no simulated contacts; give a data set of 'twin dataset'")
    return simulated.group.astype(int)


def full_twin(plan: SimToRealPlan, sensor: SensorSpec, labels: Sequence[ArmLabel], friction: FrictionSpread | None) -> Twin:
    """The twin with all ingredients; if all moves of the labels were executed, it executes all moves, too."""
    changes = {"friction": friction} | ({"executed_share": 1.0} if all(label.executed for label in labels) else {})
    return Twin(FULL, "simulated", "sim", sensor, plan.wider, load_randomisation("moves").model_copy(update=changes), plan.across)


def without_one_ingredient(
    full: Twin, uncalibrated: SensorSpec, any_friction: RandomisationSpec, every_tolerance: RandomisationSpec
) -> list[Twin]:
    """Twins that differ from ``full`` in one ingredient each.

    Parameters
    ----------
    uncalibrated : SensorSpec
        The sensor without any measurement of labelled frames; see ``as_mounted``.
    any_friction : RandomisationSpec
        Draws friction from a range that does not depend on labelled frames.
    every_tolerance : RandomisationSpec
        Also draws properties of skin and gel.
    """

    def but(name: str, says: str, *, shared: bool = False, **changes: Any) -> Twin:
        return replace(full, name=f"sim_{name}", says=says, contacts=full.contacts if shared else name, **changes)

    wide = every_tolerance.model_copy(update={"friction": full.randomisation.friction})
    still = full.experiment.model_copy(update={"move": MoveRanges()})
    return [
        but("bare", "simulated, bare", shared=True, learns=False),
        but("few", f"simulated, {FEW:.0%} of the contacts", shared=True, share=FEW),
        but("coarse", f"simulated, {COARSE} elements across", across=COARSE),
        but("one_friction", "simulated, one friction", randomisation=full.randomisation.model_copy(update={"friction": None})),
        but("any_friction", "simulated, any friction", randomisation=any_friction),
        but("taps", "simulated, without moves", experiment=still),
        but("tolerances", f"simulated, randomised as '{every_tolerance.name}'", randomisation=wide),
        but("uncalibrated", "simulated, uncalibrated", sensor=uncalibrated, learns=False),
    ]


def as_mounted(sensor: SensorSpec) -> SensorSpec:
    """The sensor as known before any measurement: its turn about its axis to a quarter turn, and the tool point at the tip."""
    rig = rig_of(sensor)
    quarter = QUARTER_DEG * round(rig.image_turn_deg / QUARTER_DEG)
    plain = RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm, turn_sign=rig.turn_sign, image_turn_deg=quarter)
    return sensor.model_copy(update={"rig": plain})


@dataclass(frozen=True)
class StudyFrames:
    """Which frames of a recording are used for what.

    Attributes
    ----------
    test : (t,) int
        A random fifth, on which all models are evaluated and none is trained.
    few : (n,) int
        The labelled frames, sampled at random from the others.
    trained : dict of str to (m,) int
        Frames to train on without the twin: ``few``, more of them, and all that are not evaluated on. Each set contains those before it.
    nested : list of (m,) int
        Sets of ``COUNTS`` frames, with ``few`` among them, for models that learn at once. Each contains those before it.
    """

    test: np.ndarray
    few: np.ndarray
    trained: dict[str, np.ndarray]
    nested: list[np.ndarray]


def choose_frames(count: int, labels: int, seed: int) -> StudyFrames:
    """Draw the frames of a recording of ``count``, which is in the order of its names.

    Raises
    ------
    TrainingError
        The recording has fewer frames than requested.
    """
    rest, test = split_rows(count, seed)
    if labels > len(rest):
        raise TrainingError(f"`num_labelled` {labels}: the recording has {len(rest)} frames beside those that are evaluated on")
    order = np.random.default_rng([seed, labels]).permutation(rest)
    trained = {str(n): np.sort(order[:n]) for n in (labels, MANY) if n < len(rest)}
    nested = [np.sort(order[:n]) for n in sorted({*COUNTS, labels, MANY}) if n < len(rest)]
    return StudyFrames(test, np.sort(order[:labels]), trained | {"all": rest}, nested)


def designed_frames(real: Dataset, chosen: StudyFrames, seed: int) -> list[np.ndarray]:
    """Sets of ``DESIGNED`` frames that are not evaluated on, nearest to contacts that are spread evenly; each contains those before it."""
    pool = chosen.trained["all"]
    numbers = [count for count in DESIGNED if count < len(pool)]
    order = pool[nearest_to_even(real.targets.corrected[pool], real.targets.units, max(numbers, default=0), seed=seed)]
    return [order[:count] for count in numbers]


def arm_labels(data: Dataset) -> list[ArmLabel]:
    """The arm's label of each row."""
    folder, pins = data.folder, data.pins
    recording = open_simulated(folder, pins.sensor)[0] if is_pins_only(folder) else open_recording(folder, pins.sensor, pins.form)
    labels = dict(zip(recording.names, read_arm_labels(recording), strict=True))
    return [labels[name] for name in pins.image_name.tolist()]


def stands_and_moves(labels: Sequence[ArmLabel]) -> np.ndarray:
    """(K, 12) where the arm stands, and the move that it made, mm and deg."""
    return np.hstack(poses_and_moves(labels))


def with_missing(simulated: Dataset, labels: list[ArmLabel], discrepancy: Discrepancy, seed: int, *, progress: Step = unheard) -> Dataset:
    """A simulated data set with a discrepancy, sampled for each contact, added to its pins; ``labels`` are its ``arm_labels``."""
    pins = simulated.pins
    missing_px = discrepancy.draw_px(labels, pins.nodes_px - pins.reference.pins_px, contact_of(simulated), seed)
    nodes_px = pins.nodes_px + missing_px
    return replace(simulated, pins=replace(pins, nodes_px=nodes_px, area_px2=voronoi_areas(nodes_px, pins.reference, progress=progress)))


def measured_of(part: Dataset) -> MeasuredFrames:
    """Frames of a recording with the arm's labels, in the form that fits of contacts take."""
    pins_px = np.where(part.pins.lost[..., None], np.nan, part.pins.nodes_px)
    return MeasuredFrames(part.pins.form, part.pins.image_name.tolist(), arm_labels(part), pins_px, part.pins.reference.pins_px, [])


def model_for(data: Dataset) -> str:
    """The model that is trained: ``steered`` where one label is a direction that goes round the whole circle, else ``vgnn``."""
    turning = goes_round(data.targets.units, data.targets.corrected)
    return STEERED.name if sum(turning) == 1 else VGNN.name


def train_in_twin(
    sim: Dataset, out: Path, *, seed: int, split: int | None, epochs: int | None, labelled: Dataset | None = None, progress: Step = unheard
) -> None:
    """Train a run on simulated contacts, or continue it.

    Parameters
    ----------
    split : int or None
        As in ``RunConfig``.
    epochs : int or None
        None: ``TWIN_EPOCHS``.
    labelled : Dataset, optional
        The real frames that determined what the simulated contacts miss.
    """
    model = model_for(sim)
    recipe = recipe_of(model, members=1, epochs=epochs or TWIN_EPOCHS, kernel=False)
    taught = {} if labelled is None else identity_of(labelled, model_named(model)) | {"image_names": labelled.pins.image_name.tolist()}
    _train(RunConfig(model, recipe, seed=seed, split=split, labelled=taught), sim, out, progress)


def train_on_real(real: Dataset, out: Path, *, seed: int, epochs: int | None, progress: Step = unheard) -> None:
    """Train a run on all of the given real frames alone, or continue it."""
    model = model_for(real)
    _train(RunConfig(model, recipe_of(model, epochs=epochs), seed=seed, split=None), real, out, progress)


def _train(config: RunConfig, data: Dataset, out: Path, progress: Step) -> None:
    if not is_finished(config, data, out):
        train_run(config, data, out, progress=progress)


def states_like(simulated: Dataset, labelled: Dataset) -> np.ndarray:
    """Rows of simulated states whose labels lie within the range of the labelled frames' labels, extended by ``RANGE_MARGIN``.

    Raises
    ------
    TrainingError
        There are fewer such states than labelled frames.
    """
    truth, count = labelled.targets.corrected, len(labelled)
    meant = f"like those of the {count} labelled frames, there must be as many"
    return states_within(simulated, truth.min(axis=0), truth.max(axis=0), count, meant)


def states_within(simulated: Dataset, low: np.ndarray, high: np.ndarray, least: int, meant: str) -> np.ndarray:
    """Rows of simulated states whose labels lie between ``low`` (K,) and ``high`` (K,), extended by ``RANGE_MARGIN``.

    ``meant`` states in the error what the labels are and how many there must be.

    Raises
    ------
    TrainingError
        There are fewer than ``least`` such states.
    """
    told, margin = simulated.targets.corrected, RANGE_MARGIN * (high - low)
    found = np.flatnonzero(((told >= low - margin) & (told <= high + margin)).all(axis=1))
    if len(found) < least:
        raise TrainingError(
            f"{len(found)} simulated states have labels {meant}; simulate the experiment that the frames come from (`contacts`, or another "
            "`sim`), or more of it (`count`)"
        )
    return found


def states_touching(parts: list[Dataset], obj: ObjectSpec) -> Dataset:
    """The simulated data sets of one object, joined; all data sets if none is of this object."""
    return join_datasets([part for part in parts if config_of(part.folder).object.name == obj.name] or parts)


@dataclass(frozen=True)
class CoKriging:
    """Result of ``combine_co_kriging``.

    Attributes
    ----------
    left_out : (K,) float
        Mean absolute error (mm, deg) of the Gaussian process alone on each labelled frame, predicted from the others.
    intervals : dict of str to array
        Intervals of the original run, widened to its errors on the labelled frames, by their names in ``weights.pt``; see
        ``widen_intervals``.
    """

    left_out: np.ndarray
    intervals: dict[str, np.ndarray]


@writes(TENSORS, CONFIG)
def combine_co_kriging(run: Path, out: Path, simulated: Dataset, labelled: Dataset, *, seed: int) -> CoKriging:
    """Average a run of ``vgnn`` or ``steered`` with a Gaussian process of labelled frames, and write the result as a run to ``out``.

    The run ``run`` is not changed. The average has smaller errors than either model, because their errors differ. Both have the same
    weight: labelled frames can't decide a better one, because both models were trained on them. The intervals of ``out`` are those of
    the average.

    The intervals of ``run`` are too narrow for real frames, because they come from simulated contacts. The returned ones are widened
    to the run's errors on the labelled frames, and to the process's leave-one-out errors on them.

    Parameters
    ----------
    run : Path
        Folder of the finished run.
    out : Path
        Folder of the new run; made if missing.
    simulated : Dataset
        Contacts simulated without a sampled discrepancy, with labels like those of the labelled frames (``states_like``).
    labelled : Dataset
        The n labelled frames.
    seed : int
        Seed with which simulated states are sampled.

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
    truth, told = (getattr(part.targets, labels) for part in (labelled, simulated))
    process, alone = fit_two_fidelities(known, ensemble.standardise(told), seen, ensemble.standardise(truth), seed=seed)
    content = read_tensors(run / TENSORS)

    def widths(made: np.ndarray) -> dict[str, np.ndarray]:
        return intervals(*ensemble.destandardise(made, scale), truth, labelled.targets.raw, executed, labelled.targets.units)

    missed = [widths(made) for made in (mean, alone)]
    wider = {key: np.maximum.reduce([content[key].numpy(), *(said[key] for said in missed)]) for key in missed[0]}
    content |= widths((mean + alone) / 2) | {"beside": process.arrays()}
    if "learnt_from" in content:
        content["learnt_from"] = np.concatenate([content["learnt_from"].numpy(), frame_marks(labelled)])
    write_tensors(out / TENSORS, content)
    about = {"data": str(labelled.folder), "frames": labelled.pins.image_name.tolist()}
    write_text(out / CONFIG, json.dumps(estimator.config | {"beside": about}, indent=1) + "\n")
    left_out = label_error(ensemble.destandardise(alone, scale)[0], truth, labelled.targets.units)
    return CoKriging(np.abs(left_out).mean(axis=0), wider)


def widen_intervals(run: Path, wider: dict[str, np.ndarray]) -> None:
    """Replace the intervals of a finished run by the given ones (``Beside.intervals``). Its estimates do not change.

    A second call with the same intervals has no effect.
    """
    with overwriting(), output(run, TENSORS):  # what is there is kept, whoever wrote it
        content = read_tensors(run / TENSORS)
        write_tensors(run / TENSORS, content | wider)


def evaluate_run_row(name: str, labelled: int, run: Path, real: Dataset, test: np.ndarray) -> dict[str, Any]:
    """A row of the study's table: mean errors of a run on the evaluated frames, and how often its intervals contain the label."""
    estimator, targets = PoseEstimator.load(run), real.targets.rows(test)
    made = estimator.predict_rows(real, test)
    inside = (np.abs(label_error(made.mean, targets.corrected, targets.units)) <= made.half_width).mean(axis=0)
    row = error_row(name, labelled, estimator.model, made.mean, targets)
    row |= {f"{label}_inside_90": float(share) for label, share in zip(targets.names, inside, strict=True)}
    return row | {"leak_slope": leak_check(made.mean, targets).slope}


def quadratic_row(name: str, real: Dataset, rows: np.ndarray, test: np.ndarray) -> dict[str, Any]:
    """A row of the study's table for the simplest model: ridge regression on the displacements' first modes and their products."""
    moved = real.pins.nodes_px - real.pins.reference.pins_px
    x = polynomials(DisplacementModes.of(moved[rows], MODES)(moved), 2)
    targets = real.targets.rows(test)
    code = LabelCode(goes_round(targets.units, real.targets.corrected[rows]))
    known = code.encode(real.targets.corrected[rows])
    shift = known.mean(axis=0)
    left, sizes, right = np.linalg.svd(x[rows], full_matrices=False)
    shrunk, along = sizes**2 / (sizes**2 + RIDGES[:, None]), left.T @ (known - shift)
    fitted, leverage = left @ (shrunk[..., None] * along), shrunk @ (left**2).T
    errors = np.abs((known - shift - fitted) / (1 - leverage)[..., None]).mean(axis=1)  # leave-one-out errors of each ridge and number
    made = x[test] @ right.T @ (shrunk[errors.argmin(axis=0)].T / sizes[:, None] * along) + shift
    told = code.decode(made, np.zeros_like(made))[0]
    return error_row(name, len(rows), "quadratic regression", told, targets) | {"leak_slope": leak_check(told, targets).slope}


def error_row(name: str, labelled: int, model: str, made: np.ndarray, targets: Targets) -> dict[str, Any]:
    """A row of the study's table for estimated labels (M, K): mean absolute errors."""
    row: dict[str, Any] = {"trained_on": name, "labelled_frames": labelled, "model": model}
    for kind in ("corrected", "raw"):
        errors = np.abs(label_error(made, getattr(targets, kind), targets.units)).mean(axis=0)
        row |= {f"{label}_{kind}": float(error) for label, error in zip(targets.names, errors, strict=True)}
    return row
