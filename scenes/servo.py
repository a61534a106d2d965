"""Specifications of the rig: how a sensor is mounted on an arm, and how it follows a surface.

Tool and base frames are the arm's. Following happens in one plane: that of the sensor's axis and of ``across``.
"""

from typing import Annotated

from pydantic import Field, model_validator

from scenes.base import NonNegative, Positive, Section

Three = tuple[float, float, float]


class MountingSpec(Section):
    """A sensor on an arm's tool, and what its labels call zero. ``name`` is the file's stem.

    Attributes
    ----------
    axis : (x, y, z)
        The sensor's z (out of the dome's apex) in the tool frame.
    across : (x, y, z)
        Direction of the tool frame, across the axis, along which the tool is fed; a positive angle turns it towards the axis.
    image_turn_deg : float
        Azimuth of ``across`` in the sensor frame, from image x towards image y.
    centre_mm : (x, y, z)
        The dome's centre in the tool frame.
    depth_label, angle_label : str
        The labels that tell how deep and how far from the surface's normal the tool is.
    zero_mm, zero_deg : float
        Indentation where the depth's label is 0, and what the angle's label is where the sensor stands normal to the surface.
    """

    name: str
    description: str
    source: str = ""
    axis: Three = (0.0, 1.0, 0.0)
    across: Three = (1.0, 0.0, 0.0)
    image_turn_deg: float = 90.0
    centre_mm: Three = (0.0, -20.0, 0.0)
    depth_label: str = "pose_2"
    angle_label: str = "pose_6"
    zero_mm: float = 5.0
    zero_deg: float = 0.0

    @model_validator(mode="after")
    def _check(self):
        for name, vector in (("axis", self.axis), ("across", self.across)):
            if abs(sum(v * v for v in vector) - 1) > 1e-6:
                raise ValueError(f"{name} must have length 1, got {vector}")
        if abs(sum(a * b for a, b in zip(self.axis, self.across, strict=True))) > 1e-6:
            raise ValueError("axis and across must be at right angles")
        return self


class PlacementSpec(Section):
    """Where an object stands in the arm's base frame: its origin, and its turn about the base's z.

    Without a turn the object's outward side looks to -y of the base, its section lies level and its y axis points down.
    """

    position_mm: Three = (300.0, 0.0, 0.0)
    turn_deg: float = 0.0


class ServoSpec(Section):
    """Following a surface: a proportional and integral law on depth and angle with a feed along the surface. ``name`` is the file's stem.

    Attributes
    ----------
    indent_mm, angle_deg : float
        The reference: how deep, and how far from the normal.
    feed_mm : float
        Along the surface, in each step.
    kp_*, ki_* : float
        Share of the error, and of its sum over the steps, that a step takes back.
    integral_mm, integral_deg : float
        The sums never exceed these.
    largest_move_mm, largest_turn_deg : float
        Of one step.
    clear_mm : float
        From where the surface is approached, and to where the arm retreats.
    linear_mm_s, angular_deg_s : float
    max_frame_age_s : float
        An older frame decides nothing: the arm stops and holds.
    placement : PlacementSpec
        Where the object stands.
    """

    name: str
    description: str
    source: str = ""
    indent_mm: Positive = 3.0
    angle_deg: float = 0.0
    feed_mm: Positive = 1.0
    kp_depth: NonNegative = 0.5
    ki_depth: NonNegative = 0.3
    kp_angle: NonNegative = 1.0
    ki_angle: NonNegative = 0.1
    integral_mm: NonNegative = 5.0
    integral_deg: NonNegative = 45.0
    largest_move_mm: Positive = 2.0
    largest_turn_deg: Positive = 10.0
    clear_mm: Positive = 50.0
    linear_mm_s: Positive = 20.0
    angular_deg_s: Positive = 60.0
    max_frame_age_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    placement: PlacementSpec = PlacementSpec()
