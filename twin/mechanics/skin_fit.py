"""Positions of the pins in space from one frame, without knowledge of the object that touches the sensor.

A frame gives the pixel of each cap, and with it the cap's ray in the gel, but not its depth along the ray. The sensor's body
gives the depth: skin and gel are in equilibrium under some traction t on the outer skin. With x(t) the body's shape,
Gauss-Newton minimises

    sum_pins |project(cap(x)) - seen|^2 / sigma^2  +  integral over the skin at rest of t_n^2 / s_n^2 + |t_t|^2 / s_t^2

over t and x together, with the equilibrium linearised about the present shape in each step. The scale s_n^2 grows with the pressure of the
previous step, and s_t^2 with a fraction of this pressure (iteratively reweighted least squares: Daubechies et al. 2010). These scales
express three properties of a contact: it presses and does not pull, it is confined to a part of the skin, and friction needs pressure.
A discrepancy of a fraction of a pixel remains in the image. Each pin is finally shifted parallel to the image to remove it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from threadpoolctl import ThreadpoolController

from scenes.sensor import SensorSpec, ViewSpec
from twin.camera.projection import pixel_rays, project
from twin.geometry.pins import PinRest
from twin.geometry.solid import build_solid, pin_pose, surface_operators
from twin.mechanics.body.elements import PAIRS, soft_body
from twin.types import BoolArray, FloatArray, IntArray

SHIFT_SHARE = 1e-3
"""First shift of the diagonal of a tangent that is not positive definite, relative to the mean of the diagonal. If the shift is too small,
the next one is four times as large."""
STEPS = 14
"""Largest number of Gauss-Newton steps."""
SETTLED_MM = 0.01
"""Convergence threshold: the fit ends after a step in which no coordinate of a control changes by more than this."""
LARGEST_MOVE_MM = 2.0
"""Largest change of a control's coordinate in one step. The linearised equilibrium is not accurate for larger moves."""
EVEN_STEPS = 2
"""Number of first steps with the same scale s on the whole skin, because there is no estimate of the pressure yet."""
OUTLINE_CORNERS = 48
"""Number of corners of the polygon that represents a cap's outline."""
PROBE_MM = 1e-4
"""Step of the difference quotient for the derivative of the projection."""

SIGMA_PX = 0.1
"""Standard deviation of a pin's error in the image: the detection's error, and errors of the specification's pin layout and camera."""
TRACTION_MPA = 0.02
"""Usual traction. On 1 mm^2 of skin it has the same cost as an error of ``SIGMA_PX`` of one coordinate of a pin."""
FLOOR_MPA = 0.001
"""Pressure that is added to the pressure of the previous step, so that the scales s are never 0."""
FRICTION = 0.5
"""Expected tangential traction relative to the pressure."""


@dataclass(frozen=True)
class FittedPins(PinRest):
    """Pins of a fitted skin, in the sensor frame and in the specification's order. The renderer accepts them as a state.

    Attributes
    ----------
    base_mm, axis, caps_mm : (N, 3) float
        As ``PinRest``.
    remainder_px : (N,) float
        Distance in the image between each pin and its position on the smooth skin; NaN for lost pins.
    force_n : (3,) float
        Total force on the skin: the integral of the estimated traction.
    """

    remainder_px: FloatArray
    force_n: FloatArray


def centroid_offset_px(view: ViewSpec, cap_diameter_mm: float, caps_mm: FloatArray, axis: FloatArray) -> FloatArray:
    """Offset (N, 2) px from the projected centre of each cap's disc to the centroid of its projected outline (polygon area formula)."""
    turn = np.linspace(0, 2 * np.pi, OUTLINE_CORNERS + 1)[:, None, None]
    u = np.cross(axis, np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    rim = caps_mm + 0.5 * cap_diameter_mm * (np.cos(turn) * u + np.sin(turn) * np.cross(axis, u))
    p = project(view, rim) - project(view, caps_mm)
    twice = p[:-1, :, 0] * p[1:, :, 1] - p[1:, :, 0] * p[:-1, :, 1]
    return ((p[:-1] + p[1:]) * twice[..., None]).sum(axis=0) / (3 * twice.sum(axis=0))[:, None]


class SkinFit:
    """Fit of one sensor's skin to the pins of frames. Everything that depends on the sensor alone is computed once, in the constructor.

    Skin and gel are one dense system, with a factor of the stiffness at any shape.
    """

    def __init__(self, spec: SensorSpec) -> None:
        self.spec, self._view, self._blas = spec, spec.view, ThreadpoolController()
        solid = self._solid = build_solid(spec.geometry)
        self._kinds = soft_body(solid, spec.skin, spec.gel)
        self._free = np.flatnonzero(~solid.fixed)
        unknown = np.full((len(solid.fixed), 3), 3 * len(self._free))  # indices of each control's three unknowns; clamped: behind them
        unknown[self._free] = np.arange(3 * len(self._free)).reshape(-1, 3)
        self._entries = [_entries(unknown, kind.cells.controls) for kind in self._kinds]
        at, weights = (a.ravel() for a in solid.basis.gauss(2))
        v, u = (g.ravel() for g in np.meshgrid(at, at, indexing="ij"))
        value, *slopes = surface_operators(solid.basis, np.column_stack([u, v]))
        self._outer = slice(solid.basis.count**2)
        moving = ~solid.fixed[self._outer]
        self._value, self._slopes = sparse.csr_array(value[:, moving]), [sparse.csr_array(s) for s in slopes]
        across = np.cross(*(s @ solid.control_mm[self._outer] for s in self._slopes))
        self._area_mm2 = np.linalg.norm(across, axis=1) * np.outer(weights, weights).ravel()
        self._mass = (self._value.T @ (self._area_mm2[:, None] * self._value)).toarray()  # traction coefficients to forces
        self._loaded = unknown[self._outer][moving]  # (m, 3) unknowns that carry the traction

    def __call__(self, pins_px: FloatArray, *, centroids: bool = True) -> FittedPins:
        """Fit one frame.

        Parameters
        ----------
        pins_px : (N, 2) float
            Raw-frame px, specification's order; NaN for lost pins, whose positions follow from the skin.
        centroids : bool
            Whether ``pins_px`` are centroids of the caps' outlines in the image; otherwise they are projections of the caps' centres.

        Raises
        ------
        ValueError
            If the number of pins is not N, or if fewer than half of them are visible.
        """
        pins_px = np.asarray(pins_px, float)
        count = self.spec.pins.count
        if pins_px.shape != (count, 2):
            raise ValueError(f"expected pins_px of shape ({count}, 2) for {self.spec.name}, got {pins_px.shape}")
        seen: BoolArray = np.all(np.isfinite(pins_px), axis=1)
        if 2 * seen.sum() < count:
            raise ValueError(f"{seen.sum()} of {count} pins are too few to fit a skin to; at least half are needed")
        control, traction = self._solid.control_mm.copy(), np.zeros(self._area_mm2.shape + (3,))
        with self._blas.limit(limits=1, user_api="blas"):  # many threads are slower on matrices this small
            for step in range(STEPS):
                target_px = pins_px - self._offset_px(control) * centroids
                move, traction = self._step(control, target_px, seen, traction, even=step < EVEN_STEPS)
                largest = np.abs(move).max()
                control = self._move_controls(control, move * min(1.0, LARGEST_MOVE_MM / largest))
                if step >= EVEN_STEPS and largest < SETTLED_MM:
                    break
            pins = self._on_rays(control, pins_px - self._offset_px(control) * centroids, seen)
        return replace(pins, force_n=self._area_mm2 @ traction)

    def _offset_px(self, control: FloatArray) -> FloatArray:
        """Offsets (N, 2) px of the caps' centroids from the projections of their centres, for the shape ``control``."""
        _, axis, cap = pin_pose(self._solid, control)
        return centroid_offset_px(self._view, self.spec.pins.cap_diameter_mm, cap, axis)

    def _on_rays(self, control: FloatArray, target_px: FloatArray, seen: BoolArray) -> FittedPins:
        """Pins of the shape ``control``; the visible ones are shifted parallel to the image onto their rays."""
        base, axis, cap = pin_pose(self._solid, control)
        remainder = np.where(seen, np.linalg.norm(project(self._view, cap) - target_px, axis=1), np.nan)
        place, along = pixel_rays(self._view, np.where(seen[:, None], target_px, 0.0))
        on_ray = place + along * ((cap[:, 2] - place[:, 2]) / along[:, 2])[:, None]
        shift = np.where(seen[:, None], on_ray - cap, 0.0)
        return FittedPins(base + shift, axis, cap + shift, remainder, np.zeros(3))

    def _step(
        self, control: FloatArray, target_px: FloatArray, seen: BoolArray, traction: FloatArray, *, even: bool
    ) -> tuple[FloatArray, FloatArray]:
        """One Gauss-Newton step: the move (f, 3) of the free controls, and the traction (q, 3) in MPa at the skin's points."""
        factor, force = self._factor(control), np.zeros_like(control)
        for kind in self._kinds:
            kind.add_forces(control, force)
        force = force[self._free].ravel()
        seen_px, per_control = self._pin_rows(control, seen)
        reach = cho_solve(factor, per_control.T)  # (unknowns, 2 pins): displacement of the pins in the image per unit force
        rows = np.einsum("ab,bip->pai", self._mass, reach[self._loaded], optimize=True).reshape(len(per_control), -1)
        wanted = (target_px[seen] - seen_px).ravel() + reach.T @ force
        sigma2 = SIGMA_PX**2
        normal = rows.T @ rows / sigma2 + self._cost(control, traction, even=even)
        coefficients = cho_solve(cho_factor(normal), rows.T @ wanted / sigma2).reshape(-1, 3)
        load = -force
        load[self._loaded] += self._mass @ coefficients
        return cho_solve(factor, load).reshape(-1, 3), self._value @ coefficients

    def _cost(self, control: FloatArray, traction: FloatArray, *, even: bool) -> FloatArray:
        """Quadratic form (3 m, 3 m) of the prior of the traction's coefficients, with scales from the previous step's traction (q, 3)."""
        outward = np.cross(*(s @ control[self._outer] for s in self._slopes))
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        pressure = np.full(len(outward), TRACTION_MPA) if even else np.maximum(-(traction * outward).sum(axis=1), 0)
        across = self._area_mm2 / (TRACTION_MPA * (FRICTION * pressure + FLOOR_MPA))
        along = self._area_mm2 / (TRACTION_MPA * (pressure + FLOOR_MPA)) - across
        count = len(self._loaded)
        form = np.zeros((count, 3, count, 3))
        for i, j in PAIRS:
            weight = along * outward[:, i] * outward[:, j] + across * (i == j)
            form[:, i, :, j] = form[:, j, :, i] = (self._value.T @ (weight[:, None] * self._value)).toarray()
        return form.reshape(3 * count, 3 * count)

    def _pin_rows(self, control: FloatArray, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Projections (s, 2) of the visible caps, and their derivative (2 s, unknowns) with respect to the free controls."""
        solid, inner = self._solid, control[self._solid.inner]
        _, axis, cap = pin_pose(solid, control)
        value, *slopes = solid.pin_rows
        t = np.stack([s @ inner for s in slopes], axis=1)
        dual = np.linalg.inv(t @ t.swapaxes(1, 2)) @ t
        here = project(self._view, cap)
        per_mm = np.stack([(project(self._view, cap + PROBE_MM * unit) - here) / PROBE_MM for unit in np.eye(3)], axis=2)
        rows = np.zeros((seen.sum(), 2, len(control), 3))
        part = value[seen, None, :, None] * per_mm[seen, :, None, :]
        for slope, toward in zip(slopes, dual.swapaxes(0, 1), strict=True):  # the axis rotates with the normal: d a = -t^c (a . d t_c)
            lever = -solid.pin_cap_length_mm * np.einsum("pki,pi->pk", per_mm, toward)
            part += slope[seen, None, :, None] * (lever[..., None] * axis[:, None])[seen, :, None, :]
        rows[:, :, solid.inner] = part
        return here[seen], rows[:, :, self._free].reshape(2 * seen.sum(), -1)

    def _factor(self, control_mm: FloatArray) -> tuple[FloatArray, bool]:
        """Cholesky factor of the tangent in single precision, for ``scipy.linalg.cho_solve``.

        If the tangent is not positive definite, its diagonal is shifted until it is.
        """
        size = 3 * len(self._free) + 1
        total = np.zeros(size * size)
        for kind, where in zip(self._kinds, self._entries, strict=True):
            controls = kind.cells.controls
            block = np.zeros((len(controls), 6, controls.shape[1], controls.shape[1]), np.float32)
            kind.stiffness(control_mm, 0.0, block)
            total += np.bincount(where, block.ravel(), size * size)
        matrix, shift = total.reshape(size, size)[:-1, :-1].astype(np.float32), 0.0
        while True:
            try:
                return cho_factor(matrix, lower=True)
            except LinAlgError:
                shift = 4 * shift or SHIFT_SHARE * float(np.mean(np.diag(matrix)))
                matrix[np.diag_indices(size - 1)] += shift

    def _move_controls(self, control_mm: FloatArray, move_mm: FloatArray) -> FloatArray:
        """The shape (n, 3) after a move (f, 3) of the free controls. The move is halved until no element is inside out."""
        while True:
            moved = control_mm.copy()
            moved[self._free] += move_mm
            if np.isfinite(sum(kind.add_forces(moved, np.zeros_like(moved)) for kind in self._kinds)):
                return moved
            move_mm = move_mm / 2


def _entries(unknown: IntArray, controls: IntArray) -> IntArray:
    """Flat indices of the entries of the stiffness blocks in the lower triangle of the matrix, whose last row takes the others."""
    m, b = controls.shape
    size = unknown.max() + 1
    where = np.empty((m, 6, b, b), np.int64)
    for p, (i, k) in enumerate(PAIRS):
        row, column = np.broadcast_arrays(unknown[controls, i][:, :, None], unknown[controls, k][:, None, :])
        low = np.maximum(row, column) * size + np.minimum(row, column)
        where[:, p] = np.where((i == k) & (row < column), size * size - 1, low)
    return where.ravel()
