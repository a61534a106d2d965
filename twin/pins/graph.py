"""Graphs over the pins (nearest neighbours, Delaunay, Voronoi), and the features of their nodes."""

from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from twin.pins.labelling.reference import Reference, median_px
from twin.pins.voronoi import Net, directed_edges, triangulate, voronoi
from twin.types import PinGraph

GraphKind = Literal["knn", "delaunay", "voronoi"]
# Neighbours of a node in the published kNN graph (Tac-VGNN, 2023): 6 N directed edges.
KNN = 6


def knn_edges(nodes_px: np.ndarray, k: int = KNN) -> np.ndarray:
    """(k N, 2) directed edges from each node to the ``k`` nearest other nodes."""
    n = len(nodes_px)
    k = min(k, n - 1)
    if k < 1:
        return np.zeros((0, 2), int)
    _, index = cKDTree(nodes_px).query(nodes_px, k=min(k + 1, n))
    others = index != np.arange(n)[:, None]
    others[others.all(axis=1), -1] = False  # if nodes coincide, a node may not be its own nearest; then the farthest one is left out
    return np.stack([np.repeat(np.arange(n), k), index[others].ravel()], axis=1)


def _delaunay_edges(nodes_px: np.ndarray, net: Net | None) -> np.ndarray | None:
    """Directed edges (E, 2) of the nodes' Delaunay triangles, from a net if one is given and leads to them; None if there are none."""
    moved = None if net is None else net.move(nodes_px)
    if moved is not None:
        return moved.edges
    triangles = triangulate(nodes_px)
    return None if triangles is None else directed_edges(triangles, len(nodes_px))


def make_graph(kind: GraphKind, nodes_px: np.ndarray, *, outmost: np.ndarray | None = None, net: Net | None = None) -> PinGraph:
    """A graph over nodes (N, 2).

    ``knn``: edges to the 6 nearest other nodes. ``delaunay``: both directions of every side of the nodes' Delaunay triangles.
    ``voronoi``: the same edges, with clipped Voronoi areas and cells (``outmost`` as in ``voronoi``). If the nodes have no
    triangulation, because they are collinear or coincide, the edges are those of ``knn``. With the reference's ``net`` the same triangles
    are found in a tenth of the time.

    Raises
    ------
    ValueError
        There is no such kind.
    """
    if kind not in get_args(GraphKind):
        raise ValueError(f"kind must be knn, delaunay or voronoi, not {kind!r}")
    triangulated = None if kind == "knn" else _delaunay_edges(nodes_px, net)
    edges = knn_edges(nodes_px) if triangulated is None else triangulated
    if kind != "voronoi":
        return PinGraph(kind, nodes_px, edges, np.full(len(nodes_px), np.nan))
    tessellation = voronoi(nodes_px, outmost=outmost, edges=triangulated)
    return PinGraph(kind, nodes_px, edges, tessellation.area_px2, tessellation.cells)


def node_features(graph: PinGraph, reference: Reference, kind: Literal["relative", "pixels"] = "relative") -> np.ndarray:
    """Node features (N, F) of a graph.

    ``relative``: columns x, y, dx, dy[, area], independent of the image's scale. x and y are centred on their medians, dx and dy are the
    displacement from rest, all in mean rest spacings. A graph with a tessellation also has the area relative to the area at rest.
    ``pixels``: as published, x and y in px centred on their medians[, area in px^2].

    Raises
    ------
    ValueError
        There is no such kind, or the reference has another number of pins.
    """
    if len(graph.nodes_px) != len(reference.pins_px):
        told = f"the graph has {len(graph.nodes_px)} pins, the reference {len(reference.pins_px)}: they are of two sensors"
        raise ValueError(f"{told}; give the reference of the Pipeline that made the graph")
    centred = graph.nodes_px - median_px(graph.nodes_px)
    areas = graph.kind == "voronoi"
    if kind == "pixels":
        return np.column_stack([centred, graph.area_px2]) if areas else centred
    if kind != "relative":
        raise ValueError(f"kind must be relative or pixels, not {kind!r}")
    spacing = reference.spacing_px.mean()
    moved = (graph.nodes_px - reference.pins_px) / spacing
    columns = [centred / spacing, moved, *([(graph.area_px2 / reference.area_px2)[:, None]] if areas else [])]
    return np.concatenate(columns, axis=1)
