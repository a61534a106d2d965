"""The signed-distance field of an object from its specification, including a wire mesh on its surface if it has one."""

from dataclasses import dataclass

import numpy as np

from scenes.object import CylinderShape, EdgeShape, MeshShape, ObjectSpec, PlaneShape, PrismShape, SphereShape
from twin.compiled import compiled
from twin.objects.analytic import Cylinder, Edge, Plane, Prism, Sphere
from twin.objects.level_set import ObjectField, Probe, Wrapped, unit_normals
from twin.types import FloatArray

_BLEND = 0.15
"""Length over which wires and base are blended into each other, as a share of the wire's diameter."""
_CREASE_MM = 1e-3
"""Distance from a wire's axis below which the field's curvature counts as 0, because it has no limit there."""


def build_field(spec: ObjectSpec) -> ObjectField:
    """The signed-distance field of an object, with its texture.

    Raises
    ------
    MeshError
        A mesh file is not closed, in the wrong unit, empty or unreadable.
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
            from twin.objects.mesh_field import load_mesh_field  # imports trimesh, which takes a sixth of a second

            base = load_mesh_field(shape)
    if spec.texture is not None:
        return WireMesh(base, spec.texture.pitch_mm, spec.texture.wire_diameter_mm)
    return base


@dataclass(frozen=True)
class WireMesh(ObjectField):
    """Round wires that lie on the base's surface in two crossing families; one wire of each family passes over the origin.

    The distance to a wire is sqrt((D - d/2)^2 + s^2) - d/2, where D is the base's distance, d the wire's diameter and s the distance
    along the surface to the nearest wire. Base and wires are joined by the polynomial smooth minimum (Quilez), which only adds
    material.
    """

    base: Wrapped
    pitch_mm: float
    wire_diameter_mm: float

    def probe(self, points_mm: FloatArray) -> Probe:
        found = self.base.probe(points_mm)
        _lay_wires(found, self.base.unroll(points_mm), self.pitch_mm, self.wire_diameter_mm)
        unit_normals(*found[1:])
        return found


@compiled(error_model="numpy")
def _lay_wires(base_field: Probe, unrolled: Probe, pitch: float, diameter: float) -> None:
    """Join both families of wires to the base's distance (k,), slope (k, 3) and Hessian (k, 3, 3), in place."""
    (distance, slope, hessian), (along, along_slope, along_bend) = base_field, unrolled
    radius, blend = diameter / 2, _BLEND * diameter
    base, base_bend, wire = np.empty(3), np.empty((3, 3)), np.empty(3)
    for k in range(len(distance)):
        lift = distance[k] - radius
        for i in range(3):
            base[i] = slope[k, i]
            for j in range(3):
                base_bend[i, j] = hessian[k, i, j]
        for family in range(2):
            s = along[k, family] - pitch * np.floor(along[k, family] / pitch + 0.5)
            away = max(np.sqrt(lift * lift + s * s), 1e-9)
            # smooth minimum of a and b: (1 - w) a + w b - blend w (1 - w), where w = (1 + (a - b) / blend) / 2 is clipped to 0..1
            w = min(0.5 + (distance[k] - away + radius) / (2 * blend), 1.0)
            if w <= 0:
                continue
            distance[k] = (1 - w) * distance[k] + w * (away - radius) - blend * w * (1 - w)
            for i in range(3):
                wire[i] = (lift * base[i] + s * along_slope[k, family, i]) / away
            turning = w / away if away > _CREASE_MM else 0.0
            joining = 1 / (2 * blend) if w < 1 else 0.0
            for i in range(3):
                for j in range(i, 3):
                    bend = base[i] * base[j] + lift * base_bend[i, j] - wire[i] * wire[j]
                    bend += along_slope[k, family, i] * along_slope[k, family, j] + s * along_bend[k, family, i, j]
                    bend = (1 - w) * hessian[k, i, j] + turning * bend
                    hessian[k, i, j] = bend - joining * (slope[k, i] - wire[i]) * (slope[k, j] - wire[j])
                    hessian[k, j, i] = hessian[k, i, j]
            for i in range(3):
                slope[k, i] = (1 - w) * slope[k, i] + w * wire[i]
