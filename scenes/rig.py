"""How a robot holds a sensor, and where its object is. This decides which contact a label in robot coordinates means."""

from typing import Annotated, Literal, Self

from pydantic import model_validator

from scenes.base import NonNegative, NotTruth, Section


class ForceSensorSpec(Section):
    """How the force sensor of a recording reads: what its columns mean in the rig's own axes.

    Readings r belong to the force f in N with which the sensor pushes on the object, in the axes ``frame``:
    ``r = offset_n + gain * f``, each axis for itself.

    Attributes
    ----------
    columns : three str
        Columns of the table of labels, for the forces along x, y and z of the frame.
    frame : {"work", "tool"}
        Axes of the readings: those of the robot's work frame, or of the tool, which turns with the sensor. At angles of zero both are the
        same.
    gain : three numbers
        Reading for each N; a negative one has the other sign.
    offset_n : three numbers
        Reading without contact.
    """

    columns: tuple[str, str, str] = ("Fx", "Fy", "Fz")
    frame: Literal["work", "tool"] = "work"
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset_n: tuple[float, float, float] = (0.0, 0.0, 0.0)


class PlacedSpec(Section):
    """Where one object stood, and what else differs before it; keys that are not given are those of the rig.

    Attributes
    ----------
    object : str
        Name of the object.
    contact_offset_mm, plate_tilt_deg, object_turn_deg, friction : float, optional
        As in ``RigSpec``.
    object_shift_mm : two numbers, optional
        As in ``RigSpec``.
    turn_offset_deg : three numbers, optional
        As in ``RigSpec``.
    """

    object: str
    contact_offset_mm: float | None = None
    plate_tilt_deg: float | None = None
    object_shift_mm: tuple[float, float] | None = None
    object_turn_deg: float | None = None
    turn_offset_deg: tuple[float, float, float] | None = None
    friction: NonNegative | None = None


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
        Distance along the approach from the tool point, about which the arm turns, to the dome's centre. It is negative if the tool point
        lies in front of the centre; for a tool point at the tip it is minus the dome's radius.
    tcp_lateral_mm : float
        Distance from the tool point to the dome's centre along the direction across.
    tcp_aside_mm : float
        Distance from the tool point to the dome's centre along approach x across (the cross product). It matters only if the sensor is
        turned out of the plane of approach and across.
    turn_offset_deg : three numbers
        Added to ``pose_4..6``.
    turn_sign : 1 or -1
        -1 if the robot's angles turn left-handed about its axes.
    plate_tilt_deg : float
        Rise of the object's surface towards the sensor's far side, along the direction across. The twin's contacts, and therefore the
        labels of simulated contacts, are computed with it.
    object_shift_mm : two numbers
        Place of the object's origin in the robot's coordinates along the direction across, and along approach x across.
    object_turn_deg : float
        Turn of the object about the approach, right-handed: 90 lays what lies along approach x across along the direction across.
    label_depth_per_move : float or None
        Change of a contact's depth in mm for each mm of a move across that the label has but the arm had not made yet, as
        ``twin audit`` finds it in the recording. Labels of recordings are corrected with it. None: the tangent of ``plate_tilt_deg``.

        Both numbers describe the same plate, and with a straight, stiff arm they would agree. They are separate because they are
        fitted to different data. ``plate_tilt_deg`` is one of many parameters by which the twin's mechanics are fitted to the pins of
        tapped and moved contacts, and compensates part of the error of the mechanics. ``label_depth_per_move`` is fitted to the labels
        and pins of frames whose move was not made, without mechanics, so it includes everything that changes the depth along the
        arm's way. All models of a recording were trained and judged with labels that it corrected: if it changes, the models' figures
        must be measured again.
    image_turn_deg : float
        Azimuth of the direction across in the sensor frame, from image x towards image y.
    friction : float
        Coefficient of static and kinetic friction of all contacts that this rig's arm makes, with any object: it was fitted to frames of
        this sensor's skin. The default is that of an object. An object's own friction applies to sensors without a rig and to contacts
        that no arm makes (``twin render``, ``SkinSolver.press``). A friction that a user gives takes precedence over both.
    compliance_mm_per_n : float
        Displacement of the arm and its mount along the sensor's axis for each N. It is needed because labels are the poses that the arm
        was sent to, not those that it reached. An object's own compliance is added to it.
    turn_compliance_deg_per_n : float
        Turn of the arm about its tool point for each N with which the sensor pushes the object across, in the sensor's own frame. Its
        sign is that of the label in the plane of approach and across.
    force_sensor : ForceSensorSpec, optional
        Where the recordings' tables hold measured forces: how they are read.
    placed : list of PlacedSpec
        Objects that stood elsewhere than the plate; ``before`` gives the rig before one of them.
    """

    contact_offset_mm: float = 0.0
    tcp_to_dome_mm: float
    tcp_lateral_mm: float = 0.0
    tcp_aside_mm: float = 0.0
    turn_offset_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_sign: Annotated[Literal[1, -1], NotTruth] = 1
    plate_tilt_deg: float = 0.0
    object_shift_mm: tuple[float, float] = (0.0, 0.0)
    object_turn_deg: float = 0.0
    label_depth_per_move: float | None = None
    image_turn_deg: float = 0.0
    friction: NonNegative = 0.5
    compliance_mm_per_n: NonNegative = 0.0
    turn_compliance_deg_per_n: float = 0.0
    force_sensor: ForceSensorSpec | None = None
    placed: tuple[PlacedSpec, ...] = ()

    def before(self, name: str) -> "RigSpec":
        """The rig before the object of this name, without ``placed``."""
        own = next((each for each in self.placed if each.object == name), None)
        known = {} if own is None else own.model_dump(exclude_none=True, exclude={"object"})
        return self.model_copy(update=known | {"placed": ()})

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [each.object for each in self.placed]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"placed: '{twice}' is given twice; give every object once")
        return self
