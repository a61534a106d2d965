"""How a robot holds a sensor, and where its object is: what turns a label in robot coordinates into a contact."""

from typing import Annotated, Literal

from scenes.base import NonNegative, NotTruth, Section


class RigSpec(Section):
    """One sensor on one robot before one plate; calibrated from labelled frames (``twin calibrate contact``).

    Directions: the *approach* is the robot axis along which the sensor looks at the object, *across* a robot axis at right
    angles to it (robot x; y where the approach is x). See ``twin.kinematics`` for the equations.

    Attributes
    ----------
    contact_offset_mm : float
        Indentation of an unturned sensor beyond what the label says.
    tcp_to_dome_mm : float
        From the tool point, about which the arm turns, to the dome's centre along the approach (negative: the
        tool point lies in front of the centre; minus the dome's radius: it is the tip).
    tcp_lateral_mm : float
        The same across the approach.
    turn_offset_deg : three numbers
        Added to ``pose_4..6``.
    turn_sign : 1 or -1
        -1 where the robot's angles turn left-handed about its axes.
    plate_tilt_deg : float
        Rise of the object's surface towards the sensor's far side, along the direction across. It governs where the twin has
        its contacts, and the labels of simulated ones; corrected labels of recordings go by ``training.targets.DEPTH_PER_MOVE``.
    image_turn_deg : float
        Azimuth of the direction across in the sensor frame, from image x towards image y.
    friction : float
        One coefficient for all contacts.
    compliance_mm_per_n : float
        How far the arm and its mount give way along the sensor's axis; labels say where the arm was sent.
    turn_compliance_deg_per_n : float
        How far they turn, as the label in the plane of approach and across counts, for each N that the sensor pushes the object across.
    """

    contact_offset_mm: float = 0.0
    tcp_to_dome_mm: float
    tcp_lateral_mm: float = 0.0
    turn_offset_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_sign: Annotated[Literal[1, -1], NotTruth] = 1
    plate_tilt_deg: float = 0.0
    image_turn_deg: float = 0.0
    friction: NonNegative = 0.5
    compliance_mm_per_n: NonNegative = 0.0
    turn_compliance_deg_per_n: float = 0.0
