"""Linear compliance of the skin: displacements of its outside and its pins for small forces, from the solver's own elements at rest."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from scenes.sensor import SensorSpec
from training.surrogate.symmetry import ring_directions
from twin.geometry.shapes import shape_of
from twin.geometry.solid import Resolution, Solid, build_solid, pin_pose, surface_operators
from twin.mechanics.body.elements import PAIRS, soft_body
from twin.types import FloatArray

NODE_RINGS = 9
"""Number of rings of nodes around the apex: 271 nodes, 2.2 mm apart on a dome of 20 mm. With 12 rings the linear skin is no better."""
POLAR_DEG = 58.0
"""Angle of the outermost ring from the apex. All contacts of the domain lie inside it."""
PROBE_MM = 1e-4
"""Step, in displacement of the controls, of the finite difference that gives the pins' motion."""


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
        kind.stiffness(solid.control_mm, np.zeros((len(controls), 8, 3, 3)), 0.0, blocks)
        at = first[controls]
        for p, (i, k) in enumerate(PAIRS):
            np.add.at(matrix, (at[:, :, None] + i, at[:, None, :] + k), blocks[:, p])
            if i != k:
                np.add.at(matrix, (at[:, :, None] + k, at[:, None, :] + i), blocks[:, p].transpose(0, 2, 1))
    return matrix[:size, :size]
