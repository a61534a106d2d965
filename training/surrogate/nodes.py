"""Displacements and forces of the finite elements' skin at the surrogate's nodes."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import Delaunay

from training.surrogate.compliance import NODE_RINGS, POLAR_DEG
from training.surrogate.symmetry import ring_directions
from twin.geometry.shapes import SkinShape
from twin.mechanics import SkinSolver
from twin.types import ContactState, FloatArray, IntArray

NEIGHBOURS = 24
"""Number of neighbouring points from which a value is interpolated."""
ON_THE_DOME = 1e-6
"""Tolerance, as a share of the radius, within which a node of the mesh lies on the dome."""


@dataclass(frozen=True)
class AtNodes:
    """The surrogate's M nodes in relation to the mesh of one sensor.

    Attributes
    ----------
    outer : (k,) int
        Nodes of the mesh on the skin's outside.
    rest_mm : (k, 3) float
        Positions of these nodes at rest.
    shares : (M, k) float
        Matrix that interpolates displacements of these nodes to the surrogate's nodes.
    shape : SkinShape
    cells : Delaunay
        Triangles between the surrogate's nodes and one more ring around them. That ring takes the forces beyond the nodes.
    """

    outer: IntArray
    rest_mm: FloatArray
    shares: FloatArray
    shape: SkinShape
    cells: Delaunay

    @classmethod
    def of(cls, solver: SkinSolver) -> "AtNodes":
        """The surrogate's nodes for the solver of a sensor with a dome."""
        rest, radius = solver.rest().nodes_mm, solver.spec.skin.outer_radius_mm
        outer = np.flatnonzero(np.abs(np.linalg.norm(rest, axis=1) - radius) < ON_THE_DOME * radius)
        outer = outer[np.unique(np.round(laid_flat(rest[outer]), 6), axis=0, return_index=True)[1]]
        phase, beyond = solver.spec.pins.phase_deg, NODE_RINGS + 1
        nodes = ring_directions(NODE_RINGS, POLAR_DEG, phase)
        around = ring_directions(beyond, POLAR_DEG * beyond / NODE_RINGS, phase)
        return cls(outer, rest[outer], interpolation_matrix(rest[outer], nodes), solver.shape, Delaunay(laid_flat(around)))

    def moved_mm(self, state: ContactState) -> FloatArray:
        """Displacements (M, 3) float32 of the surrogate's nodes."""
        return (self.shares @ (state.nodes_mm[self.outer] - self.rest_mm)).astype(np.float32)

    def force_n(self, state: ContactState) -> FloatArray:
        """Forces on the skin (M, 3) float32. The force at each contact place is shared among the three nodes around it."""
        out = np.zeros((len(self.cells.points), 3))
        if len(state.normal_n):
            places = laid_flat(self.shape.outside(state.contact_place))
            cell = self.cells.find_simplex(places)
            corner = self.cells.transform[cell]
            parts = np.einsum("nij,nj->ni", corner[:, :2], places - corner[:, 2])
            parts = np.column_stack([parts, 1 - parts.sum(axis=1)]) * (cell >= 0)[:, None]
            force = state.normal_n[:, None] * state.normal - state.tangential_n
            for k in range(3):
                np.add.at(out, self.cells.simplices[cell, k], parts[:, k, None] * force)
        return out[: len(self.shares)].astype(np.float32)


def interpolation_matrix(start: FloatArray, places: FloatArray) -> FloatArray:
    """Matrix (N, P) that interpolates values known in directions (P, 3) to other directions (N, 3)."""
    shares = RBFInterpolator(laid_flat(start), np.eye(len(start)), neighbors=NEIGHBOURS, kernel="thin_plate_spline")
    return shares(laid_flat(places))


def laid_flat(directions: FloatArray) -> FloatArray:
    """Map directions (n, 3), of any length, to a plane (n, 2): the angle from the apex becomes the distance from the origin."""
    across = np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
    return directions[:, :2] * np.arctan2(across, directions[:, 2:]) / np.maximum(across, 1e-12)
