"""The paper's table of graph sizes and times, and its figure of Voronoi areas in contact.

The figure shows where and how deep the sensor is touched. Four contacts are rendered in the twin, each 2 and 4 mm beyond first touch: a
flat surface and an edge at the middle of the sensor, and a surface that reaches only its top or only its bottom. Recorded frames of
about these depths are shown for comparison.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scenes import load_object
from scenes.sensor import SensorSpec
from training.data.dataset import Dataset
from training.data.pins import PinTable
from training.data.targets import ANGLE, DEPTH
from twin.errors import TwinError
from twin.mechanics.path import ContactPath, ContactPose, plan_path
from twin.objects import build_field
from twin.pins import Pipeline, make_graph
from twin.pins.graph import GraphKind
from twin.progress import Step
from twin.report.charts import new_figure
from twin.report.plots import draw_area_change
from twin.simulator import Simulator
from twin.types import Form, PinGraph

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


def compare_graphs(pins: PinTable) -> list[dict[str, Any]]:
    """One row for each kind of graph: nodes, features, directed edges without contact and in the frames, and the median time, ms."""
    outmost, rest = pins.reference.outmost, pins.reference.pins_px
    chosen = np.linspace(0, len(pins) - 1, min(TIMED, len(pins))).astype(int)
    rows = []
    for kind in KINDS:
        make_graph(kind, rest, outmost=outmost)  # not timed: the first call loads the compiled code
        taken, edges = [], []
        for k in chosen:
            started = perf_counter()
            graph = make_graph(kind, pins.nodes_px[k], outmost=outmost)
            taken.append(1e3 * (perf_counter() - started))
            edges.append(len(graph.edges))
        paper_edges, paper_s = PAPER.get((len(rest), kind), (None, None))
        rows.append(
            {
                "graph": kind,
                "nodes": len(rest),
                "features": 3 if kind == "voronoi" else 2,
                "edges_no_contact": len(make_graph(kind, rest, outmost=outmost).edges),
                "edges_least": min(edges),
                "edges_most": max(edges),
                "ms": float(np.median(taken)),
                "paper_edges": paper_edges,
                "paper_ms": None if paper_s is None else 1e3 * paper_s,
            }
        )
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
        return {
            "contact": self.name,
            "depth_mm": self.depth_mm,
            "source": self.source,
            "largest_growth_percent": float(np.percentile(change, 99)),
            "mean_size_of_change_percent": float(np.abs(change).mean()),
            "growth_x_px": float(where[0]),
            "growth_y_px": float(where[1]),
        }


def twin_contacts(spec: SensorSpec, form: Form, *, progress: Step | None = None) -> list[AreaChange]:
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
            state = [state for _, state in simulator.solver.path(obj, ContactPath(_rotation_about_z(turn_deg) @ poses))][-1]
            seen = pipeline(simulator.render(state, form=form).frame)
            if not seen.valid or seen.graph is None:
                raise TwinError(f"{spec.name}, {name}, {depth:g} mm: {seen.reason}")
            found.append(AreaChange(name, depth, seen.graph, rest.graph.area_px2))
            if progress:
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


def _rotation_about_z(turn_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    return T


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
