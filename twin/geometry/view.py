"""The solid's motion on the nodes of the sensor's mesh, which is the same for all contacts."""

from dataclasses import dataclass

import numpy as np

from twin.geometry.mesh import SensorMesh
from twin.geometry.solid import Solid, surface_operators
from twin.types import FloatArray


@dataclass(frozen=True)
class NodeView:
    """Linear map from the solid's controls to the mesh's nodes.

    Attributes
    ----------
    mesh : SensorMesh
    rest_mm : (n, 3) float
        The solid's controls at rest.
    fine, coarse : (k, side^2), (k, coarse_side^2) float
        Values of the splines at the k nodes of a layer.
    skin, gel : (layers, functions) float
        Values through the depth at the layers of nodes in the skin and below it.
    """

    mesh: SensorMesh
    rest_mm: FloatArray
    fine: FloatArray
    coarse: FloatArray
    skin: FloatArray
    gel: FloatArray

    @classmethod
    def of(cls, mesh: SensorMesh, solid: Solid) -> "NodeView":
        """The map for one solid of a sensor."""
        at = solid.chart.square(mesh.disc)
        layers = np.linspace(0, 1, mesh.skin_layers + 1)
        count = solid.inner.stop // solid.basis.count**2
        hats = np.maximum(1 - np.abs(layers[:, None] * (count - 1) - np.arange(count)), 0)
        below = 1 + np.linspace(0, 1, mesh.grid[0] - mesh.skin_layers)[1:]
        return cls(
            mesh,
            solid.control_mm,
            surface_operators(solid.basis, at)[0],
            surface_operators(solid.coarse, at)[0],
            hats,
            solid.through.values(below),
        )

    def nodes(self, control_mm: FloatArray) -> FloatArray:
        """Nodes (n, 3) of the deformed body."""
        moved = control_mm - self.rest_mm
        upper = self.skin.shape[1] * self.fine.shape[1]
        skin = np.einsum("kc,lcx->lkx", self.fine, moved[:upper].reshape(self.skin.shape[1], -1, 3), optimize=True)
        deep = np.einsum("kc,lcx->lkx", self.coarse, moved[upper:].reshape(-1, self.coarse.shape[1], 3), optimize=True)
        layers = np.concatenate([np.tensordot(self.skin, skin, 1), np.tensordot(self.gel, np.concatenate([skin[-1:], deep]), 1)])
        return self.mesh.nodes_mm + layers.reshape(-1, 3)
