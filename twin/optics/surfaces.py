"""Fine triangle surfaces for rendering: skin, stems, caps.

The topology depends on the specification alone, so only vertex positions differ between states. All positions are in the sensor frame,
mm.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator

from scenes.body import SkinSpec
from scenes.sensor import AppearanceSpec, PinsSpec
from twin.geometry.pins import around_axis
from twin.geometry.shapes import shape_of
from twin.types import FloatArray, IntArray

SKIN_CIRCLES = 40
"""Number of circles of the skin's grid between apex and rim (squares on a rectangular pad)."""
SKIN_PLACES = 80
"""Number of vertices on each circle. It is a multiple of 8, so that a rectangle's corners are among them."""
RIM_APART_RAD = 0.02
"""Smallest distance of a fixed point of the rim from a control point. Nearer points are omitted, because a spline needs distinct points."""
STEM_SIDES = 8
"""Number of sides of a stem."""
CAP_SIDES = 16
"""Number of sides of a cap."""
CAP_BEVEL = 0.25
"""Bevel of a cap's edge, relative to the cap's height. Printed edges are not sharp."""
STEM_ROOT_MM = 0.3
"""Depth inside the skin at which stems start, so that there is no gap where the skin bends."""
MOST_CONTROL_POINTS = 1200
"""Largest number of control points. The interpolation solves a dense linear system of this size once."""


@dataclass(frozen=True)
class PaintedSurface:
    """Triangles ``faces (m, 3)`` over ``vertices_mm (n, 3)``; ``paint (n, 3)``: reflectance of each vertex."""

    vertices_mm: FloatArray
    faces: IntArray
    paint: FloatArray | None = None


class SkinSurface:
    """The skin's inside as a fine grid, whose displacement is interpolated smoothly between control points.

    The displacement of the fine grid is the thin-plate spline (Duchon 1977) through the control points' displacements over the
    places of the skin (`twin.geometry.shapes`). Because the control points' places at rest are fixed, it is one constant matrix.

    Parameters
    ----------
    skin : SkinSpec
    control_mm : (n, 3) float
        Control points at rest on the inside of the skin.
    """

    def __init__(self, skin: SkinSpec, control_mm: FloatArray) -> None:
        shape = shape_of(skin)
        shares = np.linspace(0, 1, SKIN_CIRCLES + 1)[1:]
        places = np.concatenate([[0j], (shares[:, None] * shape.rim(SKIN_PLACES)).ravel()])
        self.rest_mm = shape.inside(places)
        self.faces = _fan_grid(SKIN_CIRCLES, SKIN_PLACES)
        # The rim is clamped: fixed points on it keep the spline at rest there, because the rim has no control points.
        self._keep = np.unique(np.linspace(0, len(control_mm) - 1, min(len(control_mm), MOST_CONTROL_POINTS)).astype(int))
        chart, grid = (shape.largest_rad * place for place in (shape.place(control_mm[self._keep]), places))
        chart, grid = (np.column_stack([place.real, place.imag]) for place in (chart, grid))
        rim_chart = grid[-SKIN_PLACES::4]
        apart = np.min(np.linalg.norm(rim_chart[:, None] - chart[None], axis=2), axis=1) > RIM_APART_RAD
        sites = np.concatenate([chart, rim_chart[apart]])
        unit = np.eye(len(sites))[:, : len(chart)]
        self._weights = RBFInterpolator(sites, unit, kernel="thin_plate_spline")(grid).astype(np.float32)
        self.control_mm = control_mm

    def vertices(self, control_mm: FloatArray) -> FloatArray:
        """Fine grid (v, 3) when the control points have moved to ``control_mm`` (n, 3)."""
        moved = (control_mm - self.control_mm)[self._keep]
        return self.rest_mm + self._weights @ moved.astype(np.float32)


def stems(pins: PinsSpec, base_mm: FloatArray, axis: FloatArray) -> PaintedSurface:
    """All pin stems as one surface: cylinders from the skin to the cap."""
    profile = np.array([[0.5 * pins.diameter_mm, -STEM_ROOT_MM], [0.5 * pins.diameter_mm, pins.length_mm]])
    return lathe(profile, base_mm, axis, STEM_SIDES)


def caps(pins: PinsSpec, appearance: AppearanceSpec, caps_mm: FloatArray, axis: FloatArray) -> PaintedSurface:
    """All caps as one surface: bevelled discs, or shapes with measured outlines, about their centres. The invisible underside is open."""
    radius, half = 0.5 * pins.cap_diameter_mm, 0.5 * pins.cap_height_mm
    bevel = min(CAP_BEVEL * pins.cap_height_mm, 0.5 * radius)
    radius *= np.sqrt(2 * np.pi / CAP_SIDES / np.sin(2 * np.pi / CAP_SIDES))  # the polygon has the disc's area
    profile = np.array([[radius, -half], [radius, half - bevel], [radius - bevel, half], [0, half]])
    body = lathe(profile, caps_mm, axis, CAP_SIDES, cap_outlines(appearance, CAP_SIDES))
    paint = np.repeat(cap_albedo(appearance, pins.count), len(body.vertices_mm) // len(caps_mm), axis=0)
    return PaintedSurface(body.vertices_mm, body.faces, paint)


def cap_albedo(look: AppearanceSpec, count: int) -> FloatArray:
    """Reflectance (N, 3) of each cap: the measured one, else one sampled at random."""
    drawn = 1 + look.cap_variation * np.random.default_rng(look.cap_pattern).standard_normal(count)
    each = np.array(look.cap_levels) if look.cap_levels else drawn
    return np.clip(each[:, None] * np.array(look.cap_albedo), 0, 1)


def cap_outlines(look: AppearanceSpec, sides: int) -> FloatArray | None:
    """Radius (N, sides) of each cap's outline relative to its circle's; None if all caps are round."""
    if not look.cap_shapes and not look.cap_offsets:
        return None
    shapes, offsets = np.array(look.cap_shapes or [[0.0]]), np.array(look.cap_offsets or [[0.0, 0.0]])
    turn = np.arange(sides) * 2 * np.pi / sides
    orders = 2 + np.arange(shapes.shape[1] // 2)[:, None]
    beside = offsets @ np.stack([np.cos(turn), np.sin(turn)])
    return 1 + shapes[:, :1] + shapes[:, 1::2] @ np.cos(orders * turn) + shapes[:, 2::2] @ np.sin(orders * turn) + beside


def vertex_normals(vertices_mm: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals (n, 3) at vertices (n, 3): means of the normals of faces (m, 3), weighted by the angles at the vertex.

    They are Mitsuba's (Thuermer and Wuethrich 1998), which it computes in another order of summation in each run.
    """
    corners = vertices_mm[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    across = unit(np.cross(sides[:, 0], sides[:, 1]))
    along = unit(sides)
    angle = np.arccos(np.clip(-np.sum(along * np.roll(along, 1, axis=1), axis=2), -1.0, 1.0))
    total = np.zeros(vertices_mm.shape)
    np.add.at(total, faces, angle[..., None] * across[:, None])
    return unit(total)


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (..., 3) of length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _fan_grid(rings: int, around: int) -> IntArray:
    """Triangles of an apex (vertex 0) and ``rings`` circles of ``around`` vertices; normals towards the inside of a dome."""
    k = np.arange(around)
    fan = np.stack([np.zeros_like(k), 1 + (k + 1) % around, 1 + k], axis=1)
    return np.concatenate([fan, 1 + _ring_grid(rings - 1, around)[:, ::-1]])


def _ring_grid(bands: int, around: int) -> IntArray:
    """Triangles between ``bands + 1`` circles of ``around`` vertices each."""
    j, k = (g.ravel() for g in np.meshgrid(np.arange(bands), np.arange(around), indexing="ij"))
    a, b = j * around + k, j * around + (k + 1) % around
    return np.concatenate([np.stack([a, a + around, b], axis=1), np.stack([b, a + around, b + around], axis=1)])


def lathe(profile: FloatArray, origin_mm: FloatArray, axis: FloatArray, sides: int, outlines: FloatArray | None = None) -> PaintedSurface:
    """Copies of a body of revolution with the profile (k, 2) of (radius, height), at each origin along its axis; normals outwards.

    The azimuth starts at the projection of the sensor's x onto the body's plane and increases towards y. ``outlines`` (N, sides) scale
    the radius.
    """
    circle = around_axis(axis, np.arange(sides) * 2 * np.pi / sides)
    if outlines is not None:
        circle = circle * outlines[:, :, None]
    body = profile[None, :, None, :1] * circle[:, None] + profile[None, :, None, 1:] * axis[:, None, None]
    vertices = origin_mm[:, None, None] + body
    each = len(profile) * sides
    one = _ring_grid(len(profile) - 1, sides)
    corners = profile[one // sides, 0] == 0
    one = one[corners.sum(axis=1) < 2]  # a quad with a radius of 0 at one end is one triangle; v is opposite to u x axis (clockwise)
    faces = (np.arange(len(origin_mm))[:, None, None] * each + one[None]).reshape(-1, 3)
    return PaintedSurface(vertices.reshape(-1, 3), faces)
