"""The study's tables, charts and page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from training.data.dataset import Dataset
from training.data.targets import unit_of
from training.studies.tac_vgnn.models import PlannedRun, error_columns, ordering, read_curves
from twin.estimate import readable_labels
from twin.report.charts import new_figure, plain_log, sized_figure
from twin.report.page import Page, PagePicture
from twin.report.table import Column, number
from twin.report.themes import SERIES

# Columns of the table of models that name a run.
RUN = ("model", "seed", "state")
# Columns about training, which are shown in a separate table.
TRAINING = ("epochs", "epochs_allowed", "training_minutes", "s_per_epoch", "parameters")
# Number of points up to which the points of a curve are marked, because a line of one or two points can't be seen.
FEW = 5
# Line styles. The next one is used when all colours are used. All seeds of a model have the same colour and style.
LINES = ("-", "--", ":", "-.")
# Units of scaled labels by the recipe's scaling.
SCALINGS = {"none": "mm and deg", "standard": "standard deviations", "unit": "half ranges"}
HEADINGS = {  # titles and units of the tables' columns; the title of any other column is its key
    "epochs_allowed": ("epochs allowed", ""),
    "training_minutes": ("training", "min"),
    "s_per_epoch": ("per epoch", "s"),
    "ms_per_frame": ("per frame", "ms"),
    "ms": ("time", "ms"),
    "without_prediction": ("without prediction", ""),
    "paper_mm": ("paper, depth", "mm"),
    "paper_deg": ("paper, angle", "deg"),
    "paper_ms": ("paper, time", "ms"),
    "memory_mib": ("memory", "MiB"),
    "edges_no_contact": ("edges, no contact", ""),
    "edges_least": ("edges, least", ""),
    "edges_most": ("edges, most", ""),
    "growth_x_px": ("growth at x", "px"),
    "growth_y_px": ("growth at y", "px"),
    "largest_growth_percent": ("largest growth", "%"),
    "mean_size_of_change_percent": ("mean size of change", "%"),
}


def write_page(
    out: Path, *, data: Dataset, models: list[dict], graphs: list[dict], efficiency: list[dict], contacts: list[dict], notes: dict
) -> Path:
    """Write ``index.html``, which shows all tables and charts in the same folder.

    Parameters
    ----------
    out : Path
    data : Dataset
    models, graphs, efficiency, contacts : list of dict
        Rows of the tables of the same names.
    notes : dict
        ``columns`` of the table of models, kind of ``labels`` that were used, ``max_minutes``, ``device`` and ``threads``.
    """
    ranges = ", ".join(
        f"{name} [{number(float(data.targets.raw[:, k].min()))}, {number(float(data.targets.raw[:, k].max()))}] {unit}"
        for k, (name, unit) in enumerate(zip(readable_labels(data.targets.names), data.targets.units, strict=True))
    )
    page = Page(
        f"The Tac-VGNN paper's comparison on {data.pins.sensor.name}",
        "twin study tac-vgnn",
        topic="TacTip twin: study",
        lead=f"{len(data)} labelled frames. The paper used other data: depth [-2, 2] mm and angle [-30, 30] deg; here {ranges}. Its "
        "figures are shown for orientation; equal figures would not mean equal models. Times are of this machine "
        f"({notes['device']}, {notes['threads']} threads), the paper's of a Titan Xp.",
    )
    page.notice("Notes on the recording", data.problems)
    _errors_section(page, out, data, models, notes)
    page.section("Graphs")
    page.table(graphs, [_column(key) for key in graphs[0]])
    page.text("Edges are directed; times are medians from found pins to the finished graph on one thread.")
    if efficiency:
        page.section(
            "Training efficiency",
            "Graphs were built before the clock started. An epoch's time is given only where a whole epoch was run; of the convolutional "
            "networks some batches were timed. Ours sees every frame twice in an epoch.",
        )
        page.table(efficiency, [_column(key) for key in efficiency[0]])
        page.figures(PagePicture(out / "efficiency.png", "Time of training against batch size", width_px=760))
    if contacts:
        page.section(
            "What the areas show",
            "Change of the Voronoi areas against no contact. Depth is beyond first touch. The place of growth is that of the grown cells, "
            "weighted, from the middle of the pins; y is down. Recorded frames are those nearest to a straight press without shear.",
        )
        page.figures(PagePicture(out / "contacts.png", "Change of the Voronoi areas of each contact, shallow above deep"))
        page.table(contacts, [_column(key) for key in contacts[0]])
    tables = {"models": models, "graphs": graphs, "efficiency": efficiency, "contacts": contacts}
    for name, rows in tables.items():
        if rows:
            page.download(out / f"{name}.csv")
    return page.write(out / "index.html")


def _errors_section(page: Page, out: Path, data: Dataset, models: list[dict], notes: dict) -> None:
    given = ""
    if notes["max_minutes"] is not None:
        given = f" This time {number(notes['max_minutes'], 4)} minutes were given to all training together."
    page.section(
        "Errors",
        "Mean absolute errors on the random fifth of the frames that are kept out of all training (every frame counts; those without a "
        f"prediction are listed), of models that were trained on {notes['labels']} labels. Corrected labels have the shear moves that were "
        "never executed taken out. The leak slope is that of the angle's error on such moves: a model that reads the contact has 0, one "
        f"that reads the time of the frame has not.{given} The error of a run that ended early is what it reached in its time, not what it "
        "would reach. The least error of each column is marked.",
    )
    errors = error_columns(data)
    shown = [key for key in notes["columns"] if key not in TRAINING]
    shown.sort(key=lambda key: (key not in RUN, key not in errors))  # the run, its errors, the rest
    page.table(models, [_column(key, errors) for key in shown])
    page.table(models, [_column(key) for key in (*RUN, *TRAINING)], caption="What training took")
    for key in errors:
        if order := ordering(models, key):
            said = ", ".join(
                f"{name} {number(mean)}" + (f" (seeds within {number(spread, 2)})" if spread else "") for name, mean, spread in order
            )
            page.text(f"By {key.replace('_', ' ')}, best first: {said}.")
    page.text(
        "The paper: depth Tac-VGNN 0.05, CNN (ver 1) 0.06, CNN (ver 2) 0.07, GNN 0.07 mm; angle Tac-VGNN 1.02, GNN 1.16, CNN (ver 1) 1.20, "
        "CNN (ver 2) 1.25 deg."
    )
    page.figures(PagePicture(out / "curves.png", "Learning curves against epochs and against time"))


def _column(key: str, errors: Sequence[str] = ()) -> Column:
    if key in errors:
        name, _, kind = key.rpartition("_")
        return Column(key, f"{name}, {kind}", unit_of(name), digits=2, best="least")
    if key == "leak_slope":
        return Column(key, "leak slope", digits=2, signed=True)
    title, unit = HEADINGS.get(key, ("", ""))
    return Column(key, title, unit, digits=2 if key.startswith("paper") else 3) if title else Column.of(key)


def efficiency_figure(rows: Sequence[Mapping]) -> Figure:
    """Times of training against batch size, a line for each model; the area of a marker is the memory."""
    figure, (ax,) = sized_figure((7.0, 4.6))
    for model in dict.fromkeys(row["model"] for row in rows):
        mine = [row for row in rows if row["model"] == model]
        batches, times = [row["batch"] for row in mine], [row["ms_per_frame"] for row in mine]
        (line,) = ax.plot(batches, times, linewidth=1)
        ax.scatter(batches, times, s=[max(row["memory_mib"] / 4, 4) for row in mine], color=line.get_color(), alpha=0.6, label=model)
    ax.set(xscale="log", yscale="log", xlabel="batch", ylabel="ms per frame in training", title="marker's area: memory")
    batches = sorted({row["batch"] for row in rows})
    ax.set_xticks(batches, [number(batch) for batch in batches])
    ax.xaxis.set_minor_locator(NullLocator())
    plain_log(ax.yaxis)
    ax.legend(markerscale=0.5)
    return figure


def curves_figure(plans: Sequence[PlannedRun], folder: Path) -> Figure:
    """Learning curves of the runs in a folder that were begun, against epochs and against time."""
    plans = [plan for plan in plans if (folder / plan.folder / "curves.csv").is_file()]
    figure, axes = new_figure(2, panel_inch=5)
    names = list(dict.fromkeys(plan.name for plan in plans))
    labelled: set[str] = set()
    for plan in plans:
        curve = [point for point in read_curves(folder / plan.folder) if point["network"] == 0]
        error, minutes, total = [point["held_out_error"] for point in curve], [], 0.0
        for point in curve:
            total += point["seconds"] / 60
            minutes.append(total)
        rank = names.index(plan.name)
        look = {"color": SERIES[rank % len(SERIES)], "linestyle": LINES[rank // len(SERIES) % len(LINES)], "linewidth": 1.2}
        look["marker"] = "." if len(curve) < FEW else None
        label = None if plan.name in labelled else f"{plan.name} ({SCALINGS[plan.config.recipe.scaling]})"
        labelled.add(plan.name)
        axes[0].plot(range(1, len(curve) + 1), error, label=label, **look)
        axes[1].plot(minutes, error, **look)
    for ax, label in zip(axes, ("epoch", "minutes of training"), strict=True):
        ax.set(xlabel=label, ylabel="mean error of the scaled labels", xscale="log", yscale="log")
        if plans:
            plain_log(ax.xaxis)
            plain_log(ax.yaxis)
    if plans:
        axes[0].legend(fontsize=7)
    return figure
