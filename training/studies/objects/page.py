"""The page of the study of unseen objects: errors on every object, of a model of several objects and of a model of one object."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from scenes.object import ObjectSpec
from training.data.targets import unit_of
from training.studies.objects.plan import MIXED, TIMES, ObjectsPlan
from twin.estimate import readable_labels
from twin.report.charts import muted_colour, sized_figure, write_chart
from twin.report.numbers import number
from twin.report.page import Page, PagePicture, sentence, strong
from twin.report.table import Column
from twin.report.themes import BLUE, RED


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
        f"Two models from {number(plan.count * len(plan.train))} simulated contacts each, evaluated on "
        f"{number(plan.tests)} other contacts of "
        "every object, seen or not."
    )
    page.notice("Unseen objects", verdicts)
    chart = write_chart(folder / "errors.png", lambda: errors_figure(rows, names, alone))
    page.figures(
        PagePicture(
            chart,
            f"Errors of both models on every object, as multiples of their error on {alone}",
            f"Mean absolute error of each label, as a multiple of the same model's error on {alone} (dashed). Filled: the object was "
            f"trained on; open: unseen. Dotted: the target, {TIMES:g} times.",
        )
    )
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
            mine = [row for row in rows if row["model"] == model]
            for seen in (True, False):
                part = [row for row in mine if bool(row["seen"]) is seen]
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
