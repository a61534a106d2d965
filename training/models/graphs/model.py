"""The paper's graph networks as models: ``gnn``, ``tac-vgnn`` and ``tac-vgnn-release``."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from training.data.pins import PinTable
from training.models.graphs.inputs import GraphInputs, frame_edges, pixel_features
from training.models.graphs.network import Gcn
from training.models.part import Learnt, PinModel, refuse_sizes
from training.models.recipes import Recipe
from twin.frames.forms import frame_size
from twin.pins.labelling.reference import Reference


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
