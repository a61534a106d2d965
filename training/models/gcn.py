"""The paper's graph networks: five graph convolutions over a graph of its own for every frame, pooling, three dense layers.

A graph convolution (Kipf and Welling 2017) is ``D^-1/2 (A + I) D^-1/2 X W``. Averaging comes first and ``W`` second, which
gives the same and costs less, as channels only grow here. Where paper and release differ, both are variants: the paper's
dense units 96, 64, 2; the release's 128, 96, 2, the first two with batch norm.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

CHANNELS = (16, 32, 48, 64, 96)
DENSE = {"paper": (96, 64), "release": (128, 96)}


@dataclass(frozen=True)
class GraphRows:
    """Normalised adjacency of M graphs of N nodes, row by row, and its transpose.

    Attributes
    ----------
    start : (M, N + 1) int32
        Where each node's entries begin, counted from the graph's first one.
    first : (M + 1,) int64
        Where each graph's entries begin in ``column`` and ``weight``.
    column : (nnz,) int16
    weight : (nnz,) float32
    """

    start: np.ndarray
    first: np.ndarray
    column: np.ndarray
    weight: np.ndarray

    def batch(self, rows: np.ndarray) -> torch.Tensor:
        """The block diagonal matrix (B N, B N) of some of the graphs, as sparse rows."""
        n = self.start.shape[1] - 1
        counts = self.first[rows + 1] - self.first[rows]
        offset = np.concatenate([[0], np.cumsum(counts)])
        take = np.arange(offset[-1]) + np.repeat(self.first[rows] - offset[:-1], counts)
        column = self.column[take].astype(np.int32) + np.repeat(np.arange(len(rows), dtype=np.int32) * n, counts)
        start = (self.start[rows, :-1] + offset[:-1, None]).ravel()
        crow = torch.from_numpy(np.append(start, offset[-1]).astype(np.int32))
        size = (len(rows) * n,) * 2
        column, weight = torch.from_numpy(column), torch.from_numpy(self.weight[take])
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse CSR")  # "in beta state", said once
            return torch.sparse_csr_tensor(crow, column, weight, size, check_invariants=False)


def graph_rows(edges: list, nodes: int, *, transposed: bool = False) -> GraphRows:
    """Normalise the directed edges (E_k, 2), source and target, of graphs of ``nodes`` nodes each; every node gets a loop.

    A row holds the in-edges of a node, with ``1 / sqrt(d_i d_j)``, d the in-degrees with loop; transposed, its out-edges.
    """
    starts, columns, weights = [], [], []
    loop = np.arange(nodes)
    for pairs in edges:
        source, target = np.concatenate([pairs[:, 0], loop]), np.concatenate([pairs[:, 1], loop])
        degree = np.bincount(target, minlength=nodes)
        row, column = (source, target) if transposed else (target, source)
        order = np.lexsort((column, row))
        starts.append(np.concatenate([[0], np.cumsum(np.bincount(row, minlength=nodes))]))
        columns.append(column[order])
        weights.append(1 / np.sqrt(degree[source[order]] * degree[target[order]]))
    first = np.concatenate([[0], np.cumsum([len(c) for c in columns])])
    return GraphRows(
        np.array(starts, np.int32), first, np.concatenate(columns).astype(np.int16), np.concatenate(weights).astype(np.float32)
    )


class _Average(torch.autograd.Function):
    """A product with a constant sparse matrix, whose transpose is at hand for the way back."""

    @staticmethod
    def forward(ctx, matrix, transpose, x):
        ctx.transpose = transpose
        return matrix @ x

    @staticmethod
    def backward(ctx, gradient):
        return None, None, ctx.transpose @ gradient.contiguous()


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
        self.features, self.outputs, self.variant = features, outputs, variant
        widths = (features, *CHANNELS)
        self.convolutions = nn.ModuleList([nn.Linear(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)])
        self.norms = nn.ModuleList([nn.BatchNorm1d(c) for c in CHANNELS])
        for layer in self.convolutions:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
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
            h = nn.functional.leaky_relu(norm(layer(_Average.apply(matrix, transpose, h))), inplace=True)
        return {"mean": self.dense(h.view(graphs, nodes, -1).mean(dim=1))}

    def configuration(self) -> dict:
        """What builds the same network again."""
        return {"features": self.features, "outputs": self.outputs, "variant": self.variant}
