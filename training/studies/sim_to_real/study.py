"""The sim-to-real study, from its plan to its tables, runs and page: errors by the number of labelled real frames.

One of its networks is trained on real frames without labels: model inversion estimates their labels (pseudo-labels). The twin is read in
seconds for hundreds of frames, but not by a live loop. The network has nearly its errors, and is a run as any other. It needs no label of
these frames, only more of them.

``label_efficiency`` is the value of the twin for models that need no training: errors by the number of labelled frames, with and without
the twin. With the twin: it is read (``read_twin``). Without: quadratic regression. Both with frames sampled at random and with frames
nearest to an even sequence. With the twin also: frames without labels beside labelled ones. All models together take minutes for a plate,
and half an hour for an edge with five thousand frames.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from scenes import load_randomisation
from training.data.dataset import Dataset, join_datasets, load_dataset
from training.data.label_code import goes_round
from training.data.targets import unit_of
from training.estimate.estimator import PoseEstimator
from training.runs.assemble import intervals
from training.studies.sim_to_real import steps
from training.studies.sim_to_real.discrepancy import Discrepancy, Residuals, measure_residuals
from training.studies.sim_to_real.model_inversion import READ, TwinRead, named_labels, read_row, read_twin
from training.studies.sim_to_real.steps import BOTH, EVENLY, REAL, WITHOUT, SimToRealPlan
from twin.calibration.contact import fit_contact
from twin.calibration.contact.fit import CalibrationSetup
from twin.estimate import readable_labels
from twin.progress import Progress, Step, silent, stage, unheard
from twin.report.charts import muted_colour, plain_log, sized_figure, write_chart
from twin.report.page import BLUE, OLIVE, PURPLE, RED, Column, Page, PagePicture, number, write_table
from twin.store import writes
from twin.types import ReadableResult

SEEDS_APART = 1000  # between the draws of one study, so that those of seeds 0, 1, 2... differ
BESIDE, TAUGHT = "sim_plus_real", "sim_taught"  # folders of the run with labelled frames beside it, and of the one that the twin taught
SHOWN_MODES = 4  # of what the twin misses, that the page names
# Name of the row of the model trained in the twin alone. Names of rows without one ingredient begin with this word and a comma.
SIMULATED = "simulated"
# Name of the row of the model trained on simulated pins without a sampled discrepancy.
BARE = "simulated, bare"
# Colours and lines of the models trained on real frames, in the order of the rows.
STYLES = ((RED, "o-"), (OLIVE, "s--"))
UNLABELLED = (300, 3000)
"""Numbers of frames without labels that the twin is given beside the labelled ones, where a label is a direction."""


def teach(
    twin: TwinRead, real: Dataset, few: np.ndarray, rows: np.ndarray, out: Path, *, seed: int, epochs: int | None, progress: Step = unheard
) -> None:
    """Train a run on labelled frames and on frames whose labels that model inversion estimates, or continue it.

    The intervals are at least as wide as the twin's errors on labelled frames that are estimated from other ones.

    Parameters
    ----------
    real : Dataset
        A recording.
    few, rows : (n,) and (n + u,) int
        Rows of the labelled frames, and all rows to learn from. The labels of those that are not among ``few`` are not used.
    out : Path
        Folder of the run.
    epochs : int or None
        None: the recipe's own.
    """
    labels, moved, targets = steps.arm_labels(real), real.pins.nodes_px - real.pins.reference.pins_px, real.targets
    known, unlabelled = [labels[row] for row in few], np.setdiff1d(rows, few)
    corrected, unknown = targets.corrected.copy(), np.full(len(real), np.nan)
    corrected[unlabelled] = named_labels(twin.estimate(moved[few], known, moved[unlabelled], moved[unlabelled]), targets.names)
    raw = corrected.copy()
    raw[few] = targets.raw[few]
    estimated = replace(targets, raw=raw, corrected=corrected, executed=unknown, move=np.full_like(targets.move, np.nan))
    steps.train_on_real(replace(real, targets=estimated).rows(rows), out, seed=seed, epochs=epochs, progress=progress)
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
        labels, lines = dict(zip(names, readable_labels(names), strict=True)), []
        for row in self.rows:
            errors = [f"{label} {kind} {row[f'{name}_{kind}']:.3g}" for name, label in labels.items() for kind in ("corrected", "raw")]
            lines.append(f"{row['trained_on']}, {row['labelled_frames']} labelled, {row['model']}: {', '.join(errors)}")
        return lines


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
    ground, seed = _prepare(plan, out, progress), plan.seed
    real, few, test = ground.real, ground.few, ground.chosen.test
    sets: dict[str, list[Dataset]] = {}
    rows: list[dict[str, Any]] = []
    for twin in ground.twins:
        folder, missing = out / twin.name, None
        if twin.learns:
            with stage(progress, f"{twin.name}: labelled frames") as step:  # what was simulated for another twin is not simulated again
                setup = replace(ground.setup, across=twin.across)
                missing = Discrepancy(measure_residuals(setup, steps.measured_of(few), step, frictions=twin.frictions))
        if twin.contacts not in sets:
            sets[twin.contacts] = twin.simulated_sets(plan, out, ground.setup.sensor, real.pins.form, progress)
        learnt = _training_sets(ground, twin, sets[twin.contacts], missing)
        every, labelled = learnt[0].with_copies([each.pins for each in learnt[1:]]), few if twin.learns else None
        with stage(progress, twin.name) as step:
            steps.train_in_twin(every, folder, seed=seed, split=seed, epochs=plan.epochs, labelled=labelled, progress=step)
        if missing is not None and twin is ground.full:
            bare, full_learnt, modes = steps.states_touching(sets[twin.contacts], plan.target_object), learnt[0], missing.summary()
            beside = steps.combine_co_kriging(folder, out / BESIDE, bare.rows(steps.states_like(bare, few)), few, seed=seed)
            steps.widen_intervals(folder, beside.intervals)
        rows.append(steps.evaluate_run_row(twin.says, 0, folder, real, test))
    rows.insert(1, steps.evaluate_run_row(BOTH, plan.labels, out / BESIDE, real, test))
    rows += _without_the_twin(ground) + _from_the_read_twin(ground, sets[ground.full.contacts])
    page = write_page(ground, rows, beside, modes[:SHOWN_MODES], full_learnt)
    return SimToRealResult(rows, beside.left_out, ground.residuals.error_px, [write_table(out / "study.csv", rows), page])


def _prepare(plan: SimToRealPlan, out: Path, progress: Progress) -> Ground:
    """Read and choose frames, fit the specification if the plan says so, and measure the residuals on the labelled frames."""
    with stage(progress, "frames") as step:
        real = load_dataset(plan.frames, plan.sensor, plan.experiment.targets, progress=step).in_order()
    chosen = steps.choose_frames(len(real), plan.labels, plan.seed)
    few = real.rows(chosen.few)
    measured = steps.measured_of(few)
    setup = CalibrationSetup(
        plan.sensor, plan.experiment, plan.target_object, plan.across, measured.form, out / "calibration", workers=plan.workers
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
    return Ground(plan, out, progress, setup, real, few, chosen, residuals, full, [full, *others])


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


def _from_the_read_twin(ground: Ground, sets: list[Dataset]) -> list[dict[str, Any]]:
    """Rows of the table for model inversion, with growing numbers of labelled frames, and for the run that it teaches.

    This run is trained on the labelled frames and on all others that are not evaluated, with the labels that model inversion estimates.
    """
    plan, real, chosen, folder = ground.plan, ground.real, ground.chosen, ground.out / TAUGHT
    twin = read_twin(sets, plan.target_object, plan.experiment, seed=plan.seed)
    asked = [(BOTH, rows) for rows in (np.zeros(0, int), *chosen.nested)]
    asked += [(f"{BOTH}{EVENLY}", rows) for rows in steps.designed_frames(real, chosen, plan.seed)]
    read = [read_row(name, twin, real, rows, chosen.test) for name, rows in asked]
    with stage(ground.progress, TAUGHT) as step:
        teach(twin, real, chosen.few, chosen.trained["all"], folder, seed=plan.seed, epochs=plan.epochs, progress=step)
    name = BOTH + WITHOUT.format(count=len(chosen.trained["all"]) - plan.labels)
    return [*read, steps.evaluate_run_row(name, plan.labels, folder, real, chosen.test)]


def _without_the_twin(ground: Ground) -> list[dict[str, Any]]:
    """Rows of the table for the models that are trained on real frames alone."""
    plan, real, chosen, rows = ground.plan, ground.real, ground.chosen, []
    for name, index in chosen.trained.items():
        folder = ground.out / f"real_{name}"
        with stage(ground.progress, folder.name) as step:
            steps.train_on_real(real.rows(index), folder, seed=plan.seed, epochs=plan.epochs, progress=step)
        rows.append(steps.evaluate_run_row(REAL, len(index), folder, real, chosen.test))
        rows.append(steps.quadratic_row(REAL, real, index, chosen.test))
    counts = {len(index) for index in chosen.trained.values()}
    others = [(REAL, index) for index in chosen.nested if len(index) not in counts]
    others += [(f"{REAL}{EVENLY}", index) for index in steps.designed_frames(real, chosen, plan.seed)]
    return rows + [steps.quadratic_row(name, real, index, chosen.test) for name, index in others]


def write_page(ground: Ground, rows: Sequence[Mapping], beside: steps.CoKriging, modes: Sequence[Mapping], learnt: Dataset) -> Path:
    """Write ``index.html`` and its charts, and return the page's path.

    Parameters
    ----------
    ground : Ground
        What all models of the study have in common.
    rows : sequence of mappings
        The study's table.
    beside : CoKriging
        Result of the average with a Gaussian process, whose errors are stated.
    modes : sequence
        First modes of the discrepancy: the ``share`` of each, and the part of it that the label explains (``told``).
    learnt : Dataset
        The simulated states that the model was trained on, without a discrepancy or with its first draw.
    """
    plan, folder, real, names = ground.plan, ground.out, ground.real, ground.real.targets.names
    page = Page(f"From the twin to real frames: {ground.setup.sensor.name}", "twin study sim-to-real", topic="TacTip twin: study")
    page.lead = (
        f"Mean absolute errors on the same {number(len(ground.chosen.test))} real frames, a random fifth of {number(len(real))}, which "
        f"were used for no training and for no choice. The {number(plan.labels)} labelled frames were sampled at random from the others "
        f"(seed {plan.seed})."
    )
    page.notice("Notes on the recording", real.problems)
    page.figures(*_charts(folder, rows, names, plan.labels))
    page.section("Errors")
    page.table(rows, [_column(key, names) for key in rows[0]], caption="The least error of each column is marked.")
    page.text(
        "Corrected labels have the shear moves that were never executed taken out; all models were trained on these. The leak slope is "
        "that of the angle's error on such moves: a model that reads the contact has 0. Inside 90 %: share of the frames whose label lies "
        "within the model's 90 % interval."
    )
    fitted = "fitted to the labelled frames first" if plan.calibrate else "as shipped, not fitted to the labelled frames"
    friction = ground.full.randomisation.friction
    contacts = len(np.unique(steps.contact_of(learnt)))
    rubbed = "that of the rig" if friction is None else f"sampled between {friction.low:.2f} and {friction.high:.2f}"
    known = zip(names, readable_labels(names), beside.left_out, strict=True)
    missed = ", ".join(f"{label} {number(float(error))} {unit_of(name)}" for name, label, error in known)
    page.section("How it was made")
    page.items(
        [
            f"The twin: {number(len(learnt))} states of {number(contacts)} simulated contacts. Its specification is {fitted}"
            f"{'' if plan.calibrate else ' (the file states from which frames)'}.",
            f"The twin's pins are {number(ground.residuals.error_px, decimals=2)} px off those of the labelled frames, with the best "
            f"friction of each frame; for simulated contacts it is {rubbed}.",
            "The error of the pins is a Gaussian process of the label, fitted to the labelled frames and sampled for every simulated "
            f"contact{', except in the rows called bare and uncalibrated' if _of(rows, BARE) else ''}. Its first modes have "
            f"{_percents(modes, 'share')} of it; the label explains {_percents(modes, 'told')} of these.",
            "Simulated and real: the model from the twin, averaged with a Gaussian process, in which the label of a real frame is that of "
            "a simulated contact plus a smooth difference. The errors of that process alone, with one labelled frame left out after "
            f"another, are {missed}. These errors also widen the 90 % intervals of the model from the twin, but not those of the other "
            "rows.",
            "Model inversion: the labels whose simulated pins are most like the frame's. The twin's error is a quadratic function of the "
            "label, fitted to the labelled frames. Even: these frames are not sampled at random; they are nearest to an even sequence.",
            "Pins are counted from the no-contact frame of the recording, or of each simulated sensor.",
        ]
    )
    page.download(folder / "study.csv", "the table, with all digits")
    return page.write(folder / "index.html")


def _charts(folder: Path, rows: Sequence[Mapping], names: Sequence[str], labelled: int) -> list[PagePicture]:
    """Errors by the number of labelled frames, and errors without one ingredient at a time if there are such rows."""
    chart = write_chart(folder / "errors.png", lambda: errors_figure(rows, names))
    shown = "Errors of each label against the number of labelled real frames, for training in the twin and on real frames"
    caption = (
        "Errors against corrected labels by the number of labelled real frames. The dashed line is training in the twin alone: it is "
        f"trained on no real label, but the {number(labelled)} labelled frames show the error of its pins."
    )
    charts = [PagePicture(chart, shown, caption)]
    if others := [row for row in rows if row["trained_on"].startswith(f"{SIMULATED},")]:
        chart = write_chart(folder / "ingredients.png", lambda: ingredients_figure([*_of(rows, SIMULATED), *others], names))
        shown = "Errors of training in the twin with one ingredient left out or changed at a time"
        caption = "Training in the twin alone, with one ingredient left out or changed at a time; the line is the full recipe."
        charts.append(PagePicture(chart, shown, caption))
    return charts


def errors_figure(rows: Sequence[Mapping], names: Sequence[str]) -> Figure:
    """A chart of errors against corrected labels by the number of labelled real frames; a panel for each label, both axes logarithmic."""
    figure, axes = sized_figure((5.2 * len(names), 4.2), len(names))
    for ax, name, label in zip(axes, names, readable_labels(names), strict=True):
        key = f"{name}_corrected"
        models = dict.fromkeys(row["model"] for row in _of(rows, REAL))
        for model, (color, line) in zip(models, STYLES[-len(models) :], strict=False):
            _curve(ax, rows, key, (REAL, model), line, color, f"real frames, {model}")
            _curve(ax, rows, key, (f"{REAL}{EVENLY}", model), "s:", color, f"evenly chosen frames, {model}")
        for row in _of(rows, SIMULATED):
            ax.axhline(row[key], color=BLUE, ls=(0, (5, 2)), label="twin alone")
        for row in _of(rows, BOTH):
            if row["model"] != READ:
                ax.plot(row["labelled_frames"], row[key], "*", color=PURPLE, ms=13, label="twin and labelled frames")
            elif not row["labelled_frames"]:
                ax.axhline(row[key], color=PURPLE, ls=(0, (1, 2)), label="model inversion, no label")
        _curve(ax, rows, key, (BOTH, READ), "^-", PURPLE, "model inversion")
        _curve(ax, rows, key, (f"{BOTH}{EVENLY}", READ), "^:", PURPLE, "model inversion, evenly chosen frames")
        ax.set(title=f"{label} error", xlabel="labelled real frames", ylabel=f"mean absolute error, {unit_of(name)}")
        ax.set(xscale="log", yscale="log")
        counts = sorted({row["labelled_frames"] for row in rows if row["labelled_frames"]})
        ax.set_xticks(counts, [number(count) for count in counts])
        ax.xaxis.set_minor_locator(NullLocator())
        plain_log(ax.yaxis)
    axes[0].legend()
    return figure


def _curve(ax: Axes, rows: Sequence[Mapping], key: str, of: tuple[str, str], line: str, color: str, label: str) -> None:
    """The errors of the rows of what was trained on, and model, by their numbers of labelled frames."""
    known = sorted((row["labelled_frames"], row[key]) for row in rows if (row["trained_on"], row["model"]) == of and row["labelled_frames"])
    if known:
        ax.plot(*zip(*known, strict=True), line, color=color, label=label)


def ingredients_figure(rows: Sequence[Mapping], names: Sequence[str]) -> Figure:
    """A chart of the errors of the rows trained in the twin: the first row as a line, the others as dots; a panel for each label."""
    figure, axes = sized_figure((4.4 * len(names) + 2.0, 0.34 * len(rows) + 1.1), len(names))
    places = np.arange(len(rows))[::-1]
    for panel, (ax, name) in enumerate(zip(axes, names, strict=True)):
        errors = [row[f"{name}_corrected"] for row in rows]
        ax.axvline(errors[0], color=muted_colour(), ls="--", lw=1.0)
        ax.plot(errors, places, "o", color=BLUE)
        ax.set_yticks(places, [row["trained_on"] for row in rows] if panel == 0 else [])
        ax.set(xlabel=f"{readable_labels(names)[panel]}: mean absolute error, {unit_of(name)}", xlim=(0, 1.08 * max(errors)))
    return figure


def _of(rows: Sequence[Mapping], trained_on: str) -> list[Mapping]:
    return [row for row in rows if row["trained_on"] == trained_on]


def _column(key: str, names: Sequence[str]) -> Column:
    for name, label in zip(names, readable_labels(names), strict=True):
        if key in (f"{name}_corrected", f"{name}_raw"):
            return Column(key, f"{label}, {key.removeprefix(name)[1:]}", unit_of(name), digits=2, best="least")
        if key == f"{name}_inside_90":
            return Column(key, f"{label} inside 90 %", "%", decimals=0, scale=100)
    return Column(key, "leak slope", digits=2, signed=True) if key == "leak_slope" else Column.of(key)


def _percents(modes: Sequence[Mapping[str, float]], key: str) -> str:
    return ", ".join(f"{100 * mode[key]:.0f} %" for mode in modes)


def label_efficiency(plan: SimToRealPlan, out: Path, seeds: Sequence[int], *, progress: Progress = silent) -> list[dict[str, Any]]:
    """Rows as those of the study's table: the mean over the draws of frames by these seeds, and the largest. Contacts have the rig's one
    friction.

    Parameters
    ----------
    plan : SimToRealPlan
        ``draws``, ``calibrate``, ``ablate`` and ``epochs`` do not matter; ``seed`` is that of the contacts.
    out : Path
        Folder of the simulated contacts; those that it holds are used again.

    Raises
    ------
    TrainingError
        There are too few frames, or the labels of the simulated contacts differ from theirs.
    """
    with stage(progress, "frames") as step:
        real = load_dataset(plan.frames, plan.sensor, plan.experiment.targets, progress=step).in_order()
    full = steps.full_twin(plan, plan.sensor, steps.arm_labels(real), None)
    sets = full.simulated_sets(plan, out, plan.sensor, real.pins.form, progress)
    twin = read_twin(sets, plan.target_object, plan.experiment, seed=plan.seed)
    unlabelled = UNLABELLED if any(goes_round(real.targets.units, real.targets.corrected)) else ()
    found: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for seed in seeds:
        chosen = steps.choose_frames(len(real), plan.labels, seed)
        every = [np.zeros(0, int), *chosen.nested, chosen.trained["all"]]
        made = []
        for designed, among in (("", every), (EVENLY, steps.designed_frames(real, chosen, seed))):
            for rows in among:
                made.append(read_row(f"{BOTH}{designed}", twin, real, rows, chosen.test))
                if len(rows):
                    made.append(steps.quadratic_row(f"{REAL}{designed}", real, rows, chosen.test))
        pool = np.random.default_rng(seed).permutation(np.setdiff1d(chosen.trained["all"], chosen.few))
        for count in unlabelled:
            if count <= len(pool):
                name, more = BOTH + WITHOUT.format(count=count), np.sort(pool[:count])
                made.append(read_row(name, twin, real, chosen.few, chosen.test, unlabelled=more))
        for row in made:
            found.setdefault((row["trained_on"], row["model"], row["labelled_frames"]), []).append(row)
    return [_summary(rows) for rows in found.values()]


def _summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row with the mean of each error, and its largest value as ``KEY_most``."""
    errors = {key: [row[key] for row in rows] for key in rows[0] if key.endswith(("_corrected", "_raw"))}
    named = {key: rows[0][key] for key in ("trained_on", "labelled_frames", "model")}
    most = {f"{key}_most": float(max(each)) for key, each in errors.items()}
    return named | {key: float(np.mean(each)) for key, each in errors.items()} | most
