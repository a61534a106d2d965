"""The page of the sim-to-real study: errors by the number of labelled real frames."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from scenes.randomisation import FrictionSpread
from training.data.dataset import Dataset
from training.data.targets import unit_of
from training.studies.sim_to_real.model_inversion import READ
from training.studies.sim_to_real.plan import BOTH, EVENLY, REAL
from training.studies.sim_to_real.steps import CoKriging, contact_of
from twin.estimate import readable_labels
from twin.report.charts import muted_colour, plain_log, sized_figure, write_chart
from twin.report.page import Page, PagePicture
from twin.report.table import Column, number
from twin.report.themes import BLUE, OLIVE, PURPLE, RED

if TYPE_CHECKING:
    from training.studies.sim_to_real.study import Ground

# Name of the row of the model trained in the twin alone. Names of rows without one ingredient begin with this word and a comma.
SIMULATED = "simulated"
# Name of the row of the model trained on simulated pins without a sampled discrepancy.
BARE = "simulated, bare"
# Colours and lines of the models trained on real frames, in the order of the rows.
STYLES = ((RED, "o-"), (OLIVE, "s--"))


def write_page(
    ground: "Ground", rows: Sequence[Mapping[str, Any]], beside: CoKriging, modes: Sequence[Mapping[str, float]], learnt: Dataset
) -> Path:
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
    page.section("How it was made")
    page.items(
        [
            _describe_twin(len(learnt), len(np.unique(contact_of(learnt))), calibrated=plan.calibrate),
            _describe_pins(ground.residuals.error_px, ground.full.randomisation.friction),
            _describe_missing(modes, bare=bool(_of(rows, BARE))),
            _describe_combination(names, beside.left_out),
            "Model inversion: the labels whose simulated pins are most like the frame's. The twin's error is a quadratic function of the "
            "label, fitted to the labelled frames. Even: these frames are not sampled at random; they are nearest to an even sequence.",
            "Pins are counted from the no-contact frame of the recording, or of each simulated sensor.",
        ]
    )
    page.download(folder / "study.csv", "the table, with all digits")
    return page.write(folder / "index.html")


def _charts(folder: Path, rows: Sequence[Mapping], names: Sequence[str], labelled: int) -> list[PagePicture]:
    """Errors by the number of labelled frames, and errors without one ingredient at a time if there are such rows."""
    charts = [
        PagePicture(
            write_chart(folder / "errors.png", lambda: errors_figure(rows, names)),
            "Errors of each label against the number of labelled real frames, for training in the twin and on real frames",
            "Errors against corrected labels by the number of labelled real frames. The dashed line is training in the twin alone: it "
            f"is trained on no real label, but the {number(labelled)} labelled frames show the error of its pins.",
        )
    ]
    others = [row for row in rows if row["trained_on"].startswith(f"{SIMULATED},")]
    if others:
        charts.append(
            PagePicture(
                write_chart(folder / "ingredients.png", lambda: ingredients_figure([*_of(rows, SIMULATED), *others], names)),
                "Errors of training in the twin with one ingredient left out or changed at a time",
                "Training in the twin alone, with one ingredient left out or changed at a time; the line is the full recipe.",
            )
        )
    return charts


def _describe_twin(simulated: int, contacts: int, *, calibrated: bool) -> str:
    fitted = "fitted to the labelled frames first" if calibrated else "as shipped, not fitted to the labelled frames"
    return (
        f"The twin: {number(simulated)} states of {number(contacts)} simulated contacts. Its specification is {fitted}"
        f"{'' if calibrated else ' (the file states from which frames)'}."
    )


def _describe_pins(error_px: float, friction: FrictionSpread | None) -> str:
    friction_words = "that of the rig" if friction is None else f"sampled between {friction.low:.2f} and {friction.high:.2f}"
    return (
        f"The twin's pins are {number(error_px, decimals=2)} px off those of the labelled frames, with the best friction of each frame; "
        f"for simulated contacts it is {friction_words}."
    )


def _describe_missing(modes: Sequence[Mapping[str, float]], *, bare: bool) -> str:
    return (
        "The error of the pins is a Gaussian process of the label, fitted to the labelled frames and sampled for every simulated "
        f"contact{', except in the rows called bare and uncalibrated' if bare else ''}. Its first modes have "
        f"{_percents(mode['share'] for mode in modes)} of it; the label explains {_percents(mode['told'] for mode in modes)} of these."
    )


def _describe_combination(names: Sequence[str], left_out: np.ndarray) -> str:
    known = zip(names, readable_labels(names), left_out, strict=True)
    missed = ", ".join(f"{label} {number(float(error))} {unit_of(name)}" for name, label, error in known)
    return (
        "Simulated and real: the model from the twin, averaged with a Gaussian process, in which the label of a real frame is that of a "
        "simulated contact plus a smooth difference. The errors of that process alone, with one labelled frame left out after another, are "
        f"{missed}. These errors also widen the 90 % intervals of the model from the twin, but not those of the other rows."
    )


def errors_figure(rows: Sequence[Mapping], names: Sequence[str]) -> Figure:
    """A chart of errors against corrected labels by the number of labelled real frames; a panel for each label, both axes logarithmic."""
    figure, axes = sized_figure((5.2 * len(names), 4.2), len(names))
    for ax, name, label in zip(axes, names, readable_labels(names), strict=True):
        key = f"{name}_corrected"
        models = dict.fromkeys(row["model"] for row in _of(rows, REAL))
        for model, (color, line) in zip(models, STYLES[-len(models) :], strict=False):
            _curve(ax, _model(rows, REAL, model), key, line, color, f"real frames, {model}")
            _curve(ax, _model(rows, f"{REAL}{EVENLY}", model), key, "s:", color, f"evenly chosen frames, {model}")
        for row in _of(rows, SIMULATED):
            ax.axhline(row[key], color=BLUE, ls=(0, (5, 2)), label="twin alone")
        for row in _of(rows, BOTH):
            if row["model"] != READ:
                ax.plot(row["labelled_frames"], row[key], "*", color=PURPLE, ms=13, label="twin and labelled frames")
            elif not row["labelled_frames"]:
                ax.axhline(row[key], color=PURPLE, ls=(0, (1, 2)), label="model inversion, no label")
        _curve(ax, _model(rows, BOTH, READ), key, "^-", PURPLE, "model inversion")
        _curve(ax, _model(rows, f"{BOTH}{EVENLY}", READ), key, "^:", PURPLE, "model inversion, evenly chosen frames")
        ax.set(title=f"{label} error", xlabel="labelled real frames", ylabel=f"mean absolute error, {unit_of(name)}")
        ax.set(xscale="log", yscale="log")
        counts = sorted({row["labelled_frames"] for row in rows if row["labelled_frames"]})
        ax.set_xticks(counts, [number(count) for count in counts])
        ax.xaxis.set_minor_locator(NullLocator())
        plain_log(ax.yaxis)
    axes[0].legend()
    return figure


def _model(rows: Sequence[Mapping], trained_on: str, model: str) -> list[Mapping]:
    """Rows of one model with labelled frames, by their number."""
    mine = [row for row in _of(rows, trained_on) if row["model"] == model and row["labelled_frames"]]
    return sorted(mine, key=lambda row: row["labelled_frames"])


def _curve(ax: Axes, rows: Sequence[Mapping], key: str, line: str, color: str, label: str) -> None:
    """The errors of some rows by their numbers of labelled frames."""
    if rows:
        ax.plot([row["labelled_frames"] for row in rows], [row[key] for row in rows], line, color=color, label=label)


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


def _percents(shares: Iterable[float]) -> str:
    return ", ".join(f"{100 * share:.0f} %" for share in shares)
