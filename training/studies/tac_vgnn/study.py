"""The paper's whole comparison, from its plan to its tables, figures and page.

``compare_graphs`` gives the table of graph sizes and times. ``contacts_figure`` shows where and how deep the sensor is touched, by the
Voronoi areas. For it four contacts are rendered in the twin, each 2 and 4 mm beyond first touch: a flat surface and an edge at the middle
of the sensor, and a surface that reaches only its top or only its bottom. Recorded frames of about these depths are shown for comparison.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy.linalg import block_diag

from scenes import SensorSpec, load_object
from training.data.dataset import Dataset, load_dataset
from training.data.pins import PinTable
from training.data.targets import ANGLE, DEPTH, unit_of
from training.models import model_named
from training.runs.loop import choose_device
from training.studies.tac_vgnn.models import PlannedRun, measure_training, plan_run, read_curves, table_row, train_all
from training.surrogate.symmetry import about_z
from twin.errors import OptionError, TwinError
from twin.estimate import readable_labels
from twin.mechanics.path import ContactPath, ContactPose, plan_path
from twin.objects import build_field
from twin.pins import Pipeline, make_graph
from twin.pins.graph import GraphKind
from twin.progress import Progress, Step, silent, stage, unheard
from twin.report.charts import draw_area_change, new_figure, plain_log, sized_figure, write_chart
from twin.report.page import SERIES, Column, Page, PagePicture, number, write_table
from twin.simulator import Simulator
from twin.store import writes
from twin.types import Form, PinGraph, ReadableResult

KINDS: tuple[GraphKind, ...] = ("knn", "delaunay", "voronoi")
# Number of graphs of each kind, spread evenly over the frames, whose computation is timed.
TIMED = 200
# Table I of the paper: directed edges and seconds, by number of pins and kind of graph.
PAPER = {
    (127, "knn"): (762, 0.004), (127, "delaunay"): (744, 0.007), (127, "voronoi"): (744, 0.019),
    (331, "knn"): (1986, 0.010), (331, "delaunay"): (1860, 0.008), (331, "voronoi"): (1860, 0.045),
}  # fmt: skip
# Depths of the contacts beyond first touch, mm.
DEPTHS_MM = (2.0, 4.0)
# Depth of the tap in the published recordings, mm (tap_move in their meta.json).
TAP_MM = 5.0
# Distance in mm from the middle of the sensor to the border of a surface that touches one side only.
ASIDE_MM = 6.0
# Each contact's object, its turn about the sensor's axis (deg, from x towards y), and its offset before the turn (mm). The y axis of
# the image points down.
CONTACTS = {
    "centre, surface": ("plane", 0.0, 0.0),
    "centre, edge": ("edge", 0.0, 0.0),
    "top, surface": ("edge", -90.0, ASIDE_MM),
    "bottom, surface": ("edge", 90.0, ASIDE_MM),
}
# Units of the differences from the wanted contact when the most similar recorded frame is chosen: a difference of one unit in depth counts
# as much as one unit in angle or shear.
USUAL = {"depth_mm": 0.25, "angle_deg": 1.5, "shear_mm": 0.5, "shear_deg": 0.7}
MODELS = ("gnn", "tac-vgnn", "vgnn", "cnn-v2", "cnn-v1")
# Batch sizes of the efficiency figure.
BATCHES = (64, 256, 512)
# Columns of the page's table of models that name a run, and those after its errors.
RUN, FURTHER = ("model", "seed", "state"), ("frames", "without_prediction", "leak_slope", "paper_mm", "paper_deg")
# Columns about training, which are shown in a separate table.
TRAINING = ("epochs", "epochs_allowed", "training_minutes", "s_per_epoch", "parameters")
# Number of points up to which the points of a curve are marked, because a line of one or two points can't be seen.
FEW = 5
# Line styles. The next one is used when all colours are used. All seeds of a model have the same colour and style.
LINES = ("-", "--", ":", "-.")
# Units of scaled labels by the recipe's scaling.
SCALINGS = {"none": "mm and deg", "standard": "standard deviations", "unit": "half ranges"}
HEADINGS = {  # titles and units of columns of the tables that their keys do not tell
    "s_per_epoch": ("per epoch", "s"),
    "ms_per_frame": ("per frame", "ms"),
    "ms": ("time", "ms"),
    "paper_mm": ("paper, depth", "mm"),
    "paper_deg": ("paper, angle", "deg"),
    "paper_ms": ("paper, time", "ms"),
}

FILES = (
    "index.html",
    *(f"{name}{ending}" for name in ("models", "graphs", "curves", "efficiency", "contacts") for ending in (".csv", ".png", "-dark.png")),
)


def compare_graphs(pins: PinTable) -> list[dict[str, Any]]:
    """One row for each kind of graph: nodes, features, directed edges without contact and in the frames, and the median time, ms."""
    outmost, rest = pins.reference.outmost, pins.reference.pins_px
    frames = pins.nodes_px[np.linspace(0, len(pins) - 1, min(TIMED, len(pins))).astype(int)]
    rows = []
    for kind in KINDS:
        make = partial(make_graph, kind, outmost=outmost)
        still, edges = make(rest), [len(make(nodes_px).edges) for nodes_px in frames]
        ms = 1e3 * float(np.median([timeit(partial(make, nodes_px), number=1) for nodes_px in frames]))
        paper_edges, paper_s = PAPER.get((len(rest), kind), (None, None))
        row: dict[str, Any] = {"graph": kind, "nodes": len(rest), "features": 3 if kind == "voronoi" else 2}
        row |= {"edges_no_contact": len(still.edges), "edges_least": min(edges), "edges_most": max(edges), "ms": ms}
        rows.append(row | {"paper_edges": paper_edges, "paper_ms": None if paper_s is None else 1e3 * paper_s})
    return rows


@dataclass(frozen=True)
class AreaChange:
    """The change of the Voronoi areas by one contact.

    Attributes
    ----------
    name : str
    depth_mm : float
        Depth beyond first touch.
    graph : PinGraph
        Voronoi graph of the contact.
    rest_area_px2 : (N,) float
        Areas without contact.
    source : str
        ``twin``, or the name of the recorded frame.
    """

    name: str
    depth_mm: float
    graph: PinGraph
    rest_area_px2: np.ndarray
    source: str = "twin"

    def figures(self) -> dict[str, Any]:
        """Row of the table: changes of the areas in percent, and the mean place of growth in px from the middle, weighted by growth."""
        change = 100 * (self.graph.area_px2 / self.rest_area_px2 - 1)
        grown = np.maximum(change, 0)
        place = self.graph.nodes_px - self.graph.nodes_px.mean(axis=0)
        where = grown @ place / max(grown.sum(), 1e-9)
        row: dict[str, Any] = {"contact": self.name, "depth_mm": self.depth_mm, "source": self.source}
        row |= {"largest_growth_percent": float(np.percentile(change, 99)), "mean_size_of_change_percent": float(np.abs(change).mean())}
        return row | {"growth_x_px": float(where[0]), "growth_y_px": float(where[1])}


def twin_contacts(spec: SensorSpec, form: Form, *, progress: Step = unheard) -> list[AreaChange]:
    """Simulate and render every contact at every depth, find its pins, and compute their Voronoi cells.

    Raises
    ------
    TwinError
        The pins of a rendered frame can't be found.
    """
    simulator, pipeline = Simulator(spec), Pipeline(spec, form)
    rest = pipeline(simulator.render_rest(form).frame)
    if not rest.valid or rest.graph is None:
        raise TwinError(f"{spec.name}: pins of the rendered frame without contact not found: {rest.reason}")
    found = []
    for name, (stimulus, turn_deg, aside_mm) in CONTACTS.items():
        obj = load_object(stimulus)
        for depth in DEPTHS_MM:
            poses = plan_path(spec.geometry, build_field(obj), ContactPose(indent_mm=depth, offset_mm=(aside_mm, 0.0))).poses
            turn = block_diag(about_z(np.radians(turn_deg)), 1.0)
            state = [state for _, state in simulator.solver.path(obj, ContactPath(turn @ poses))][-1]
            seen = pipeline(simulator.render(state, form=form).frame)
            if not seen.valid or seen.graph is None:
                raise TwinError(f"{spec.name}, {name}, {depth:g} mm: {seen.reason}")
            found.append(AreaChange(name, depth, seen.graph, rest.graph.area_px2))
            progress(len(found), len(CONTACTS) * len(DEPTHS_MM))
    return found


def recorded_contacts(data: Dataset) -> list[AreaChange]:
    """The recorded frame nearest to a straight press of each depth. The list is empty if a label of depth, angle or move is missing.

    The depth beyond first touch is ``pose_2`` + tap + the rig's contact offset, which is 0 for a rig that was never calibrated.
    """
    targets = data.targets
    if not {DEPTH, ANGLE} <= set(targets.names) or not np.isfinite(targets.move).all():
        return []
    rig = data.pins.sensor.rig
    offset_mm, offset_deg = (rig.contact_offset_mm, rig.turn_offset_deg[2]) if rig else (0.0, 0.0)
    depth = targets.corrected[:, targets.names.index(DEPTH)] + TAP_MM + offset_mm
    angle = targets.corrected[:, targets.names.index(ANGLE)] + offset_deg
    shear = targets.move * np.nan_to_num(targets.executed, nan=1.0)[:, None]
    found = []
    for wanted in DEPTHS_MM:
        away = np.column_stack([depth - wanted, angle, shear]) / list(USUAL.values())
        k = int(np.square(away).sum(axis=1).argmin())
        graph = make_graph("voronoi", data.pins.nodes_px[k], outmost=data.pins.reference.outmost)
        rest = data.pins.reference.area_px2
        found.append(AreaChange("centre, recorded", float(depth[k]), graph, rest, str(data.pins.image_name[k])))
    return found


def contacts_figure(contacts: list[AreaChange]) -> Figure:
    """A figure with a column for each contact: the shallow one above, the deep one below. All have the same colour scale."""
    limit = max(contact.figures()["largest_growth_percent"] for contact in contacts)
    names = list(dict.fromkeys(contact.name for contact in contacts))
    figure, axes = new_figure(len(names), len(DEPTHS_MM), panel_inch=3.8)
    for column, name in enumerate(names):
        for row, contact in enumerate(contact for contact in contacts if contact.name == name):
            title = f"{name}, {contact.depth_mm:.1f} mm" + ("" if contact.source == "twin" else f"\n{contact.source}")
            draw_area_change(axes[row * len(names) + column], contact.graph, contact.rest_area_px2, title, limit=limit)
    return figure


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
        settings: dict[str, Any] = {"labels": self.labels, "split": self.split, "epochs": self.epochs}
        return [plan_run(name, seed=seed, **settings) for seed in self.seeds for name in self.models]


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
        lines, labels = [f"{self.frames} labelled frames"], dict(zip(self.names, readable_labels(self.names), strict=True))
        for row in self.rows:
            known = labels if "epochs" in row else {}
            errors = [f"{label} {row[f'{name}_raw']:.4g} raw, {row[f'{name}_corrected']:.4g} corrected" for name, label in known.items()]
            lines.append(f"{row['model']}, seed {row['seed']}: {row['state']}{', ' if errors else ''}{'; '.join(errors)}")
        return lines


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
    written = [write_table(out / "models.csv", rows), write_table(out / "graphs.csv", graphs)]
    written.append(write_chart(out / "curves.png", lambda: curves_figure(runs, folder)))
    efficiency: list[dict[str, Any]] = []
    if plan.batches:
        models = list(dict.fromkeys(each.config.model for each in runs))
        with stage(progress, "training efficiency") as step:
            for model in models:
                inputs = model_named(model).prepare(data, np.arange(len(data))).inputs
                for batch in plan.batches:
                    efficiency.append(measure_training(model, data.pins, inputs, batch, device=device))
                    step(len(efficiency), len(models) * len(plan.batches))
        chart = write_chart(out / "efficiency.png", lambda: efficiency_figure(efficiency))
        written += [write_table(out / "efficiency.csv", efficiency), chart]
    changes = recorded_contacts(data)
    if plan.contacts:
        with stage(progress, "contacts") as step:
            changes = twin_contacts(data.pins.sensor, data.pins.form, progress=step) + changes
    contacts = [change.figures() for change in changes]
    if contacts:
        written += [write_table(out / "contacts.csv", contacts), write_chart(out / "contacts.png", lambda: contacts_figure(changes))]
    tables = {"models": rows, "graphs": graphs, "efficiency": efficiency, "contacts": contacts}
    written.append(write_page(out, data, tables, plan, f"{device}, {torch.get_num_threads()} threads"))
    return TacVgnnResult(rows, graphs, efficiency, contacts, data.targets.names, len(data), written)


def write_page(out: Path, data: Dataset, tables: Mapping[str, list[dict]], plan: TacVgnnPlan, machine: str) -> Path:
    """Write ``index.html``, which shows all tables and charts in the same folder.

    Parameters
    ----------
    out : Path
    data : Dataset
    tables : mapping of str to list of dict
        Rows of the tables ``models``, ``graphs``, ``efficiency`` and ``contacts``; the last two may be empty.
    plan : TacVgnnPlan
    machine : str
        Device and number of threads.
    """
    ends = data.targets.raw.min(axis=0).tolist(), data.targets.raw.max(axis=0).tolist()
    known = zip(readable_labels(data.targets.names), data.targets.units, *ends, strict=True)
    ranges = ", ".join(f"{name} [{number(low)}, {number(high)}] {unit}" for name, unit, low, high in known)
    page = Page(
        f"The Tac-VGNN paper's comparison on {data.pins.sensor.name}",
        "twin study tac-vgnn",
        topic="TacTip twin: study",
        lead=f"{len(data)} labelled frames. The paper used other data: depth [-2, 2] mm and angle [-30, 30] deg; here {ranges}. Its "
        "figures are shown for orientation; equal figures would not mean equal models. Times are of this machine "
        f"({machine}), the paper's of a Titan Xp.",
    )
    page.notice("Notes on the recording", data.problems)
    minutes = plan.max_minutes
    given = "" if minutes is None else f" This time {number(minutes, 4)} minutes were given to all training together."
    page.section(
        "Errors",
        "Mean absolute errors on the random fifth of the frames that are kept out of all training (every frame counts; those without a "
        f"prediction are listed), of models that were trained on {plan.labels} labels. Corrected labels have the shear moves that were "
        "never executed taken out. The leak slope is that of the angle's error on such moves: a model that reads the contact has 0, one "
        f"that reads the time of the frame has not.{given} The error of a run that ended early is what it reached in its time, not what it "
        "would reach. The least error of each column is marked.",
    )
    errors = [f"{name}_{kind}" for kind in ("raw", "corrected") for name in data.targets.names]
    page.table(tables["models"], [_column(key, errors) for key in (*RUN, *errors, *FURTHER)])
    page.table(tables["models"], [_column(key) for key in (*RUN, *TRAINING)], caption="What training took")
    for key in errors:
        if order := ordering(tables["models"], key):
            said = ", ".join(
                f"{name} {number(mean)}" + (f" (seeds within {number(spread, 2)})" if spread else "") for name, mean, spread in order
            )
            page.text(f"By {key.replace('_', ' ')}, best first: {said}.")
    page.text(
        "The paper: depth Tac-VGNN 0.05, CNN (ver 1) 0.06, CNN (ver 2) 0.07, GNN 0.07 mm; angle Tac-VGNN 1.02, GNN 1.16, CNN (ver 1) 1.20, "
        "CNN (ver 2) 1.25 deg."
    )
    page.figures(PagePicture(out / "curves.png", "Learning curves against epochs and against time"))
    page.section("Graphs")
    page.table(tables["graphs"], [_column(key) for key in tables["graphs"][0]])
    page.text("Edges are directed; times are medians from found pins to the finished graph on one thread.")
    if efficiency := tables["efficiency"]:
        page.section(
            "Training efficiency",
            "Graphs were built before the clock started. An epoch's time is given only where a whole epoch was run; of the convolutional "
            "networks some batches were timed. Ours sees every frame twice in an epoch.",
        )
        page.table(efficiency, [_column(key) for key in efficiency[0]])
        page.figures(PagePicture(out / "efficiency.png", "Time of training against batch size", width_px=760))
    if contacts := tables["contacts"]:
        page.section(
            "What the areas show",
            "Change of the Voronoi areas against no contact. Depth is beyond first touch. The place of growth is that of the grown cells, "
            "weighted, from the middle of the pins; y is down. Recorded frames are those nearest to a straight press without shear.",
        )
        page.figures(PagePicture(out / "contacts.png", "Change of the Voronoi areas of each contact, shallow above deep"))
        page.table(contacts, [_column(key) for key in contacts[0]])
    for name in [name for name, rows in tables.items() if rows]:
        page.download(out / f"{name}.csv")
    return page.write(out / "index.html")


def ordering(rows: list[dict[str, Any]], key: str) -> list[tuple[str, float, float]]:
    """Models sorted by a column's mean over seeds, the smallest first: name, mean, and difference between largest and smallest seed."""
    values: dict[str, list[float]] = {}
    for row in rows:
        if row.get(key) is not None:
            values.setdefault(row["model"], []).append(row[key])
    return sorted(((name, float(np.mean(v)), float(np.ptp(v))) for name, v in values.items()), key=lambda item: item[1])


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
    first = {plan.name: plan for plan in reversed(plans)}  # of each name, which alone is labelled
    names = list(dict.fromkeys(plan.name for plan in plans))
    for plan in plans:
        curve = read_curves(folder / plan.folder)
        curve = curve[curve["network"] == 0]
        error, minutes = curve["held_out_error"], np.cumsum(curve["seconds"]) / 60
        rank = names.index(plan.name)
        look = {"color": SERIES[rank % len(SERIES)], "linestyle": LINES[rank // len(SERIES) % len(LINES)], "linewidth": 1.2}
        look["marker"] = "." if len(curve) < FEW else None
        label = f"{plan.name} ({SCALINGS[plan.config.recipe.scaling]})" if plan is first[plan.name] else None
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
