"""Exact signed distances of simple solids.

Every solid has ``probe`` (and therefore ``distance`` and ``gradient``) and ``unroll``, which gives texture coordinates: two lengths
(k, 2) in mm along the surface below a point, with their gradients (k, 2, 3) and their Hessians (k, 2, 3, 3) in 1/mm.
Compiled functions give distance (k,), unit gradient (k, 3) and Hessian (k, 3, 3) at points (k, 3) in one pass each. Around a point, a
sphere or a straight line at a distance r, the Hessian of the distance is (I - n n - a a) / r with the normal n and the line's direction a
(none for a point); over a flat face it is zero.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from twin.compiled import compiled
from twin.objects.level_set import Probe, Triple, Wrapped, rows
from twin.types import FloatArray

_CREASE_MM = 1e-3
"""Radius of curvature below which a surface counts as a crease. The Hessian of a crease is set to 0."""
PLANE, ROUND, EDGE, PRISM = range(4)
"""Codes of the kinds of solids, for compiled code that handles all of them."""


@compiled(error_model="numpy")
def _write(normal: FloatArray, hessian: FloatArray, k: int, n: Triple, a: Triple, radius: float) -> None:
    """Write point k's normal n and Hessian (I - n n - a a) / radius. Plain numbers are used, because slices of arrays would be slower."""
    normal[k, 0], normal[k, 1], normal[k, 2] = n
    if radius > _CREASE_MM:
        for i in range(3):
            for j in range(3):
                hessian[k, i, j] = ((i == j) - n[i] * n[j] - a[i] * a[j]) / radius


@compiled(error_model="numpy")
def plane(points: FloatArray, distance: FloatArray, normal: FloatArray, hessian: FloatArray) -> None:
    """Half space behind the origin."""
    for k in range(len(points)):
        distance[k] = -points[k, 2]
        normal[k, 2] = -1.0


@compiled(error_model="numpy")
def round_solid(points: FloatArray, radius: float, along_y: float, distance: FloatArray, normal: FloatArray, hessian: FloatArray) -> None:
    """Ball, or cylinder along y (``along_y`` 1.0, for the ball 0.0), behind the origin."""
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1] * (1 - along_y), points[k, 2] - radius
        away = np.sqrt(x * x + y * y + z * z)
        distance[k] = away - radius
        n = (x / away, y / away, z / away) if away > 0 else (0.0, 0.0, -1.0)
        _write(normal, hessian, k, n, (0.0, along_y, 0.0), away)


@compiled(error_model="numpy")
def edge(points: FloatArray, fillet: float, distance: FloatArray, normal: FloatArray, hessian: FloatArray) -> None:
    """Quarter space with a rounded edge along y."""
    for k in range(len(points)):
        # distances of the point in front of the faces, which are moved inwards by the fillet
        x, z = fillet - points[k, 0], fillet - points[k, 2]
        if x > 0 and z > 0:
            away = np.sqrt(x * x + z * z)
            distance[k] = away - fillet
            _write(normal, hessian, k, (-x / away, 0.0, -z / away), (0.0, 1.0, 0.0), away)
        else:
            face = 0 if x >= z else 2
            distance[k] = -points[k, face]
            normal[k, face] = -1.0


@compiled(error_model="numpy")
def _sector(x: float, z: float, sides: int) -> int:
    """Number of the nearest face around the axis."""
    return int(np.floor(np.arctan2(x, -z) * sides / (2 * np.pi) + 0.5))


@compiled(error_model="numpy")
def prism(
    points: FloatArray,
    sides: int,
    inradius: float,
    fillet: float,
    taper: float,
    distance: FloatArray,
    normal: FloatArray,
    hessian: FloatArray,
) -> None:
    """Prism. Each point is rotated into the sector of its nearest face, with the coordinates: outwards, along the face, y.

    In this sector the nearest point of the polyhedron, whose faces are moved inwards by the fillet, is on that face or on the edge
    between two faces.
    """
    lean_out, lean_y = np.cos(taper), np.sin(taper)
    half = np.tan(np.pi / sides)
    size = np.sqrt(1 + (lean_y * half) ** 2)
    edge_out, edge_along, edge_y = -lean_y / size, -lean_y * half / size, lean_out / size
    corner = inradius - fillet / lean_out
    turns = [(np.cos(2 * np.pi / sides * face), np.sin(2 * np.pi / sides * face)) for face in range(sides)]
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2] - inradius
        cos, sin = turns[_sector(x, z, sides) % sides]
        out, along = x * sin - z * cos, x * cos + z * sin
        mirror = -1.0 if along < 0 else 1.0
        along = abs(along)
        height = out * lean_out + y * lean_y - (inradius * lean_out - fillet)
        p, q, r = lean_out, 0.0, lean_y
        away = 0.0
        distance[k] = height - fillet
        if height > 0 and along > (out - height * lean_out) * half:
            p, q, r = out - corner, along - corner * half, y
            slide = p * edge_out + q * edge_along + r * edge_y
            p, q, r = p - slide * edge_out, q - slide * edge_along, r - slide * edge_y
            away = np.sqrt(p * p + q * q + r * r)
            distance[k] = away - fillet
            p, q, r = p / away, q / away, r / away
        n = (p * sin + q * mirror * cos, r, -p * cos + q * mirror * sin)
        a = (edge_out * sin + edge_along * mirror * cos, edge_y, -edge_out * cos + edge_along * mirror * sin)
        _write(normal, hessian, k, n, a, away)


@compiled(error_model="numpy")
def solid(points: FloatArray, kind: int, sizes: FloatArray) -> Probe:
    """The solid of a kind, with the numbers that its function takes, in their order."""
    distance, normal, hessian = np.empty(len(points)), np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
    if kind == ROUND:
        round_solid(points, sizes[0], sizes[1], distance, normal, hessian)
    elif kind == EDGE:
        edge(points, sizes[0], distance, normal, hessian)
    elif kind == PRISM:
        prism(points, int(sizes[0]), sizes[1], sizes[2], sizes[3], distance, normal, hessian)
    else:
        plane(points, distance, normal, hessian)
    return distance, normal, hessian


@compiled(error_model="numpy")
def unroll_cylinder(points: FloatArray, radius: float) -> Probe:
    """Lengths along the surface of a cylinder instead of across it."""
    along, slope, bend = np.empty((len(points), 2)), np.zeros((len(points), 2, 3)), np.zeros((len(points), 2, 3, 3))
    for k in range(len(points)):
        x, z = points[k, 0], points[k, 2] - radius
        square = max(x * x + z * z, _CREASE_MM**2)
        along[k, 0], along[k, 1] = radius * np.arctan2(x, -z), points[k, 1]
        slope[k, 0, 0], slope[k, 0, 2] = -z * radius / square, x * radius / square
        slope[k, 1, 1] = 1.0
        bend[k, 0, 0, 0] = 2 * x * z * radius / square**2
        bend[k, 0, 2, 2] = -bend[k, 0, 0, 0]
        bend[k, 0, 0, 2] = bend[k, 0, 2, 0] = (z * z - x * x) * radius / square**2
    return along, slope, bend


@compiled(error_model="numpy")
def unroll_prism(points: FloatArray, sides: int, inradius: float) -> Probe:
    """Lengths along the surface of a prism instead of across it."""
    along, slope, bend = np.empty((len(points), 2)), np.zeros((len(points), 2, 3)), np.zeros((len(points), 2, 3, 3))
    width = 2 * inradius * np.tan(np.pi / sides)
    for k in range(len(points)):
        x, z = points[k, 0], points[k, 2] - inradius
        number = _sector(x, z, sides)
        face = 2 * np.pi / sides * number
        cos, sin = np.cos(face), np.sin(face)
        along[k, 0], along[k, 1] = x * cos + z * sin + number * width, points[k, 1]
        slope[k, 0, 0], slope[k, 0, 2], slope[k, 1, 1] = cos, sin, 1.0
    return along, slope, bend


class CompiledSolid(Wrapped):
    """A solid for which there is compiled code.

    Attributes
    ----------
    kind : int
        See ``solid``.
    kernel : callable
        Function of the points, the ``sizes``, and the arrays of a ``Probe``, which it fills; the last two are 0 before.
    further : tuple of float
        Numbers that the kernel takes besides the solid's fields.
    """

    kind: ClassVar[int]
    kernel: ClassVar[Callable[..., None]]
    further: ClassVar[tuple[float, ...]] = ()

    @property
    def sizes(self) -> tuple[float, ...]:
        """The numbers that ``kernel`` takes: the solid's fields, in their order, and ``further`` ones."""
        return *vars(self).values(), *self.further

    def probe(self, points_mm: FloatArray) -> Probe:
        found = np.empty(len(points_mm)), np.zeros((len(points_mm), 3)), np.zeros((len(points_mm), 3, 3))
        type(self).kernel(rows(points_mm), *self.sizes, *found)
        return found


@dataclass(frozen=True)
class Plane(CompiledSolid):
    """Half space z >= 0."""

    kind, kernel = PLANE, staticmethod(plane)


@dataclass(frozen=True)
class Sphere(CompiledSolid):
    """Ball behind its pole at the origin. A texture is projected along z."""

    radius_mm: float

    kind, kernel, further = ROUND, staticmethod(round_solid), (0.0,)


@dataclass(frozen=True)
class Cylinder(CompiledSolid):
    """Cylinder along y that touches the origin from z > 0."""

    radius_mm: float

    kind, kernel, further = ROUND, staticmethod(round_solid), (1.0,)

    def unroll(self, points_mm: FloatArray) -> Probe:
        return unroll_cylinder(rows(points_mm), self.radius_mm)


@dataclass(frozen=True)
class Edge(CompiledSolid):
    """Quarter space x >= 0, z >= 0 with an edge rounded by a fillet. The rounded edge lies a little behind the origin."""

    fillet_mm: float

    kind, kernel = EDGE, staticmethod(edge)


@dataclass(frozen=True)
class Prism(CompiledSolid):
    """Regular polygon in x-z extruded along y, with rounded edges, and faces tilted by a taper about x.

    Face 0 passes through the origin and faces -z. With a positive taper its normal tilts towards +y (the prism narrows towards +y). The
    rounded solid is made by moving all faces inwards by the fillet radius, and adding all points within this radius of the smaller solid.
    """

    sides: int
    inradius_mm: float
    fillet_mm: float
    taper_rad: float

    kind, kernel = PRISM, staticmethod(prism)

    def unroll(self, points_mm: FloatArray) -> Probe:
        return unroll_prism(rows(points_mm), self.sides, self.inradius_mm)
