"""The sim-to-real study, from its plan to its tables and runs.

One of its networks is trained on real frames without labels: model inversion estimates their labels (pseudo-labels). The twin is read in
seconds for hundreds of frames, but not by a live loop. The network has nearly its errors, and is a run as any other. It needs no label of
these frames, only more of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes import load_randomisation
from training.data.dataset import Dataset, join_datasets, load_dataset
from training.data.targets import Targets
from training.estimate.estimator import PoseEstimator
from training.runs.assemble import intervals
from training.studies.sim_to_real import steps
from training.studies.sim_to_real.discrepancy import Discrepancy, Residuals, measure_residuals
from training.studies.sim_to_real.model_inversion import TwinRead, named_labels, read_row, read_twin
from training.studies.sim_to_real.page import write_page
from training.studies.sim_to_real.plan import BOTH, EVENLY, REAL, WITHOUT, SimToRealPlan
from twin.calibration.contact import fit_contact
from twin.calibration.contact.simulate import CalibrationSetup
from twin.estimate import readable_labels
from twin.evaluation.labelled.model import MeasuredFrames
from twin.progress import Progress, Step, silent, stage, unheard
from twin.report.table import write_table
from twin.rig.labels import ArmLabel
from twin.store import writes
from twin.types import ReadableResult

SEEDS_APART = 1000  # between the draws of one study, so that those of seeds 0, 1, 2... differ
BESIDE, TAUGHT = "sim_plus_real", "sim_taught"  # folders of the run with labelled frames beside it, and of the one that the twin taught
SHOWN_MODES = 4  # of what the twin misses, that the page names


def teach(
    twin: TwinRead,
    real: Dataset,
    labels: Sequence[ArmLabel],
    few: np.ndarray,
    unlabelled: np.ndarray,
    out: Path,
    *,
    seed: int,
    epochs: int | None,
    progress: Step = unheard,
) -> None:
    """Train a run on labelled frames and on frames whose labels that model inversion estimates, or continue it.

    The intervals are at least as wide as the twin's errors on labelled frames that are estimated from other ones.

    Parameters
    ----------
    real : Dataset
        A recording.
    labels : sequence of ArmLabel
        Of all its frames. Those of the frames ``unlabelled`` are not used.
    few, unlabelled : (n,) and (u,) int
        Rows of the labelled frames, and of the others to learn from.
    out : Path
        Folder of the run.
    epochs : int or None
        None: the recipe's own.
    """
    moved, known = real.pins.nodes_px - real.pins.reference.pins_px, [labels[row] for row in few]
    told = named_labels(twin.estimate(moved[few], known, moved[unlabelled], moved[unlabelled]), real.targets.names)
    rows = np.sort(np.concatenate([few, unlabelled]))
    taught = replace(real, targets=_with_estimated(real.targets, few, unlabelled, told)).rows(rows)
    steps.train_on_real(taught, out, seed=seed, epochs=epochs, progress=progress)
    judged, found = twin.left_out(moved[few], known)
    part = real.rows(few[judged])
    if not len(part):
        return
    estimator = PoseEstimator.load(out)
    inputs, index = estimator.inputs_of(part.pins, together=not part.pins.measured)
    mean, scale, executed = estimator.ensemble.outputs(inputs, index)
    _, scale = estimator.ensemble.destandardise(mean, scale)
    made = named_labels(found, part.targets.names)
    said = intervals(made, scale, part.targets.corrected, part.targets.raw, executed, part.targets.units)
    steps.widen_intervals(out, {key: np.maximum(getattr(estimator.ensemble, key), width) for key, width in said.items()})


def _with_estimated(targets: Targets, few: np.ndarray, unlabelled: np.ndarray, told: np.ndarray) -> Targets:
    """Targets with the labels (u, K) that are estimated for frames without; nothing is known of their moves."""
    corrected, nothing = targets.corrected.copy(), np.full(len(targets.executed), np.nan)
    corrected[unlabelled] = told
    raw = corrected.copy()
    raw[few] = targets.raw[few]
    return replace(targets, raw=raw, corrected=corrected, executed=nothing, move=np.full_like(targets.move, np.nan))


@dataclass(frozen=True, repr=False)
class SimToRealResult(ReadableResult):
    """The result of the study.

    Attributes
    ----------
    rows : list of dict
        A row for each model: what it was trained on, and its errors (mm, deg) against corrected and raw labels.
    left_out : (K,) float
        See ``CoKriging``.
    residual_px : float
        Mean distance between the labelled frames' pins and the twin's.
    written : list of Path
    """

    rows: list[dict[str, Any]]
    left_out: np.ndarray
    residual_px: float
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text, one for each model."""
        names = [key.removesuffix("_raw") for key in self.rows[0] if key.endswith("_raw")]
        labels = dict(zip(names, readable_labels(names), strict=True))
        shown = [(f"{name}_{kind}", f"{label} {kind}") for name, label in labels.items() for kind in ("corrected", "raw")]
        return [
            f"{row['trained_on']}, {row['labelled_frames']} labelled, {row['model']}: "
            + ", ".join(f"{label} {row[key]:.3g}" for key, label in shown)
            for row in self.rows
        ]


@dataclass(frozen=True)
class Ground:
    """What all models of a study have in common.

    Attributes
    ----------
    setup : CalibrationSetup
        Setup in which the labelled frames are simulated, with the sensor as shipped, or fitted to these frames.
    real, few : Dataset
        The recording, and its labelled frames.
    chosen : Frames
    measured : MeasuredFrames
        Pins and arm's labels of the labelled frames.
    residuals : Residuals
        Residuals of the twin with all ingredients on the labelled frames.
    full : Twin
        The twin with all ingredients. ``twins``: this twin and those without one ingredient.
    """

    plan: SimToRealPlan
    out: Path
    progress: Progress
    setup: CalibrationSetup
    real: Dataset
    few: Dataset
    chosen: steps.StudyFrames
    measured: MeasuredFrames
    residuals: Residuals
    full: steps.Twin
    twins: list[steps.Twin]


@writes("study.csv", "index.html", "errors*.png", "ingredients*.png", "calibration", "labelled")
def run(plan: SimToRealPlan, out: Path, *, progress: Progress = silent) -> SimToRealResult:
    """Train in the twin, in the twin with labelled frames, and without the twin; evaluate all models on the same real frames.

    Writes runs, ``study.csv`` and ``index.html`` to ``out``. Results of an earlier call with the same plan are used again.

    Raises
    ------
    TrainingError
        There are too few frames, or the labels of the simulated contacts differ from theirs.
    """
    ground = _prepare(plan, out, progress)
    known = {_residual_key(ground.full): Discrepancy(ground.residuals)}
    sets: dict[str, list[Dataset]] = {}
    rows: list[dict[str, Any]] = []
    for twin in ground.twins:
        missing = _missing(ground, twin, known)
        if twin.contacts not in sets:
            given = plan.simulated if twin is ground.full else ()
            sets[twin.contacts] = twin.simulated_sets(plan, out, ground.setup.sensor, ground.real.pins.form, given, progress)
        learnt, folder = _training_sets(ground, twin, sets[twin.contacts], missing), out / twin.name
        labelled, copies = None if missing is None else ground.few, [each.pins for each in learnt[1:]]
        with stage(progress, twin.name) as step:
            every, seed = learnt[0].with_copies(copies), plan.seed
            steps.train_in_twin(every, folder, seed=seed, split=seed, epochs=plan.epochs, labelled=labelled, progress=step)
        if twin is ground.full:
            bare = steps.states_touching(sets[twin.contacts], plan.target_object)
            like = bare.rows(steps.states_like(bare, ground.few))
            beside = steps.combine_co_kriging(folder, out / BESIDE, like, ground.few, seed=plan.seed)
            steps.widen_intervals(folder, beside.intervals)
            full_learnt = learnt[0]
        rows.append(steps.evaluate_run_row(twin.says, 0, folder, ground.real, ground.chosen.test))
        if twin is ground.full:
            rows.append(steps.evaluate_run_row(BOTH, plan.labels, out / BESIDE, ground.real, ground.chosen.test))
    rows += _without_the_twin(ground)
    read = read_twin(sets[ground.full.contacts], plan.target_object, plan.experiment, seed=plan.seed)
    rows += _invert_model_rows(ground, read)
    rows.append(_train_on_labelled(ground, read))
    page = write_page(ground, rows, beside, known[_residual_key(ground.full)].summary()[:SHOWN_MODES], full_learnt)
    return SimToRealResult(rows, beside.left_out, ground.residuals.error_px, [write_table(out / "study.csv", rows), page])


def _prepare(plan: SimToRealPlan, out: Path, progress: Progress) -> Ground:
    """Read and choose frames, fit the specification if the plan says so, and measure the residuals on the labelled frames."""
    with stage(progress, "frames") as step:
        real = load_dataset(plan.frames, plan.sensor, plan.experiment.targets, progress=step).in_order()
    chosen = steps.choose_frames(len(real), plan.labels, plan.seed)
    few = real.rows(chosen.few)
    measured = steps.measured_of(few)
    setup = CalibrationSetup(
        plan.sensor, plan.experiment, plan.target_object, measured.form, plan.across, out / "calibration", plan.workers
    )
    if plan.calibrate:
        with stage(progress, "calibration") as step:
            setup = replace(setup, sensor=fit_contact(setup, measured, progress=step).sensor)
    setup = replace(setup, folder=out / "labelled", parameters=())
    with stage(progress, "labelled frames") as step:
        residuals = measure_residuals(setup, measured, step)
    moves = load_randomisation("moves")
    sheared = any(label.move.any() for label in measured.labels)
    full = steps.full_twin(plan, setup.sensor, measured.labels, (residuals.friction_spread() or moves.friction) if sheared else None)
    others = steps.without_one_ingredient(full, steps.as_mounted(plan.sensor), moves, load_randomisation("contact")) if plan.ablate else []
    return Ground(plan, out, progress, setup, real, few, chosen, measured, residuals, full, [full, *others])


def _residual_key(twin: steps.Twin) -> tuple[int, tuple[float, ...]]:
    """Everything that the residuals of a twin depend on within one study."""
    return twin.across, twin.frictions


def _missing(ground: Ground, twin: steps.Twin, known: dict[tuple[int, tuple[float, ...]], Discrepancy]) -> Discrepancy | None:
    """The discrepancy of a twin that uses one, else None. ``known`` stores it for other twins with the same residuals."""
    if not twin.learns:
        return None
    if _residual_key(twin) not in known:
        setup = replace(ground.setup, across=twin.across)
        with stage(ground.progress, f"{twin.name}: labelled frames") as step:
            known[_residual_key(twin)] = Discrepancy(measure_residuals(setup, ground.measured, step, frictions=twin.frictions))
    return known[_residual_key(twin)]


def _training_sets(ground: Ground, twin: steps.Twin, sets: list[Dataset], missing: Discrepancy | None) -> list[Dataset]:
    """The data sets to train on: the states once for each draw of the discrepancy, or once unchanged if there is none."""
    if missing is None:
        return [twin.part(join_datasets(sets))]
    labels, drawn = [steps.arm_labels(each) for each in sets], []
    for k in range(ground.plan.draws):
        seed = ground.plan.seed + SEEDS_APART * k
        with stage(ground.progress, f"{twin.name}: draw {k + 1}") as step:
            pairs = zip(sets, labels, strict=True)
            drawn.append(join_datasets([steps.with_missing(each, told, missing, seed, progress=step) for each, told in pairs]))
    return [twin.part(each) for each in drawn]


def _invert_model_rows(ground: Ground, twin: TwinRead) -> list[dict[str, Any]]:
    """Rows of the table for model inversion, with growing numbers of labelled frames."""
    labels, test = steps.arm_labels(ground.real), ground.chosen.test
    rows = [read_row(BOTH, twin, ground.real, labels, rows, test) for rows in (np.zeros(0, int), *ground.chosen.nested)]
    designed = steps.designed_frames(ground.real, ground.chosen, ground.plan.seed)
    return rows + [read_row(f"{BOTH}{EVENLY}", twin, ground.real, labels, rows, test) for rows in designed]


def _train_on_labelled(ground: Ground, twin: TwinRead) -> dict[str, Any]:
    """Train a run on the labelled frames and on all others that are not evaluated, with the labels that model inversion estimates for
    them."""
    plan, real, few = ground.plan, ground.real, ground.chosen.few
    others = np.setdiff1d(ground.chosen.trained["all"], few)
    with stage(ground.progress, TAUGHT) as step:
        teach(twin, real, steps.arm_labels(real), few, others, ground.out / TAUGHT, seed=plan.seed, epochs=plan.epochs, progress=step)
    return steps.evaluate_run_row(BOTH + WITHOUT.format(count=len(others)), len(few), ground.out / TAUGHT, real, ground.chosen.test)


def _without_the_twin(ground: Ground) -> list[dict[str, Any]]:
    """Rows of the table for the models that are trained on real frames alone."""
    rows = []
    for name, index in ground.chosen.trained.items():
        folder = ground.out / f"real_{name}"
        with stage(ground.progress, folder.name) as step:
            steps.train_on_real(ground.real.rows(index), folder, seed=ground.plan.seed, epochs=ground.plan.epochs, progress=step)
        rows.append(steps.evaluate_run_row(REAL, len(index), folder, ground.real, ground.chosen.test))
        rows.append(steps.quadratic_row(REAL, ground.real, index, ground.chosen.test))
    counts = {len(index) for index in ground.chosen.trained.values()}
    others = [index for index in ground.chosen.nested if len(index) not in counts]
    rows += [steps.quadratic_row(REAL, ground.real, index, ground.chosen.test) for index in others]
    designed = steps.designed_frames(ground.real, ground.chosen, ground.plan.seed)
    return rows + [steps.quadratic_row(f"{REAL}{EVENLY}", ground.real, index, ground.chosen.test) for index in designed]
