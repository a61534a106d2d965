"""The specification of an object that the sensor is pressed against.

Object frame: the origin is the point of the surface that the sensor touches first, z points into the object. Before any turn the axes
are parallel to the sensor's, so the sensor comes from -z.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from scenes.base import Name, NonNegative, Positive, Section


class PlaneShape(Section):
    """Half space z >= 0."""

    kind: Literal["plane"]


class SphereShape(Section):
    """Ball behind its pole at the origin."""

    kind: Literal["sphere"]
    radius_mm: Positive


class CylinderShape(Section):
    """Cylinder along y, infinitely long, touching the origin from z > 0."""

    kind: Literal["cylinder"]
    radius_mm: Positive


class EdgeShape(Section):
    """Quarter space x >= 0, z >= 0. Its edge along y would pass through the origin, but it is rounded and so lies a little behind it."""

    kind: Literal["edge"]
    fillet_mm: NonNegative = 0.0


class PrismShape(Section):
    """Upright prism: regular polygon section in the x-z plane, extruded along y.

    Face ``0`` is centred on the origin. ``taper_deg`` tilts the side faces about x (a bevelled prism).
    """

    kind: Literal["prism"]
    sides: Annotated[int, Field(ge=3, le=64)]
    inradius_mm: Positive
    fillet_mm: NonNegative = 0.0
    taper_deg: Annotated[float, Field(ge=-45, le=45)] = 0.0


class MeshShape(Section):
    """Closed triangle mesh (STL, OBJ, PLY). ``file`` is relative to the specification.

    The mesh is turned by ``rotation_deg`` (intrinsic x, y, z), then moved so that the line through its bounding box's
    centre along z first meets it at the origin (where the mesh has a hole there: its lowest vertex has z = 0).

    ``sha256`` is the digest of the file's content. It is found when the object is loaded; a specification that gives it takes no other
    content.
    """

    kind: Literal["mesh"]
    file: str
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sha256: str = ""


Shape = Annotated[
    PlaneShape | SphereShape | CylinderShape | EdgeShape | PrismShape | MeshShape,
    Field(discriminator="kind"),
]


class TextureSpec(Section):
    """A wire mesh lying on the surface, raised by one wire diameter: round wires crossing at a pitch."""

    kind: Literal["wire-mesh"]
    pitch_mm: Positive
    wire_diameter_mm: Positive


class ObjectSpec(Section):
    """An object, complete. ``name`` is the file's stem.

    ``friction`` is the static coefficient of friction. When a point has slid by about ``slip_weakening_mm``, the coefficient has fallen
    to ``kinetic_friction`` (default: the static one). ``shear_strength_mpa`` is the largest friction stress (default: no bound).
    These four apply to contacts that no arm makes and to sensors without a rig. If a sensor has a rig, the rig's friction applies
    instead (see ``RigSpec``). ``compliance_mm_per_n`` is the object's displacement along the sensor's axis for each N; it is added to
    the rig's.
    """

    name: Name
    description: str
    source: str = ""
    shape: Shape
    texture: TextureSpec | None = None
    friction: NonNegative = 0.5
    kinetic_friction: NonNegative | None = None
    slip_weakening_mm: Positive = 0.1
    shear_strength_mpa: Positive | None = None
    compliance_mm_per_n: NonNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kinetic_friction is not None and self.kinetic_friction > self.friction:
            raise ValueError("kinetic_friction must not be larger than friction")
        return self
