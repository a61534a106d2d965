"""Skin and gel as one dense system: forces and a factor of the stiffness about any shape."""

import numpy as np
from scipy.linalg import LinAlgError, cho_factor

from scenes.sensor import GelSpec, GeometrySpec
from twin.geometry.solid import build_solid
from twin.mechanics.elements import PAIRS, Elements
from twin.mechanics.material import law_coefficients
from twin.types import FloatArray, IntArray

NO_STRESS = np.zeros((0, 8, 3, 3))
"""Given stress of an elastic body: none (see ``Elements.add_forces``)."""
SHIFT_SHARE = 1e-3
"""A tangent that is not positive definite gets this share of its mean diagonal added, and four times more each time that is too little."""


class SoftBody:
    """The elastic body of one sensor.

    Attributes
    ----------
    solid : Solid
    free : (f,) int
        Controls that are not clamped.
    unknown : (n, 3) int
        Number of each control's unknowns, control by control; -1 where clamped.
    """

    def __init__(self, geometry: GeometrySpec, gel: GelSpec) -> None:
        solid = self.solid = build_solid(geometry)
        soft = law_coefficients(gel, layer=False)
        skin = Elements(solid.skin, law_coefficients(geometry.skin, layer=True), layer=True)
        self._kinds = skin, Elements(solid.gel_top, soft), Elements(solid.gel_deep, soft)
        self.free = np.flatnonzero(~solid.fixed)
        self.unknown = np.full((len(solid.fixed), 3), -1)
        self.unknown[self.free] = np.arange(3 * len(self.free)).reshape(-1, 3)
        self._entries = [_entries(self.unknown, kind.cells.controls) for kind in self._kinds]

    def forces(self, control_mm: FloatArray) -> FloatArray:
        """Gradient of the elastic energy (3 f,) in N, by the free controls."""
        force = np.zeros_like(control_mm)
        for kind in self._kinds:
            kind.add_forces(control_mm, NO_STRESS, force)
        return force[self.free].ravel()

    def factor(self, control_mm: FloatArray) -> tuple[FloatArray, bool]:
        """Cholesky factor (single precision, as ``scipy.linalg.cho_solve`` takes it) of the tangent, made positive where it is not."""
        size = 3 * len(self.free)
        total = np.zeros(size * size)
        for kind, (where, from_block) in zip(self._kinds, self._entries, strict=True):
            controls = kind.cells.controls
            block = np.zeros((len(controls), 6, controls.shape[1], controls.shape[1]))
            kind.stiffness(control_mm, NO_STRESS, 0.0, block)
            total += np.bincount(where, block.ravel()[from_block], size * size)
        matrix, shift = total.reshape(size, size).astype(np.float32), 0.0
        while True:
            try:
                return cho_factor(matrix, lower=True)
            except LinAlgError:
                shift = 4 * shift or SHIFT_SHARE * float(np.mean(np.diag(matrix)))
                matrix[np.diag_indices(size)] += shift

    def moved(self, control_mm: FloatArray, move_mm: FloatArray) -> FloatArray:
        """The shape (n, 3) after a move (f, 3) of the free controls, shortened until no element is inside out."""
        while True:
            moved = control_mm.copy()
            moved[self.free] += move_mm
            if np.isfinite(sum(kind.add_forces(moved, NO_STRESS, np.zeros_like(moved)) for kind in self._kinds)):
                return moved
            move_mm = move_mm / 2


def _entries(unknown: IntArray, controls: IntArray) -> tuple[IntArray, IntArray]:
    """Where each entry of the elements' stiffness blocks goes: flat places in the lower triangle, and flat places in the blocks."""
    m, b = controls.shape
    size = unknown.max() + 1
    where = np.empty((m, 6, b, b), np.int64)
    for p, (i, k) in enumerate(PAIRS):
        row, column = np.broadcast_arrays(unknown[controls, i][:, :, None], unknown[controls, k][:, None, :])
        low = np.maximum(row, column) * size + np.minimum(row, column)
        where[:, p] = np.where((row < 0) | (column < 0) | ((i == k) & (row < column)), -1, low)
    used = np.flatnonzero(where.ravel() >= 0)
    return where.ravel()[used], used
