"""How a robot holds a sensor, and where its object is: what turns a label in robot coordinates into a contact."""

from typing import Annotated, Literal

from scenes.base import NonNegative, NotTruth, Section


class RigSpec(Section):
    """One sensor on one robot before one plate; calibrated from labelled frames (``twin calibrate contact``).

    Directions: the *approach* is the robot axis along which the sensor looks at the object. *Across* is a robot axis at right
    angles to it: robot x, or robot y where the approach is x. See ``twin.rig.kinematics`` for the equations, and
    ``twin.rig.contact`` for what friction and compliances do.

    Attributes
    ----------
    contact_offset_mm : float
        Indentation of an unturned sensor beyond what the label says.
    tcp_to_dome_mm : float
        From the tool point, about which the arm turns, along the approach to the dome's centre. It is negative where the tool point lies
        in front of the centre. Minus the dome's radius is a tool point at the tip.
    tcp_lateral_mm : float
        From the tool point to the dome's centre along the direction across.
    tcp_aside_mm : float
        From the tool point to the dome's centre along approach x across (the cross product). It matters only where the sensor is turned
        out of the plane of approach and across.
    turn_offset_deg : three numbers
        Added to ``pose_4..6``.
    turn_sign : 1 or -1
        -1 where the robot's angles turn left-handed about its axes.
    plate_tilt_deg : float
        Rise of the object's surface towards the sensor's far side, along the direction across. It says where the twin has its
        contacts, and so what the labels of simulated contacts are.
    label_depth_per_move : float or None
        Depth in mm that a recording's contact gains for each mm of a move across that its label has but the arm had not made, as
        ``twin audit`` finds it in the recording. Corrected labels of recordings go by it. None: the tangent of ``plate_tilt_deg``.

        Both numbers tell of the same plate, and on a straight, stiff arm they would agree. They are separate because they are
        fitted to different things. ``plate_tilt_deg`` is one of many numbers by which the twin's mechanics meet the pins of tapped
        and moved contacts, and takes on a part of what the mechanics miss. This one is read from the labels and pins of frames
        without a move, with no mechanics, so it has all that makes the depth change along the arm's way. Every model of a
        recording was trained and judged by labels that it corrected: change it only together with the figures.
    image_turn_deg : float
        Azimuth of the direction across in the sensor frame, from image x towards image y.
    friction : float
        One coefficient, static and kinetic, for all contacts that this rig's arm makes, whatever the object: it was fitted to
        frames of this sensor's skin. An object's own friction counts for sensors without a rig and for contacts that no arm makes
        (``twin render``, ``SkinSolver.press``). A friction that a user gives counts before either.
    compliance_mm_per_n : float
        How far the arm and its mount give way along the sensor's axis. Labels tell where the arm was sent, not where it ended. An
        object's own compliance adds to it.
    turn_compliance_deg_per_n : float
        How far the arm turns about its tool point for each N with which the sensor pushes the object across, in the sensor's own
        frame. It is positive as the label in the plane of approach and across counts.
    """

    contact_offset_mm: float = 0.0
    tcp_to_dome_mm: float
    tcp_lateral_mm: float = 0.0
    tcp_aside_mm: float = 0.0
    turn_offset_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_sign: Annotated[Literal[1, -1], NotTruth] = 1
    plate_tilt_deg: float = 0.0
    label_depth_per_move: float | None = None
    image_turn_deg: float = 0.0
    friction: NonNegative = 0.5
    compliance_mm_per_n: NonNegative = 0.0
    turn_compliance_deg_per_n: float = 0.0
