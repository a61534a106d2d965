"""The paper's graph networks as models: ``gnn``, ``tac-vgnn`` and ``tac-vgnn-release``."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from training.data.pins import PinTable
from training.models.graphs.network import Gcn, GraphRows, graph_rows
from training.models.part import Learnt, PinModel, Recipe, refuse_sizes
from twin.frames.forms import frame_size
from twin.pins.graph import knn_edges
from twin.pins.labelling.reference import Reference
from twin.pins.voronoi import directed_edges, triangulate

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


@dataclass(frozen=True, kw_only=True)
class GraphModel(PinModel):
    """A graph network in which each frame has its own graph.

    Attributes
    ----------
    edges : {"knn", "delaunay"}
        Edges between nearest neighbours, with the node features x and y; or Delaunay's, with x, y and the Voronoi area.
    dense : {"paper", "release"}
        Dense layers as the paper states them, or as in the published code.
    """

    edges: Literal["knn", "delaunay"]
    dense: Literal["paper", "release"] = "paper"

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> Gcn:
        """See ``Model``; there are no sizes."""
        refuse_sizes(self, size)
        return Gcn(3 if self._sees_areas else 2, outputs, self.dense)

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> GraphInputs:
        """See ``PinModel``. Nothing is learnt before training, and the camera's place is not corrected."""
        width_px = frame_size(pins.sensor, pins.form)[0]
        features = pixel_features(pins.nodes_px, pins.area_px2 if self._sees_areas else None, width_px)
        edges = [frame_edges(self.edges, nodes_px) for nodes_px in pins.nodes_px]
        return GraphInputs(features, edges, symmetric=self._sees_areas)

    @property
    def _sees_areas(self) -> bool:
        return self.edges == "delaunay"


# Settings that the paper does not state are those of the published code, with two changes: the batches are smaller, so that there are
# more steps, and the learning rate falls to 0.
PAPER_RECIPE = Recipe(epochs=150, batch=128, rate=2e-3, schedule="cosine", decay=0.0, average=0.0, scaling="none", members=1)
RELEASE_RECIPE = replace(PAPER_RECIPE, epochs=200, batch=512, rate=1.5e-3, schedule="plateau", patience=30)

GNN = GraphModel(
    name="gnn",
    description="the paper's graph network on nearest neighbours, without areas",
    recipe=PAPER_RECIPE,
    edges="knn",
    published_mm_deg=(0.07, 1.16),
)
TAC_VGNN = GraphModel(
    name="tac-vgnn",
    description="the paper's network on Delaunay graphs with Voronoi areas",
    recipe=PAPER_RECIPE,
    edges="delaunay",
    published_mm_deg=(0.05, 1.02),
)
TAC_VGNN_RELEASE = replace(
    TAC_VGNN,
    name="tac-vgnn-release",
    description="the same with the dense layers of the published code",
    recipe=RELEASE_RECIPE,
    dense="release",
)
