"""The sensor's body as a solid of splines, for the mechanics.

A square grid of columns is mapped to the skin (``shapes``). Each column passes through the skin and the gel to the lens. Shape
and displacement are splines in u, v and depth (isogeometric analysis: Hughes, Cottrell & Bazilevs 2005): quadratic and C1 over the dome,
linear through the skin, and quadratic through the gel. A skin that is bent by a contact is smooth, so splines need fewer unknowns than
trilinear elements. The displacement inside the gel is even smoother. Therefore the gel's grid below its surface has half as many lines as
the skin's grid, and is nested in it.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse import csr_array

from scenes.sensor import GeometrySpec
from twin.compiled import compiled
from twin.geometry.pins import PinRest, rest_pins
from twin.geometry.shapes import Chart, Focus, RectangleChart, shape_of
from twin.types import BoolArray, ComplexArray, FloatArray, IntArray

_legendre = cache(np.polynomial.legendre.leggauss)
_GEL_GRADING = 1.5
"""Exponent of the gel's grading: boundary k of n elements through the gel is at the relative depth (k / n)^1.5, so elements below the skin
are thin."""
_MOST_POLAR_ITERATIONS = 50
"""Largest number of iterations of a polar decomposition; five are usual."""
_POLAR_CHANGE = 1e-9
"""Convergence threshold of the polar decomposition: the iteration ends after a smaller change. The convergence is quadratic, so the next
change would be about its square."""


@dataclass(frozen=True)
class Basis:
    """B-splines of a degree between ``breaks`` (elements + 1,).

    A quadratic basis of m elements has m + 2 functions and is C1; a linear basis has m + 1 functions and is C0. At both ends a spline
    equals its first and last coefficient (open knot vector; Piegl & Tiller, "The NURBS Book", ch. 2).
    """

    breaks: FloatArray
    degree: int = 2

    @property
    def elements(self) -> int:
        """Number of intervals."""
        return len(self.breaks) - 1

    @property
    def count(self) -> int:
        """Number of functions."""
        return self.elements + self.degree

    @property
    def _knots(self) -> FloatArray:
        return np.concatenate([[self.breaks[0]] * self.degree, self.breaks, [self.breaks[-1]] * self.degree])

    @property
    def greville(self) -> FloatArray:
        """Greville points (count,): means of ``degree`` neighbouring knots. The coefficients of a linear function are its values there."""
        knots = self._knots
        return np.array([knots[i + 1 : i + 1 + self.degree].mean() for i in range(self.count)])

    def values(self, at: FloatArray, *, derivative: int = 0) -> FloatArray:
        """Values (k, count) of all functions, or of one of their derivatives, at points (k,)."""
        splines = BSpline.construct_fast(self._knots, np.eye(self.count), self.degree)
        return (splines.derivative(derivative) if derivative else splines)(np.clip(at, self.breaks[0], self.breaks[-1]))

    def element_of(self, at: FloatArray) -> IntArray:
        """Index (k,) of the element that contains each point."""
        return np.clip(np.searchsorted(self.breaks, at, side="right") - 1, 0, self.elements - 1)

    def gauss(self, points: int) -> tuple[FloatArray, FloatArray]:
        """Gauss points and weights (elements, points) of every element."""
        local, weights = _legendre(points)
        half = np.diff(self.breaks)[:, None] / 2
        return (self.breaks[1:] + self.breaks[:-1])[:, None] / 2 + half * local, half * weights


@dataclass(frozen=True)
class Resolution:
    """Number of elements of a solid.

    Attributes
    ----------
    across : int
        Elements along each side of the square grid over the dome (even, at least 4).
    skin_layers, gel_layers : int
        Elements through the skin and from the skin to the lens.
    """

    across: int = 18
    skin_layers: int = 1
    gel_layers: int = 2

    def __post_init__(self) -> None:
        if self.across < 4 or self.across % 2 or self.skin_layers < 1 or self.gel_layers < 1:
            raise ValueError(f"a solid needs an even across >= 4, skin_layers >= 1 and gel_layers >= 1, got {self}")


class Cells(NamedTuple):
    """Elements of one kind.

    Attributes
    ----------
    controls : (m, b) int
        Indices of the b controls of each element, in the order depth, row, column (the column varies fastest).
    gradients : (m, 8, 3, b) float
        Gradients of the shape functions at rest at 2x2x2 Gauss points, 1/mm. The first four points are the outer ones.
    weights_mm3 : (m, 8) float
        Rest volume of each Gauss point.
    """

    controls: IntArray
    gradients: FloatArray
    weights_mm3: FloatArray


@dataclass(frozen=True)
class Solid:
    """Skin and gel at rest, in the sensor frame.

    The coefficients of the splines, the "controls", define the body. The first ``skin_layers + 1`` layers of ``side^2`` controls go from
    the outside to the inside of the skin, row by row. The layers of the gel with ``coarse_side^2`` controls each follow.

    Attributes
    ----------
    control_mm : (n, 3) float
    fixed : (n,) bool
        Clamped controls: at the rim, the wall and the lens.
    skin, gel_top, gel_deep : Cells
        The skin's elements, layer by layer from the outside; the gel's first layer of elements, with the skin's grid on its outer side and
        the coarse grid on its inner side; and the other elements of the gel.
    boxes : tuple of (m, 4) int
        For each kind of cells: first and last row, first and last column (last: exclusive) on the skin's grid.
    chart : Chart or RectangleChart
    basis, coarse, through : Basis
        Splines along the square's sides in the skin and in the gel, and through the gel (depth 1 at the skin, 2 at the lens).
    inner : slice
        Controls of the skin's inside.
    pin_rows : (3, N, side^2) float
        Matrices that map the controls of the skin's inside to the positions and to the derivatives, by u and by v, of the skin's inside at
        the pins' feet.
    pins : PinRest
        The pins at rest.
    pin_cap_length_mm : float
        Distance from a pin's foot to the centre of its cap.
    """

    control_mm: FloatArray
    fixed: BoolArray
    skin: Cells
    gel_top: Cells
    gel_deep: Cells
    boxes: tuple[IntArray, IntArray, IntArray]
    chart: Chart | RectangleChart
    basis: Basis
    coarse: Basis
    through: Basis
    inner: slice
    pin_rows: FloatArray
    pins: PinRest
    pin_cap_length_mm: float

    @cached_property
    def pin_operator(self) -> csr_array:
        """``pin_rows``, stacked vertically: (3 N, side^2). Each row has nine non-zero entries."""
        return csr_array(np.concatenate(self.pin_rows))

    @cached_property
    def pin_rest(self) -> tuple[FloatArray, FloatArray]:
        """Foot (N, 3) of each pin at rest, and inverse (N, 3, 3) of the frame of the skin's inside there."""
        foot, frame = _surface(self, self.control_mm)
        return foot, np.linalg.inv(frame)


def build_solid(geometry: GeometrySpec, *, resolution: Resolution | None = None, focus: Focus | None = None) -> Solid:
    """Build the body of a sensor. Its grid is fine around a focus (default: around the apex)."""
    resolution, focus = resolution or Resolution(), focus or Focus()
    shape = shape_of(geometry.skin)
    basis = Basis(np.linspace(-1, 1, resolution.across + 1))
    chart = shape.chart(focus)
    coarse = Basis(basis.breaks[::2])
    through = Basis(1 + np.linspace(0, 1, resolution.gel_layers + 1) ** _GEL_GRADING)
    layers, side, coarse_side = resolution.skin_layers, basis.count, coarse.count
    through_skin = Basis(np.linspace(0, 1, layers + 1), degree=1)

    fine = [_fit(basis, chart, geometry, depth) for depth in through_skin.greville]
    deep = [_fit(coarse, chart, geometry, depth) for depth in through.greville[1:]]
    control = np.ascontiguousarray(np.concatenate(fine + deep))
    index = np.arange(len(fine) * side * side).reshape(-1, side, side)
    below = (len(fine) * side * side + np.arange(len(deep) * coarse_side**2)).reshape(-1, coarse_side, coarse_side)
    fixed_fine, fixed_coarse = np.zeros(index.shape, bool), np.zeros(below.shape, bool)
    for clamped in (fixed_fine, fixed_coarse):
        clamped[:, [0, -1], :] = clamped[:, :, [0, -1]] = True
    fixed_coarse[-1] = True

    skin_parts = [[(index[e + d], basis) for d in (0, 1)] for e in range(layers)]
    top = [(index[-1], basis), (below[0], coarse), (below[1], coarse)]
    deep_parts = [[(below[e + d - 1], coarse) for d in range(3)] for e in range(1, resolution.gel_layers)]
    pins = rest_pins(geometry)
    return Solid(
        control_mm=control,
        fixed=np.concatenate([fixed_fine.ravel(), fixed_coarse.ravel()]),
        skin=joined_cells([spline_cells(basis, parts, through_skin, e, control) for e, parts in enumerate(skin_parts)]),
        gel_top=spline_cells(basis, top, through, 0, control),
        gel_deep=joined_cells([spline_cells(coarse, parts, through, e + 1, control) for e, parts in enumerate(deep_parts)]),
        boxes=(
            np.tile(_boxes(resolution.across, 1), (layers, 1)),
            _boxes(resolution.across, 1),
            np.tile(_boxes(resolution.across // 2, 2), (resolution.gel_layers - 1, 1)),
        ),
        chart=chart,
        basis=basis,
        coarse=coarse,
        through=through,
        pin_rows=np.stack(surface_operators(basis, chart.square(shape.place(pins.base_mm)))),
        pins=pins,
        inner=slice(layers * side**2, (layers + 1) * side**2),
        pin_cap_length_mm=geometry.pins.length_mm + geometry.pins.cap_height_mm / 2,
    )


def surface_operators(basis: Basis, square: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matrices (k, side^2) that map a layer's controls to its value, d/du and d/dv at points (k, 2) of the square."""
    u, v = square.T
    u0, u1, v0, v1 = basis.values(u), basis.values(u, derivative=1), basis.values(v), basis.values(v, derivative=1)

    def rows(along_v: FloatArray, along_u: FloatArray) -> FloatArray:
        return (along_v[:, :, None] * along_u[:, None, :]).reshape(len(square), -1)

    return rows(v0, u0), rows(v0, u1), rows(v1, u0)


def pin_pose(solid: Solid, control_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Feet, axes and cap centres of the pins on a deformed skin.

    With the tangents and the unit normal of the skin's inside at a foot, deformed (t_u, t_v, n) and at rest (T_u, T_v, N), the
    deformation gradient is F = [t_u t_v n] [T_u T_v N]^-1. The pin rotates by the rotation of F's polar decomposition, which maps N to n.
    At rest the result equals ``rest_pins``, and a rigid motion of the body moves the pins rigidly.

    Parameters
    ----------
    control_mm : (n, 3) float
        Deformed controls.

    Returns
    -------
    base_mm, axis, caps_mm : (N, 3) float
    """
    rest_foot, rest_inverse = solid.pin_rest
    foot, frame = _surface(solid, control_mm)
    turn = rotations(frame @ rest_inverse)
    base = foot + np.einsum("kij,kj->ki", turn, solid.pins.base_mm - rest_foot)
    axis = np.einsum("kij,kj->ki", turn, solid.pins.axis)
    return base, axis, base + solid.pin_cap_length_mm * axis


def body_points(geometry: GeometrySpec, disc: ComplexArray, depth: float) -> FloatArray:
    """Points (k, 3) of the body at rest. Depth 0 is the skin's outside, 1 its inside and 2 the lens, with straight lines between them."""
    return shape_of(geometry.skin).body(disc, depth, geometry.lens.z_mm)


def _fit(basis: Basis, chart: Chart | RectangleChart, geometry: GeometrySpec, depth: float) -> FloatArray:
    """Controls (side^2, 3) of the spline surface that interpolates the body at one depth."""
    v, u = np.meshgrid(basis.greville, basis.greville, indexing="ij")
    places = body_points(geometry, chart.disc(np.column_stack([u.ravel(), v.ravel()])), depth)
    inverse = np.linalg.inv(basis.values(basis.greville))
    return np.einsum("ri,cj,ijx->rcx", inverse, inverse, places.reshape(basis.count, basis.count, 3), optimize=True).reshape(-1, 3)


def spline_cells(grid: Basis, parts: list[tuple[IntArray, Basis]], through: Basis, layer: int, control_mm: FloatArray) -> Cells:
    """Elements of one layer over the intervals of ``grid``.

    ``parts`` contains, for each function through the depth that is not zero in the layer, its controls (side, side) and their basis.
    """
    at, weights = grid.gauss(2)
    depth, depth_weights = (each[layer] for each in through.gauss(2))
    shape_parts, control_parts = [], []
    for function, (index, basis) in enumerate(parts, layer):
        value, slope = (through.values(depth, derivative=d)[:, function] for d in (0, 1))
        first = basis.element_of((grid.breaks[1:] + grid.breaks[:-1]) / 2)
        window = first[:, None] + np.arange(3)
        f0, f1 = (
            np.take_along_axis(basis.values(at.ravel(), derivative=d).reshape(*at.shape, -1), window[:, None, :], axis=2) for d in (0, 1)
        )
        # derivatives by (row, column, depth), a right-handed order because depth increases inwards
        factors = ((value, f1, f0), (value, f0, f1), (slope, f0, f0))
        shape_parts.append(np.stack([np.einsum("p,rqj,csk->rcpqsjk", *f).reshape(-1, 8, 9) for f in factors], axis=2))
        control_parts.append(index[window[:, None, :, None], window[None, :, None, :]].reshape(-1, 9))
    shapes, controls = np.concatenate(shape_parts, axis=3), np.concatenate(control_parts, axis=1)
    jacobian = np.einsum("mqja,mai->mqji", shapes, control_mm[controls], optimize=True).swapaxes(2, 3)
    volume = np.linalg.det(jacobian) * np.einsum("d,rq,cs->rcdqs", depth_weights, weights, weights).reshape(-1, 8)
    if volume.min() <= 0:
        raise ValueError(f"{np.count_nonzero(volume.min(axis=1) <= 0)} elements are inside out at rest; check the sensor's geometry")
    gradients = np.matmul(np.linalg.inv(jacobian).swapaxes(2, 3), shapes)
    return Cells(controls, np.ascontiguousarray(gradients), volume)


def joined_cells(parts: list[Cells]) -> Cells:
    """The elements of several layers in one ``Cells``. Without layers it is empty, with the array shapes of the gel (27 controls)."""
    if not parts:
        return Cells(np.zeros((0, 27), int), np.zeros((0, 8, 3, 27)), np.zeros((0, 8)))
    return Cells(*map(np.concatenate, zip(*parts, strict=True)))


def _boxes(count: int, size: int) -> IntArray:
    """Ranges (count^2, 4) of rows and columns of elements that each cover ``size`` x ``size`` elements of the skin's grid."""
    rows, columns = (g.ravel() * size for g in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    return np.column_stack([rows, rows + size, columns, columns + size])


def _surface(solid: Solid, control_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Foot (N, 3) of each pin, and frame [t_u t_v n] (N, 3, 3) of the inner surface there."""
    place, along_u, along_v = (solid.pin_operator @ control_mm[solid.inner]).reshape(3, -1, 3)
    normal = np.cross(along_u, along_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return place, np.stack([along_u, along_v, normal], axis=2)


def rotations(matrices: FloatArray) -> FloatArray:
    """The rotations (k, 3, 3) of the polar decompositions of matrices (k, 3, 3) of positive determinant.

    They are computed by Newton's iteration R -> (R + R^-T) / 2 (Higham 1986), which converges quadratically.
    """
    _orthogonalise(out := np.array(matrices, order="C"), np.empty((3, 3)))
    return out


@compiled()
def _orthogonalise(r: FloatArray, cofactor: FloatArray) -> None:
    for k in range(len(r)):
        for _ in range(_MOST_POLAR_ITERATIONS):
            for i in range(3):
                j, m = (i + 1) % 3, (i + 2) % 3
                for a in range(3):
                    b, c = (a + 1) % 3, (a + 2) % 3
                    cofactor[i, a] = r[k, j, b] * r[k, m, c] - r[k, j, c] * r[k, m, b]
            det = r[k, 0, 0] * cofactor[0, 0] + r[k, 0, 1] * cofactor[0, 1] + r[k, 0, 2] * cofactor[0, 2]
            change = 0.0
            for i in range(3):
                for a in range(3):
                    new = (r[k, i, a] + cofactor[i, a] / det) / 2
                    change = max(change, abs(new - r[k, i, a]))
                    r[k, i, a] = new
            if change < _POLAR_CHANGE:
                break
