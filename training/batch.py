"""Graphs as torch tensors: many graphs as one large disconnected graph."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from twin.types import PinGraph


@dataclass(frozen=True)
class GraphBatch:
    """B graphs side by side.

    Attributes
    ----------
    x : (V, F) float32
        Node features of all graphs, one graph after the other.
    edge_index : (2, E) int64
        Directed edges (source, target), indices into ``x``.
    graph_of_node : (V,) int64
        Which graph each node belongs to.
    """

    x: torch.Tensor
    edge_index: torch.Tensor
    graph_of_node: torch.Tensor

    def mean_over_neighbours(self, value: torch.Tensor) -> torch.Tensor:
        """Mean of ``value`` (V, F) over each node's in-neighbours; 0 where it has none."""
        source, target = self.edge_index
        total = torch.zeros_like(value).index_add_(0, target, value[source])
        degree = torch.zeros(len(value), 1).index_add_(0, target, torch.ones(len(target), 1))
        return total / degree.clamp(min=1)

    def mean_over_nodes(self, value: torch.Tensor) -> torch.Tensor:
        """Mean of ``value`` (V, F) over the nodes of each graph: (B, F)."""
        count = int(self.graph_of_node.max()) + 1
        total = torch.zeros(count, value.shape[1]).index_add_(0, self.graph_of_node, value)
        return total / torch.bincount(self.graph_of_node, minlength=count)[:, None]


def batch_graphs(graphs: Sequence[PinGraph], features: Sequence[np.ndarray]) -> GraphBatch:
    """Join graphs and their (N_i, F) node features into one batch.

    Raises
    ------
    ValueError
        If there is no graph, or a feature array does not have one row a node.
    """
    if not graphs or len(graphs) != len(features):
        raise ValueError(f"need as many feature arrays as graphs, and at least one; got {len(features)} and {len(graphs)}")
    for graph, rows in zip(graphs, features, strict=True):
        if len(rows) != len(graph.nodes_px):
            raise ValueError(f"features must have one row a node ({len(graph.nodes_px)}), got {len(rows)}")
    sizes = [len(graph.nodes_px) for graph in graphs]
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    edges = np.concatenate([graph.edges + start for graph, start in zip(graphs, starts, strict=True)])
    return GraphBatch(
        x=torch.from_numpy(np.concatenate(features).astype(np.float32)),
        edge_index=torch.from_numpy(np.ascontiguousarray(edges.T).astype(np.int64)),
        graph_of_node=torch.from_numpy(np.repeat(np.arange(len(graphs)), sizes)),
    )
