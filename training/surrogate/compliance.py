"""Linear compliance of the skin: displacements of its outside and its pins for small forces, from the solver's own elements at rest.

``AtNodes`` gives displacements and forces of the finite elements' skin at the same nodes.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import Delaunay

from scenes.sensor import SensorSpec
from training.surrogate.symmetry import ring_directions
from twin.geometry.shapes import SkinShape, shape_of
from twin.geometry.solid import Resolution, Solid, build_solid, pin_pose, surface_operators
from twin.mechanics import SkinSolver
from twin.mechanics.body.elements import PAIRS, soft_body
from twin.types import ContactState, FloatArray, IntArray

NODE_RINGS = 9
"""Number of rings of nodes around the apex: 271 nodes, 2.2 mm apart on a dome of 20 mm. With 12 rings the linear skin is no better."""
POLAR_DEG = 58.0
"""Angle of the outermost ring from the apex. All contacts of the domain lie inside it."""
PROBE_MM = 1e-4
"""Step, in displacement of the controls, of the finite difference that gives the pins' motion."""
NEIGHBOURS = 24
"""Number of neighbouring points from which a value is interpolated."""
ON_THE_DOME = 1e-6
"""Tolerance, as a share of the radius, within which a node of the mesh lies on the dome."""


@dataclass(frozen=True)
class Compliance:
    """Linear answers to forces at M nodes of the outer skin.

    Attributes
    ----------
    node_mm : (M, 3) float
        On the outer sphere.
    nodes : (M, 3, M, 3) float
        Displacement of a node (first two) for a force at another (last two), mm/N.
    base, axis : (N, 3, M, 3) float
        Displacement of pins' feet, mm/N, and change of their axes, 1/N.
    """

    node_mm: FloatArray
    nodes: FloatArray
    base: FloatArray
    axis: FloatArray


def compliance_of(sensor: SensorSpec, *, resolution: Resolution | None = None) -> Compliance:
    """The linear compliance of a sensor's body at rest. It takes some seconds."""
    solid = build_solid(sensor.geometry, resolution=resolution)
    free = ~solid.fixed
    matrix = _stiffness(sensor, solid)
    node = sensor.skin.outer_radius_mm * ring_directions(NODE_RINGS, POLAR_DEG, sensor.pins.phase_deg)
    side = solid.basis.count**2
    value = surface_operators(solid.basis, solid.chart.square(shape_of(sensor.skin).place(node)))[0]
    right = np.zeros((len(free), 3, len(node), 3))
    for i in range(3):
        right[:side, i, :, i] = value.T
    answer = cho_solve(cho_factor(matrix, lower=True), right[free].reshape(len(matrix), -1))
    moved = np.zeros((len(free), 3, 3 * len(node)))
    moved[free] = answer.reshape(-1, 3, 3 * len(node))
    nodes = np.einsum("nc,cik->nik", value, moved[:side], optimize=True).reshape(len(node), 3, len(node), 3)
    scale = PROBE_MM / np.abs(moved).max()
    base, axis, _ = pin_pose(solid, solid.control_mm)
    bases, axes = np.zeros((2, len(base), 3, 3 * len(node)))
    for k in range(3 * len(node)):
        b, a, _ = pin_pose(solid, solid.control_mm + scale * moved[:, :, k])
        bases[:, :, k], axes[:, :, k] = (b - base) / scale, (a - axis) / scale
    shape = (len(base), 3, len(node), 3)
    return Compliance(node, nodes, bases.reshape(shape), axes.reshape(shape))


def _stiffness(sensor: SensorSpec, solid: Solid) -> FloatArray:
    """Stiffness (n, n) of the free controls' unknowns at rest, N/mm."""
    kinds = soft_body(solid, sensor.skin, sensor.gel)
    free = ~solid.fixed
    size = 3 * int(free.sum())
    first = np.where(free, 3 * (np.cumsum(free) - 1), size)  # clamped controls go to rows beyond the end
    matrix = np.zeros((size + 3, size + 3))
    for kind in kinds:
        controls = kind.cells.controls
        count = controls.shape[1]
        blocks = np.zeros((len(controls), len(PAIRS), count, count))
        kind.stiffness(solid.control_mm, 0.0, blocks)
        at = first[controls]
        for p, (i, k) in enumerate(PAIRS):
            np.add.at(matrix, (at[:, :, None] + i, at[:, None, :] + k), blocks[:, p])
            if i != k:
                np.add.at(matrix, (at[:, :, None] + k, at[:, None, :] + i), blocks[:, p].transpose(0, 2, 1))
    return matrix[:size, :size]


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
