"""Graphs of a frame, of many frames or of found pins, written as arrays and pictures."""

from dataclasses import dataclass
from pathlib import Path

from scenes import SensorSpec
from twin.errors import FrameError
from twin.graph_files import (
    draw_bare_graph,
    draw_graph_pictures,
    form_of_pins,
    graphs_of_nodes,
    graphs_of_recording,
    read_pins,
    write_graphs,
)
from twin.preprocess.graph import GraphKind
from twin.preprocess.reference import nominal_reference
from twin.recordings.forms import frame_size
from twin.types import Form, PinGraph

PINS = ".npz"  # suffix of a file of found pins


@dataclass(frozen=True)
class Graphs:
    """What was made.

    Attributes
    ----------
    names : list of str
        Of the frames that have a graph.
    graphs : list of PinGraph
    left_out : list of str
        Frames without a graph, and why.
    written : list of Path
    """

    names: list[str]
    graphs: list[PinGraph]
    left_out: list[str]
    written: list[Path]

    def lines(self) -> list[str]:
        """For people."""
        first = self.graphs[0]
        counted = f"{len(self.graphs)} graphs; the first has {len(first.nodes_px)} nodes and {len(first.edges)} directed edges"
        return [*(f"skipped {reason}" for reason in self.left_out), counted]


def write_graphs_of(
    path: Path, sensor: SensorSpec, out: Path, *, kind: GraphKind = "voronoi", form: Form | None = None, legacy: bool = False
) -> Graphs:
    """Build the graphs of what lies at a path and write them to an existing folder.

    Parameters
    ----------
    path : Path
        A frame, anything that ``open_recording`` takes, or a ``pins.npz`` of found pins.
    form : Form, optional
        Of the frames; told by size and content by default.
    legacy : bool
        The published release's own method and boundary; Voronoi graphs of frames only.

    Raises
    ------
    FrameError
        No frame has a graph, the file is no ``pins.npz`` of this sensor, or ``legacy`` is asked for where it does not apply.
    """
    if legacy and (kind != "voronoi" or path.suffix == PINS):
        raise FrameError("--legacy makes Voronoi graphs of frames; leave --kind out and give frames")
    if path.suffix == PINS:
        found, nodes_px = read_pins(path, sensor.pins.count)
        names = list(found)
        form = form or form_of_pins(sensor, nodes_px)
        reference, image, left_out = nominal_reference(sensor, form), None, []
        graphs = graphs_of_nodes(kind, nodes_px, reference)
    else:
        seen = graphs_of_recording(path, sensor, kind, form, legacy=legacy)
        names, graphs, left_out = seen.names, seen.graphs, seen.left_out
        form, reference, image = seen.form, seen.reference, seen.first_image
    pictures = (
        draw_bare_graph(out, graphs[0])
        if legacy
        else draw_graph_pictures(out, sensor.name, frame_size(sensor, form), graphs[0], reference, image)
    )
    return Graphs(names, graphs, left_out, [write_graphs(out, names, graphs), *pictures])
