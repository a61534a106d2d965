"""The specification of an object that the sensor is pressed against.

Object frame: The origin is the point of the surface that the sensor touches first, and z points into the object. Before any rotation the
axes are parallel to the sensor's, so the sensor approaches from -z.
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
        Radius of the ball.
    """

    kind: Literal["sphere"]
    radius_mm: Positive


class CylinderShape(Section):
    """Infinitely long cylinder along y that touches the origin from z > 0.

    Attributes
    ----------
    kind : {"cylinder"}
        Names this shape.
    radius_mm : float
        Radius of the cylinder.
    """

    kind: Literal["cylinder"]
    radius_mm: Positive


class EdgeShape(Section):
    """Quarter space x >= 0, z >= 0. Its sharp edge along y would pass through the origin; the rounded edge is a little behind the origin.

    Attributes
    ----------
    kind : {"edge"}
        Names this shape.
    fillet_mm : float
        Radius of the rounded edge.
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
        Radius of the rounded edges along y.
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

    The mesh is rotated and then moved. The line along z through the centre of its bounding box then first meets the mesh at the origin. If
    the mesh has a hole there, its lowest vertex has z = 0.

    Attributes
    ----------
    kind : {"mesh"}
        Names this shape.
    file : str
        Path of the mesh, relative to the specification.
    unit : {"mm", "cm", "m", "inch"}
        Unit of the lengths in the file.
    rotation_deg : three numbers
        Rotation of the mesh, intrinsic about x, y, z.
    sha256 : str
        Digest of the file's content. It is computed when the object is loaded. If a specification states it, a file with another content is
        refused.
    """

    kind: Literal["mesh"]
    file: str
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sha256: str = ""


Shape = Annotated[PlaneShape | SphereShape | CylinderShape | EdgeShape | PrismShape | MeshShape, Field(discriminator="kind")]


class TextureSpec(Section):
    """A wire mesh on the surface: round wires that cross each other at a constant pitch. Its height is one wire diameter.

    Attributes
    ----------
    kind : {"wire-mesh"}
        Names this texture.
    pitch_mm : float
        Distance between the axes of neighbouring wires.
    wire_diameter_mm : float
        Diameter of each wire.
    """

    kind: Literal["wire-mesh"]
    pitch_mm: Positive
    wire_diameter_mm: Positive


class ObjectSpec(Section):
    """The complete specification of an object.

    The four keys of friction apply to contacts without an arm and to sensors without a rig. If a sensor has a rig, the rig's friction
    applies instead (see ``RigSpec``).

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin objects``.
    source : str
        Source of the numbers.
    shape : PlaneShape, SphereShape, CylinderShape, EdgeShape, PrismShape or MeshShape
        The surface. Its key ``kind`` selects the shape.
    texture : TextureSpec, optional
        Texture on the surface.
    friction : float
        Static coefficient of friction. The default is a plausible value for rubber on a smooth solid.
    kinetic_friction : float, optional
        Coefficient of friction of a slipping point. Default: the static coefficient.
    slip_weakening_mm : float
        Slip length over which the coefficient decreases from the static to the kinetic value.
    shear_strength_mpa : float, optional
        Largest friction stress. Without it the friction stress has no limit.
    compliance_mm_per_n : float
        Displacement of the object along the sensor's axis per N. The rig's compliance is added to it.
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
