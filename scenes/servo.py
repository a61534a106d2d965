"""Specification of a servo that follows a surface in a plane, and of the object's position."""

from typing import Annotated

from pydantic import Field

from scenes.base import Name, NonNegative, Positive, Section

Three = tuple[float, float, float]


class PlacementSpec(Section):
    """Position of an object in the arm's base frame: its origin, and its rotation about the base's z.

    Without rotation the object's outward side faces -y of the base, its section is horizontal, and its y axis points down.

    Attributes
    ----------
    position_mm : three numbers
        The object's origin in the base frame.
    turn_deg : float
        Rotation about the base's z, from x towards y.
    """

    position_mm: Three = (300.0, 60.0, 0.0)
    turn_deg: float = 0.0


class ServoSpec(Section):
    """A servo that follows a surface: a proportional-integral law for depth and angle, with a feed along the surface.

    The default gains and bounds of the integrals are those of the sensor group's public servo code.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        Purpose of the file.
    source : str
        Source of the numbers.
    experiment : str
        Experiment whose labels the model estimates. It defines the approach and the zero of the depth.
    indent_mm, angle_deg : float
        Reference of the control: indentation, and angle from the surface's normal.
    feed_mm : float
        Distance along the surface in each step.
    kp_depth, ki_depth, kp_angle, ki_angle : float
        Gains: the fractions of the error (p) and of its sum over the steps (i) that one step corrects.
    integral_mm, integral_deg : float
        Bounds of the sums.
    largest_move_mm, largest_turn_deg : float
        Bounds of one step: of its whole translation (feed and correction of the depth), and of the correction of the angle.
    clear_mm : float
        Distance from the surface at which the approach starts, and to which the arm retreats.
    linear_mm_s, angular_deg_s : float
        Speeds of every move in following and collecting. They are much lower than in the sensor group's practice with an MG400, where the
        speed factor is 20 % in following and 50 % in collecting.
    plausible_mm, plausible_deg : (lowest, highest)
        Depths and angles that a sensor in contact can have. An estimate outside of them is not used, and the arm does not move.
    blind_mm : float
        Largest distance of the tool from its position at the exposure of the newest frame.
    max_frame_age_s : float
        Largest age of a frame that is used. If no frame is new enough, the arm stops and holds its position.
    placement : PlacementSpec
        The object's position.
    """

    name: Name
    description: str
    source: str = ""
    experiment: str = "surface-2d"
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
    plausible_mm: tuple[float, float] = (-3.0, 8.0)
    plausible_deg: tuple[float, float] = (-60.0, 60.0)
    blind_mm: Positive = 4.0
    max_frame_age_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    placement: PlacementSpec = PlacementSpec()
