"""Inputs of the paper's graph networks: each frame has its own graph, with places and areas as node features."""

import numpy as np
import torch

from training.models.graphs.network import GraphRows, graph_rows
from twin.pins.flips import directed_edges
from twin.pins.graph import knn_edges
from twin.pins.voronoi import triangulate

# Side in px of the resized image of the published code. The features are in px and px^2 of this image.
RELEASE_PX = 300.0


class GraphInputs:
    """A graph for every frame: ``batch`` gives (B, N, F) and the block diagonal adjacency with its transpose.

    Parameters
    ----------
    features : (M, N, F) float
    edges : list of (E_k, 2) int arrays
        Directed edges of each of M graphs.
    symmetric : bool
        Whether every edge is given in both directions.
    """

    def __init__(self, features: np.ndarray, edges: list[np.ndarray], *, symmetric: bool) -> None:
        self.x = torch.from_numpy(features.astype(np.float32))
        nodes = features.shape[1]
        self.forward: GraphRows = graph_rows(edges, nodes)
        self.back: GraphRows = self.forward if symmetric else graph_rows(edges, nodes, transposed=True)

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Arguments of the network for some rows."""
        chosen = rows.numpy()
        matrix = self.forward.batch(chosen)
        return self.x[rows], matrix, matrix if self.back is self.forward else self.back.batch(chosen)


def frame_edges(kind: str, nodes_px: np.ndarray) -> np.ndarray:
    """Directed edges (E, 2) of one frame: ``knn``, or ``delaunay`` (nearest neighbours if the pins form no triangles)."""
    triangles = None if kind == "knn" else triangulate(nodes_px)
    return knn_edges(nodes_px) if triangles is None else directed_edges(triangles, len(nodes_px))


def pixel_features(nodes_px: np.ndarray, area_px2: np.ndarray | None, width_px: int) -> np.ndarray:
    """Features (M, N, 2 or 3) as published: x and y from their medians in px of the published code's image, and the area (px^2)."""
    scale = RELEASE_PX / width_px
    centred = scale * (nodes_px - np.median(nodes_px, axis=1, keepdims=True))
    return centred if area_px2 is None else np.concatenate([centred, scale**2 * area_px2[..., None]], axis=-1)
