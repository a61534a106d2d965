"""Graphs as tensors: batching changes nothing about a graph."""

import numpy as np
import pytest
import torch

from training.batch import batch_graphs
from twin.types import PinGraph


def ring(count: int, seed: int) -> tuple[PinGraph, np.ndarray]:
    rng = np.random.default_rng(seed)
    node = np.arange(count)
    edges = np.concatenate([np.column_stack([node, (node + 1) % count]), np.column_stack([(node + 1) % count, node])])
    graph = PinGraph("delaunay", rng.normal(size=(count, 2)), edges, np.full(count, np.nan))
    return graph, rng.normal(size=(count, 3))


def test_a_batch_gives_what_its_graphs_give_alone():
    pairs = [ring(5, 0), ring(9, 1), ring(4, 2)]
    together = batch_graphs(*zip(*pairs, strict=True))
    joined = together.mean_over_neighbours(together.x)
    alone = [batch_graphs([g], [f]) for g, f in pairs]
    assert torch.allclose(joined, torch.cat([b.mean_over_neighbours(b.x) for b in alone]))
    assert torch.allclose(together.mean_over_nodes(together.x), torch.cat([b.mean_over_nodes(b.x) for b in alone]), atol=1e-6)


def test_neighbour_means_match_the_obvious_loop():
    graph, features = ring(7, 3)
    batch = batch_graphs([graph], [features])
    for node in range(7):
        sources = graph.edges[graph.edges[:, 1] == node, 0]
        assert np.allclose(batch.mean_over_neighbours(batch.x)[node], features[sources].mean(axis=0), atol=1e-6)


def test_wrong_rows_are_refused():
    graph, features = ring(5, 0)
    with pytest.raises(ValueError, match="one row a node"):
        batch_graphs([graph], [features[:-1]])
    with pytest.raises(ValueError, match="at least one"):
        batch_graphs([], [])
