"""``twin graph``: graphs of frames or of found pins, as arrays and pictures."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor, writable_folder

HELP = """Build the graph of a frame, a folder of frames, or of a pins.npz.

\b
knn       edges from each pin to its 6 nearest (directed)
delaunay  both directions of every side of the Delaunay triangles
voronoi   the same edges, and the area of each pin's Voronoi cell inside the enlarged
          boundary around the outermost pins

\b
Writes graph.npz: image_name (M,), nodes_px (M, N, 2), area_px2 (M, N), edges (E, 2) of all
graphs one after the other (graph k has edges[edge_start[k]:edge_start[k+1]]), and pictures of
the first: graph.png, and surface.png (cell area as a surface: no contact, contact, difference).

With --legacy (frames in the recordings' form only) pins, edges and areas are those of the published release: nodes in its
detector's order, px of its resized image about its scalar median; a frame without exactly all pins is left out.
"""


class Kind(StrEnum):
    """Kinds of graphs."""

    KNN = "knn"
    DELAUNAY = "delaunay"
    VORONOI = "voronoi"


@app.command("graph", help=HELP)
def graph(
    path: Annotated[Path, typer.Argument(help="frame, folder of frames, or pins.npz")],
    sensor: Sensor,
    kind: Annotated[Kind, typer.Option("--kind", help="kind of graph")] = Kind.VORONOI,
    out: Out = Path("out/graph"),
    form: FormOrAuto = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="the published release's own method and boundary, to compare with")] = False,
) -> None:
    from scenes import load_sensor
    from twin.cli.output import tell
    from twin.graphing import write_graphs_of

    made = write_graphs_of(path, load_sensor(sensor), writable_folder(out), kind=kind.value, form=form, legacy=legacy)
    tell(made)
