"""The specification of an object that the sensor is pressed against.

Object frame: the origin is the point of the surface that the sensor touches first, z points into the object. Before any turn the axes
are parallel to the sensor's, so the sensor comes from -z.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from scenes.base import Name, NonNegative, Positive, Section


class PlaneShape(Section):
    """Half space z >= 0.

    Attributes
    ----------
    kind : {"plane"}
        Names this shape.
    """

    kind: Literal["plane"]


class SphereShape(Section):
    """Ball behind its pole at the origin.

    Attributes
    ----------
    kind : {"sphere"}
        Names this shape.
    radius_mm : float
        Of the ball.
    """

    kind: Literal["sphere"]
    radius_mm: Positive


class CylinderShape(Section):
    """Cylinder along y, infinitely long, touching the origin from z > 0.

    Attributes
    ----------
    kind : {"cylinder"}
        Names this shape.
    radius_mm : float
        Of the cylinder.
    """

    kind: Literal["cylinder"]
    radius_mm: Positive


class EdgeShape(Section):
    """Quarter space x >= 0, z >= 0. Its edge along y would pass through the origin, but it is rounded and so lies a little behind it.

    Attributes
    ----------
    kind : {"edge"}
        Names this shape.
    fillet_mm : float
        Radius by which the edge is rounded.
    """

    kind: Literal["edge"]
    fillet_mm: NonNegative = 0.0


class PrismShape(Section):
    """Upright prism: regular polygon section in the x-z plane, extruded along y. Face ``0`` is centred on the origin.

    Attributes
    ----------
    kind : {"prism"}
        Names this shape.
    sides : int
        Number of sides of the polygon.
    inradius_mm : float
        Distance from the axis to each side face.
    fillet_mm : float
        Radius by which the edges along y are rounded.
    taper_deg : float
        Tilt of the side faces about x (a bevelled prism).
    """

    kind: Literal["prism"]
    sides: Annotated[int, Field(ge=3, le=64)]
    inradius_mm: Positive
    fillet_mm: NonNegative = 0.0
    taper_deg: Annotated[float, Field(ge=-45, le=45)] = 0.0


class MeshShape(Section):
    """Closed triangle mesh (STL, OBJ, PLY).

    The mesh is turned, then moved so that the line through its bounding box's centre along z first meets it at the origin (where the mesh
    has a hole there: its lowest vertex has z = 0).

    Attributes
    ----------
    kind : {"mesh"}
        Names this shape.
    file : str
        Path of the mesh, relative to the specification.
    unit : {"mm", "cm", "m", "inch"}
        Unit of the lengths in the file.
    rotation_deg : three numbers
        Turn of the mesh, intrinsic about x, y, z.
    sha256 : str
        Digest of the file's content. It is found when the object is loaded; a specification that gives it takes no other content.
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
    """A wire mesh lying on the surface, raised by one wire diameter: round wires crossing at a pitch.

    Attributes
    ----------
    kind : {"wire-mesh"}
        Names this texture.
    pitch_mm : float
        Distance between the axes of neighbouring wires.
    wire_diameter_mm : float
        Of each wire.
    """

    kind: Literal["wire-mesh"]
    pitch_mm: Positive
    wire_diameter_mm: Positive


class ObjectSpec(Section):
    """An object, complete.

    The four keys of friction apply to contacts that no arm makes and to sensors without a rig. If a sensor has a rig, the rig's friction
    applies instead (see ``RigSpec``).

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin objects``.
    source : str
        Where the numbers come from.
    shape : PlaneShape, SphereShape, CylinderShape, EdgeShape, PrismShape or MeshShape
        The surface; its ``kind`` decides which.
    texture : TextureSpec, optional
        What lies on the surface.
    friction : float
        Static coefficient of friction. The default is a plausible one for rubber on a smooth solid.
    kinetic_friction : float, optional
        Coefficient of friction of a point that slides. Without it: the static one.
    slip_weakening_mm : float
        Slid length over which the coefficient falls from the static to the kinetic one.
    shear_strength_mpa : float, optional
        Largest friction stress. Without it there is no bound.
    compliance_mm_per_n : float
        Displacement of the object along the sensor's axis for each N; it is added to the rig's.
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
