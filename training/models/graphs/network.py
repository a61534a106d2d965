"""The paper's graph networks: five graph convolutions over each frame's own graph, pooling, three dense layers.

A graph convolution (Kipf and Welling 2017) is ``D^-1/2 (A + I) D^-1/2 X W``. Here averaging is done before the product with ``W``. The
result is the same, and it costs less because each layer has at least as many output channels as input channels. Where the paper and
the published code ("release") differ, both are variants: the paper's dense layers have 96, 64 and 2 units; the release's have 128, 96
and 2, the first two with batch norm.
"""

import warnings
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import nn

CHANNELS = (16, 32, 48, 64, 96)
DENSE = {"paper": (96, 64), "release": (128, 96)}
# Slope of the leaky ReLU for negative inputs.
SLOPE = 0.01


@dataclass(frozen=True)
class GraphRows:
    """Normalised adjacency, or its transpose, of M graphs of N nodes as sparse rows.

    Attributes
    ----------
    start : (M, N + 1) int32
        Index of each node's first entry, counted from the graph's first entry.
    first : (M + 1,) int64
        Index of each graph's first entry in ``column`` and ``weight``.
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


def graph_rows(edges: list[np.ndarray], nodes: int, *, transposed: bool = False) -> GraphRows:
    """Normalise the directed edges (E_k, 2), source and target, of graphs of ``nodes`` nodes each. A loop is added to every node.

    A row holds the in-edges of a node (``transposed``: its out-edges) with the weights ``1 / sqrt(d_i d_j)``, d being the in-degree
    including the loop.
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


class GraphConvolution(torch.autograd.Function):
    """``leaky_relu(batch_norm(A h W^T))`` in training, with the statistics of the batch (Ioffe and Szegedy 2015).

    The statistics of the norm follow from the mean m and the covariance S of ``a = A h``: output channel c has the mean ``W_c m`` and
    the variance ``W_c S W_c^T``. With these the norm is linear. Therefore norm and weights are one product with ``K W``,
    ``K = diag(gain / deviation)``, and no pass over the wider output is needed. A bias before the norm would cancel, so there is none.
    ``backward`` is the derivative of the same formulas and uses the transpose of A.
    """

    @staticmethod
    def forward(
        ctx: Any,  # PyTorch declares no type for an object with these attributes
        matrix: torch.Tensor,
        transpose: torch.Tensor,
        h: torch.Tensor,
        weight: torch.Tensor,
        gain: torch.Tensor,
        offset: torch.Tensor,
        eps: float,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Activations (V, D) of the nodes of all graphs, and mean and variance (D,) of the norm's inputs.

        Parameters
        ----------
        matrix, transpose : (V, V) sparse rows
            A and its transpose.
        h : (V, C) float
        weight : (D, C) float
        gain, offset : (D,) float
            Parameters of the norm.
        eps : float
            Added to the variance, so that a constant channel does not lead to a division by 0.
        """
        around = _product(matrix, h)
        mean = around.mean(dim=0)
        around.sub_(mean)
        spread = weight @ (around.T @ around).div_(len(around))  # W S
        variance = (spread * weight).sum(dim=1)
        inverse = (variance + eps).rsqrt()
        out = torch.addmm(offset, around, ((gain * inverse)[:, None] * weight).T)
        out = nn.functional.leaky_relu_(out, SLOPE)
        ctx.transpose = transpose
        ctx.save_for_backward(around, out, weight, gain, spread, inverse)
        mean = weight @ mean
        ctx.mark_non_differentiable(mean, variance)
        return out, mean, variance

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor, *_: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Derivatives with respect to the arguments of ``forward``, from those with respect to its activations (V, D)."""
        around, out, weight, gain, spread, inverse = ctx.saved_tensors
        size = gain * inverse
        of_norm = torch.ops.aten.leaky_relu_backward(gradient, out, SLOPE, True)  # derivatives by the norm's output
        of_offset = (of_norm.new_ones(1, len(of_norm)) @ of_norm)[0]
        pull = of_norm.T @ around
        of_gain = (pull * weight).sum(dim=1) * inverse
        of_weight = size[:, None] * (pull - (of_gain * inverse)[:, None] * spread)
        of_h = None
        if ctx.needs_input_grad[2]:
            share = size * of_gain * inverse / len(out)
            of_around = torch.addmm(-(size * of_offset / len(out)) @ weight, of_norm, size[:, None] * weight)
            of_around.addmm_(around, weight.T @ (share[:, None] * weight), alpha=-1)
            of_h = _product(ctx.transpose, of_around)
        return None, None, of_h, of_weight, of_gain, of_offset, None


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
        self.features, self.outputs, self.variant = features, outputs, variant
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
            h = self._convolve(h, matrix, transpose, cast(nn.Linear, layer).weight, cast(nn.BatchNorm1d, norm))
        return {"mean": self.dense(h.view(graphs, nodes, -1).mean(dim=1))}

    def _convolve(
        self, h: torch.Tensor, matrix: torch.Tensor, transpose: torch.Tensor, weight: torch.Tensor, norm: nn.BatchNorm1d
    ) -> torch.Tensor:
        running_mean, running_var = cast(torch.Tensor, norm.running_mean), cast(torch.Tensor, norm.running_var)
        if not self.training:
            size = norm.weight * (running_var + norm.eps).rsqrt()
            out = torch.addmm(norm.bias - size * running_mean, matrix @ h, (size[:, None] * weight).T)
            return nn.functional.leaky_relu_(out, SLOPE)
        out, mean, variance = GraphConvolution.apply(matrix, transpose, h, weight, norm.weight, norm.bias, norm.eps)
        with torch.no_grad():
            momentum = cast(float, norm.momentum)
            running_mean.lerp_(mean, momentum)
            running_var.lerp_(variance * (len(h) / max(len(h) - 1, 1)), momentum)
        return out
