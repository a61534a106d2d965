"""The paper's first table: size of each kind of graph, and the time to make it from found pins."""

from time import perf_counter
from typing import Any

import numpy as np

from training.dataset import PinTable
from twin.preprocess import make_graph
from twin.preprocess.graph import GraphKind

KINDS: tuple[GraphKind, ...] = ("knn", "delaunay", "voronoi")
TIMED = 200  # graphs
# directed edges and seconds of Table I, by pins and kind
PAPER = {
    (127, "knn"): (762, 0.004), (127, "delaunay"): (744, 0.007), (127, "voronoi"): (744, 0.019),
    (331, "knn"): (1986, 0.010), (331, "delaunay"): (1860, 0.008), (331, "voronoi"): (1860, 0.045),
}  # fmt: skip


def compare_graphs(pins: PinTable) -> list[dict[str, Any]]:
    """One row for each kind of graph: nodes, features, directed edges without contact and over frames, ms (median, this machine)."""
    outmost, rest = pins.reference.outmost, pins.reference.pins_px
    chosen = np.linspace(0, len(pins) - 1, min(TIMED, len(pins))).astype(int)
    rows = []
    for kind in KINDS:
        make_graph(kind, rest, outmost=outmost)  # loads the compiled code
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
