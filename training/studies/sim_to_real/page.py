"""The page of the study of what the twin is worth on real frames: errors by the number of labelled real frames."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from scenes.randomisation import FrictionSpread
from training.targets import unit_of
from twin.report.charts import muted, plain_log, sized_figure, write_chart
from twin.report.numbers import number
from twin.report.page import Page, Picture
from twin.report.table import Column
from twin.report.themes import BLUE, OLIVE, PURPLE, RED

SIMULATED = "simulated"  # trained in the twin alone; the names of the other rows that did without frames begin so
BARE = "simulated, bare"
STYLES = ((RED, "o-"), (OLIVE, "s--"))  # of the models that were trained on real frames, in the order of the rows


def write_page(
    folder: Path,
    *,
    sensor: str,
    tested: int,
    frames: int,
    labelled: int,
    seed: int,
    calibrated: bool,
    error_px: float,
    modes: Sequence[Mapping[str, float]],
    friction: FrictionSpread | None,
    simulated: int,
    contacts: int,
    names: Sequence[str],
    left_out: np.ndarray,
    columns: Sequence[str],
    rows: Sequence[Mapping],
    problems: Sequence[str],
) -> Path:
    """Write ``index.html`` and its charts; the page.

    Parameters
    ----------
    folder : Path
    sensor : str
    tested, frames, labelled, seed : int
        Frames that were judged on, of the recording, and labelled for the twin; the seed they were drawn by.
    calibrated : bool
        The specification was fitted to the labelled frames.
    error_px : float
        By which the twin's pins miss those of the labelled frames.
    modes : sequence
        First modes of what they miss, with the ``share`` that each holds and what the label has ``told`` of it.
    friction : FrictionSpread or None
        Range in which friction was drawn for simulated contacts; None where all of them had the rig's friction.
    simulated, contacts : int
        States, and contacts that they are of.
    names : sequence of str
        Labels.
    left_out : (K,) float
        Errors of the process alone on labelled frames that it did not know.
    columns : sequence of str
        Keys of the table, in their order.
    rows : sequence of mappings
    problems : sequence of str
        Of the reader of the recording.
    """
    page = Page(f"From the twin to real frames: {sensor}", "twin study sim-to-real", topic="TacTip twin: study")
    page.lead = (
        f"Mean absolute errors on the same {number(tested)} real frames, a random fifth of {number(frames)} that no model has seen and no "
        f"choice was made by. The {number(labelled)} labelled frames were drawn at random from the others (seed {seed})."
    )
    page.notice("The reader says", problems)
    charts = [
        Picture(
            write_chart(folder / "errors.png", lambda: errors_figure(rows, names)),
            "Errors of each label against the number of labelled real frames, for training in the twin and on real frames",
            "Errors against corrected labels by the number of labelled real frames. The dashed line is training in the twin alone: it "
            f"learns no real label, but the {number(labelled)} labelled frames say what its pins miss.",
        )
    ]
    others = [row for row in rows if row["trained_on"].startswith(f"{SIMULATED},")]
    if others:
        charts.append(
            Picture(
                write_chart(folder / "ingredients.png", lambda: ingredients_figure([*_of(rows, SIMULATED), *others], names)),
                "Errors of training in the twin with one ingredient left out or changed at a time",
                "Training in the twin alone, with one ingredient left out or changed at a time; the line is the full recipe.",
            )
        )
    page.figures(*charts)
    page.section("Errors")
    page.table(rows, [_column(key, names) for key in columns], caption="The least error of each column is marked.")
    page.text(
        "Corrected labels have the shear moves that were never executed taken out; all models learnt these. The leak slope is that of the "
        "angle's error on such moves: a model that reads the contact has 0. Inside 90 %: share of the frames whose label lies within the "
        "model's 90 % interval."
    )
    page.section("How it was made")
    fitted = "fitted to the labelled frames first" if calibrated else "as shipped, not fitted to the labelled frames"
    drawn = "that of the rig" if friction is None else f"drawn between {friction.low:.2f} and {friction.high:.2f}"
    bare = ", but for the rows called bare and uncalibrated" if _of(rows, BARE) else ""
    page.items(
        [
            f"The twin: {number(simulated)} states of {number(contacts)} simulated contacts. Its specification is {fitted}"
            f"{'' if calibrated else ' (what its own calibration used is said in it)'}.",
            f"On the labelled frames its pins miss the real ones by {number(error_px, decimals=2)} px, friction found frame by frame; for "
            f"simulated contacts it is {drawn}.",
            "What the pins miss was learnt as a Gaussian process of the label and drawn for every simulated contact"
            f"{bare}. Its first modes hold {_percents(mode['share'] for mode in modes)} of it, of which the label tells "
            f"{_percents(mode['told'] for mode in modes)}.",
            "Simulated and real: the model from the twin, averaged with a Gaussian process that takes the labelled frames for the "
            "simulated contacts' labels plus a smooth difference. Left out of it one after another, the labelled frames are missed by that "
            f"process alone by "
            f"{', '.join(f'{number(float(error))} {unit_of(name)} ({name})' for name, error in zip(names, left_out, strict=True))}. These "
            "errors also widen the 90 % intervals of the model from the twin, but not those of the other rows.",
            "Pins are counted from the no-contact frame of the recording, or of each simulated sensor.",
        ]
    )
    page.download(folder / "study.csv", "the table, with all digits")
    return page.write(folder / "index.html")


def errors_figure(rows: Sequence[Mapping], names: Sequence[str]) -> Figure:
    """Errors against corrected labels over the number of labelled real frames, a panel for each label, both axes logarithmic."""
    figure, axes = sized_figure((5.2 * len(names), 4.2), len(names))
    for ax, name in zip(axes, names, strict=True):
        key = f"{name}_corrected"
        models = dict.fromkeys(row["model"] for row in _of(rows, "real"))
        for model, (color, line) in zip(models, STYLES, strict=False):
            mine = sorted((row for row in _of(rows, "real") if row["model"] == model), key=lambda row: row["labelled_frames"])
            ax.plot([row["labelled_frames"] for row in mine], [row[key] for row in mine], line, color=color, label=f"real frames, {model}")
        for row in _of(rows, SIMULATED):
            ax.axhline(row[key], color=BLUE, ls=(0, (5, 2)), label="twin alone")
        for row in _of(rows, "simulated and real"):
            ax.plot(row["labelled_frames"], row[key], "*", color=PURPLE, ms=13, label="twin and labelled frames")
        ax.set(
            title=f"{name} error", xlabel="labelled real frames", ylabel=f"mean absolute error, {unit_of(name)}", xscale="log", yscale="log"
        )
        counts = sorted({row["labelled_frames"] for row in rows if row["labelled_frames"]})
        ax.set_xticks(counts, [number(count) for count in counts])
        ax.xaxis.set_minor_locator(NullLocator())
        plain_log(ax.yaxis)
    axes[0].legend()
    return figure


def ingredients_figure(rows: Sequence[Mapping], names: Sequence[str]) -> Figure:
    """Errors of the twin's own rows as dots, the first row's as a line, a panel for each label."""
    figure, axes = sized_figure((4.4 * len(names) + 2.0, 0.34 * len(rows) + 1.1), len(names))
    places = np.arange(len(rows))[::-1]
    for panel, (ax, name) in enumerate(zip(axes, names, strict=True)):
        errors = [row[f"{name}_corrected"] for row in rows]
        ax.axvline(errors[0], color=muted(), ls="--", lw=1.0)
        ax.plot(errors, places, "o", color=BLUE)
        ax.set_yticks(places, [row["trained_on"] for row in rows] if panel == 0 else [])
        ax.set(xlabel=f"{name}: mean absolute error, {unit_of(name)}", xlim=(0, 1.08 * max(errors)))
    return figure


def _of(rows: Sequence[Mapping], trained_on: str) -> list[Mapping]:
    return [row for row in rows if row["trained_on"] == trained_on]


def _column(key: str, names: Sequence[str]) -> Column:
    for name in names:
        if key in (f"{name}_corrected", f"{name}_raw"):
            return Column(key, f"{name}, {key.removeprefix(name)[1:]}", unit_of(name), digits=2, best="least")
        if key == f"{name}_inside_90":
            return Column(key, f"{name} inside 90 %", "%", decimals=0, scale=100)
    return Column(key, "leak slope", digits=2, signed=True) if key == "leak_slope" else Column.of(key)


def _percents(shares: Iterable[float]) -> str:
    return ", ".join(f"{100 * share:.0f} %" for share in shares)
