"""Exact signed distances of simple solids.

Every solid has ``probe`` (and therefore ``distance`` and ``gradient``) and ``unroll``, which gives texture coordinates: two lengths
(k, 2) in mm along the surface below a point, with their gradients (k, 2, 3) and their Hessians (k, 2, 3, 3) in 1/mm.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from twin.objects import kernels
from twin.objects.level_set import Probe, Wrapped, rows
from twin.types import FloatArray


class CompiledSolid(Wrapped):
    """A solid for which there is compiled code.

    Attributes
    ----------
    kind : int
        See ``kernels.solid``.
    kernel : callable
        Function of the points and the ``sizes``.
    """

    kind: ClassVar[int]
    kernel: ClassVar[Callable[..., Probe]]

    @property
    def sizes(self) -> tuple[float, ...]:
        """The numbers that ``kernel`` takes: the solid's fields, in their order."""
        return tuple(vars(self).values())

    def probe(self, points_mm: FloatArray) -> Probe:
        return type(self).kernel(rows(points_mm), *self.sizes)


@dataclass(frozen=True)
class Plane(CompiledSolid):
    """Half space z >= 0."""

    kind, kernel = kernels.PLANE, staticmethod(kernels.plane)


@dataclass(frozen=True)
class Sphere(CompiledSolid):
    """Ball behind its pole at the origin. A texture is projected along z."""

    radius_mm: float

    kind, kernel = kernels.ROUND, staticmethod(kernels.round_solid)

    @property
    def sizes(self) -> tuple[float, ...]:
        return self.radius_mm, 0.0


@dataclass(frozen=True)
class Cylinder(CompiledSolid):
    """Cylinder along y that touches the origin from z > 0."""

    radius_mm: float

    kind, kernel = kernels.ROUND, staticmethod(kernels.round_solid)

    @property
    def sizes(self) -> tuple[float, ...]:
        return self.radius_mm, 1.0

    def unroll(self, points_mm: FloatArray) -> Probe:
        return kernels.unroll_cylinder(rows(points_mm), self.radius_mm)


@dataclass(frozen=True)
class Edge(CompiledSolid):
    """Quarter space x >= 0, z >= 0 with an edge rounded by a fillet. The rounded edge lies a little behind the origin."""

    fillet_mm: float

    kind, kernel = kernels.EDGE, staticmethod(kernels.edge)


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

    kind, kernel = kernels.PRISM, staticmethod(kernels.prism)

    def unroll(self, points_mm: FloatArray) -> Probe:
        return kernels.unroll_prism(rows(points_mm), self.sides, self.inradius_mm)
