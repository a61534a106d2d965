"""The paper's graph networks ``gnn``, ``tac-vgnn`` and ``tac-vgnn-release``: five graph convolutions over each frame's own graph, pooling,
three dense layers. Places and areas are the node features.

A graph convolution (Kipf and Welling 2017) is ``D^-1/2 (A + I) D^-1/2 X W``. Here averaging is done before the product with ``W``. The
result is the same, and it costs less because each layer has at least as many output channels as input channels. Where the paper and
the published code ("release") differ, both are variants: the paper's dense layers have 96, 64 and 2 units; the release's have 128, 96
and 2, the first two with batch norm.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import nn

from training.data.pins import PinTable
from training.models.part import Learnt, PinModel, Recipe, refuse_sizes
from twin.frames.forms import frame_size
from twin.pins import Reference, make_graph

CHANNELS = (16, 32, 48, 64, 96)
DENSE = {"paper": (96, 64), "release": (128, 96)}
# Slope of the leaky ReLU for negative inputs.
SLOPE = 0.01
# Side in px of the resized image of the published code. The features are in px and px^2 of this image.
RELEASE_PX = 300.0


def graph_rows(edges: list[np.ndarray], nodes: int) -> csr_array:
    """Normalised adjacency (M N, N) of M graphs of ``nodes`` nodes, one below the other.

    A row holds the in-edges of a node with the weights ``1 / sqrt(d_i d_j)``, d being the in-degree including the loop that is added to
    every node.

    Parameters
    ----------
    edges : list of (E_k, 2) int arrays
        Directed edges of each graph, source and target.
    """
    every = np.concatenate([nodes * k + pairs for k, pairs in enumerate(edges)])
    loop = np.arange(nodes * len(edges))
    source, target = (np.concatenate([ends, loop]) for ends in every.T)
    degree = np.bincount(target)
    weight = (1 / np.sqrt(degree[source] * degree[target])).astype(np.float32)
    return csr_array((weight, (target, source % nodes)), shape=(len(loop), nodes))


def block_diagonal(rows: csr_array, chosen: np.ndarray) -> tuple[torch.Tensor, ...]:
    """The block diagonal matrix (B N, B N) of some of the graphs (B,) of ``graph_rows``, and its transpose, both as sparse rows."""
    nodes = rows.shape[1]
    start = nodes * np.arange(len(chosen))
    found = rows[(nodes * chosen[:, None] + np.arange(nodes)).ravel()]
    column = found.indices + np.repeat(start, np.diff(found.indptr[np.append(start, len(start) * nodes)]))
    matrix = csr_array((found.data, column, found.indptr), shape=(len(start) * nodes,) * 2)
    both = matrix, matrix.T.tocsr()
    parts: list[Any] = [map(torch.from_numpy, (each.indptr.astype(np.int32), each.indices.astype(np.int32), each.data)) for each in both]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR")  # "in beta state", said once
        return tuple(torch.sparse_csr_tensor(ends, column, weight, matrix.shape, check_invariants=False) for ends, column, weight in parts)


class NeighbourMean(torch.autograd.Function):
    """Product A h of a sparse matrix (V, V) and nodes (V, C). PyTorch's own derivative would transpose A for every batch."""

    @staticmethod
    def forward(ctx: Any, matrix: torch.Tensor, transpose: torch.Tensor, h: torch.Tensor) -> torch.Tensor:
        """The product; ``transpose`` is the transpose of ``matrix``."""
        ctx.transpose = transpose
        return _product(matrix, h)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[None, None, torch.Tensor | None]:
        """Derivatives with respect to the arguments of ``forward``."""
        return None, None, _product(ctx.transpose, gradient) if ctx.needs_input_grad[2] else None


def _product(matrix: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Product of a sparse and a dense matrix, written directly to the result (``@`` would first fill the result with zeros and copy it)."""
    out = x.new_empty(matrix.shape[0], x.shape[1])
    return torch.addmm(out, matrix, x, beta=0, out=out)


class Gcn(nn.Module):
    """Five graph convolutions with batch norm and leaky ReLU, mean over the nodes, dense layers.

    Parameters
    ----------
    features : int
        Node features: 2 (x, y) in ``gnn``, 3 (and the Voronoi area) in ``tac-vgnn``.
    outputs : int
    variant : {"paper", "release"}
    """

    def __init__(self, features: int, outputs: int, variant: str = "paper") -> None:
        super().__init__()
        widths = (features, *CHANNELS)
        self.convolutions = nn.ModuleList([nn.Linear(a, b, bias=False) for a, b in zip(widths[:-1], widths[1:], strict=True)])
        self.norms = nn.ModuleList([nn.BatchNorm1d(c) for c in CHANNELS])
        for layer in self.convolutions:
            nn.init.xavier_uniform_(cast(nn.Linear, layer).weight)
        dense: list[nn.Module] = []
        width = CHANNELS[-1]
        for units in DENSE[variant]:
            normed = [nn.BatchNorm1d(units)] if variant == "release" else []
            dense += [nn.Linear(width, units), *normed, nn.LeakyReLU()]
            width = units
        self.dense = nn.Sequential(*dense, nn.Linear(width, outputs))

    def forward(self, x: torch.Tensor, matrix: torch.Tensor, transpose: torch.Tensor) -> dict[str, torch.Tensor]:
        """Labels from nodes.

        Parameters
        ----------
        x : (B, N, F) float
        matrix, transpose : (B N, B N) sparse rows
            Normalised adjacency and its transpose.

        Returns
        -------
        dict
            ``mean`` (B, K).
        """
        graphs, nodes = x.shape[:2]
        h = x.reshape(graphs * nodes, -1)
        for layer, norm in zip(self.convolutions, self.norms, strict=True):
            h = nn.functional.leaky_relu_(norm(layer(NeighbourMean.apply(matrix, transpose, h))), SLOPE)
        return {"mean": self.dense(h.view(graphs, nodes, -1).mean(dim=1))}


class GraphInputs:
    """A graph for every frame: ``batch`` gives (B, N, F) and the block diagonal adjacency with its transpose.

    Parameters
    ----------
    features : (M, N, F) float
    edges : list of (E_k, 2) int arrays
        Directed edges of each of M graphs.
    """

    def __init__(self, features: np.ndarray, edges: list[np.ndarray]) -> None:
        self.x, self.rows = torch.from_numpy(features.astype(np.float32)), graph_rows(edges, features.shape[1])

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Arguments of the network for some rows."""
        return self.x[rows], *block_diagonal(self.rows, rows.numpy())


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
        return Gcn(3 if self.edges == "delaunay" else 2, outputs, self.dense)

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> GraphInputs:
        """See ``PinModel``. Nothing is learnt before training, and the camera's place is not corrected."""
        width_px = frame_size(pins.sensor, pins.form)[0]
        features = pixel_features(pins.nodes_px, pins.area_px2 if self.edges == "delaunay" else None, width_px)
        edges = [make_graph(self.edges, nodes_px).edges for nodes_px in pins.nodes_px]
        return GraphInputs(features, edges)


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
