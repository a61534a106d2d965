"""From an object's specification to its signed-distance field."""

from typing import Protocol

import numpy as np

from scenes.object import CylinderShape, EdgeShape, MeshShape, ObjectSpec, PlaneShape, PrismShape, SphereShape
from twin.stimulus.analytic import Cylinder, Edge, Plane, Prism, Sphere
from twin.stimulus.level_set import Probe, Wrapped
from twin.stimulus.mesh_field import load_mesh_field
from twin.stimulus.texture import WireMesh
from twin.types import FloatArray


class ObjectField(Protocol):
    """A solid in the object frame, as a signed-distance field at points (k, 3) in mm."""

    def distance(self, points_mm: FloatArray) -> FloatArray:
        """(k,) in mm, positive outside."""
        ...

    def gradient(self, points_mm: FloatArray) -> FloatArray:
        """(k, 3) unit, outwards."""
        ...

    def probe(self, points_mm: FloatArray) -> Probe:
        """Distance (k,), gradient (k, 3) and Hessian (k, 3, 3) in 1/mm, in one evaluation.

        The Hessian is the second derivative of the distance: symmetric, with the gradient in its null space, zero across
        creases. Where a field is no exact distance it is the derivative of the unit gradient along the level set.
        """
        ...


def build_field(spec: ObjectSpec) -> ObjectField:
    """The signed-distance field of an object, with its texture.

    Raises
    ------
    MeshError
        If a mesh file is not closed, in the wrong unit, empty or unreadable.
    """
    shape = spec.shape
    base: Wrapped
    match shape:
        case PlaneShape():
            base = Plane()
        case SphereShape():
            base = Sphere(shape.radius_mm)
        case CylinderShape():
            base = Cylinder(shape.radius_mm)
        case EdgeShape():
            base = Edge(shape.fillet_mm)
        case PrismShape():
            base = Prism(shape.sides, shape.inradius_mm, shape.fillet_mm, np.radians(shape.taper_deg))
        case MeshShape():
            base = load_mesh_field(shape)
    if spec.texture is not None:
        return WireMesh(base, spec.texture.pitch_mm, spec.texture.wire_diameter_mm)
    return base
