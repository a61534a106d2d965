"""Specification of a rig: how a robot holds a sensor, and where the object is. It relates labels in robot coordinates to contacts."""

from typing import Annotated, Literal, Self

from pydantic import model_validator

from scenes.base import NonNegative, NotTruth, Section


class ForceSensorSpec(Section):
    """The force sensor of a recording: its columns, axes, gain and offset.

    For the force f in N with which the sensor pushes on the object, in the axes ``frame``, the readings are ``r = offset_n + gain * f``,
    separately for each axis.

    Attributes
    ----------
    columns : three str
        Columns of the table of labels for the forces along x, y and z of the frame.
    frame : {"work", "tool"}
        Axes of the readings: those of the robot's work frame, or those of the tool, which rotates with the sensor. If all angles are 0,
        both are the same.
    gain : three numbers
        Reading per N. It is negative if the reading has the opposite sign.
    offset_n : three numbers
        Reading without contact.
    turn_deg : float
        Right-handed rotation about z, from the axes ``frame`` to those of the force sensor: f is rotated by minus this angle first. It
        applies to tables of forces, whose approach is z.
    """

    columns: tuple[str, str, str] = ("Fx", "Fy", "Fz")
    frame: Literal["work", "tool"] = "work"
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    offset_n: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0


class PlacedSpec(Section):
    """Position of one object, and other values of the rig that differ for it. Keys that are not given have the rig's values.

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
    """One sensor on one robot in front of one plate, calibrated from labelled frames (``twin calibrate contact``).

    Directions: The *approach* is the robot axis along which the sensor looks at the object. *Across* is a robot axis perpendicular to it:
    robot x, or robot y if the approach is x. See ``twin.rig.kinematics`` for the equations, and ``twin.rig.contact`` for the effects of
    friction and compliances.

    Attributes
    ----------
    contact_offset_mm : float
        Indentation of an unrotated sensor minus the indentation in the label.
    tcp_to_dome_mm : float
        Distance along the approach from the tool point, about which the arm rotates, to the dome's centre. It is negative if the tool point
        is in front of the centre. For a tool point at the tip it is minus the dome's radius.
    tcp_lateral_mm : float
        Distance from the tool point to the dome's centre along the direction across.
    tcp_binormal_mm : float
        Distance from the tool point to the dome's centre along approach x across (the cross product). It matters only if the sensor is
        rotated out of the plane of approach and across.
    turn_offset_deg : three numbers
        Angles that are added to ``pose_4..6``.
    turn_sign : 1 or -1
        -1 if the robot's angles are left-handed rotations about its axes.
    plate_tilt_deg : float
        Tilt of the object's surface along the direction across. If it is positive, the surface recedes from the sensor in this direction.
        The twin computes its contacts, and therefore the labels of simulated contacts, with it.
    object_shift_mm : two numbers
        Position of the object's origin in the robot's coordinates along the direction across, and along approach x across.
    object_turn_deg : float
        Right-handed rotation of the object about the approach. With 90, a line of the object along approach x across becomes a line along
        the direction across.
    label_depth_per_move : float or None
        Change of a contact's depth in mm per mm of a move across that the label contains, but that the arm had not executed yet.
        ``twin audit`` finds it in the recording. Labels of recordings are corrected with it. Default: the tangent of ``plate_tilt_deg``.

        Both numbers describe the same plate, and with a straight, stiff arm they would agree. They are separate because they are fitted to
        different data. ``plate_tilt_deg`` is one of many parameters of the fit of the twin's mechanics to the pins of tapped and moved
        contacts. It compensates part of the error of the mechanics. ``label_depth_per_move`` is fitted to the labels and pins of frames
        whose move was not executed, without mechanics, so it includes all effects that change the depth along the arm's path. All models of
        a recording were trained and evaluated with labels that it corrected. If it changes, the models' figures must be measured again.
    image_turn_deg : float
        Azimuth of the direction across in the sensor frame, from image x towards image y.
    friction : float
        Coefficient of static and kinetic friction of all contacts of this rig's arm, with any object, because it was fitted to frames of
        this sensor's skin. The default is that of an object. An object's own friction applies to sensors without a rig and to contacts
        without an arm (``twin render``, ``SkinSolver.press``). A friction that a user gives takes precedence over both.
    compliance_mm_per_n : float
        Displacement of the arm and its mount along the sensor's axis per N. It is needed because labels are commanded poses, not reached
        poses. An object's own compliance is added to it.
    turn_compliance_deg_per_n : float
        Rotation of the arm about its tool point per N of the force of the sensor on the object along the direction across, in the sensor
        frame. Its sign is that of the label in the plane of approach and across.
    force_sensor : ForceSensorSpec, optional
        Force sensor of the recordings, if their tables contain measured forces.
    placed : list of PlacedSpec
        Objects at other positions than the plate. ``for_object`` returns the rig in front of one of them.
    """

    contact_offset_mm: float = 0.0
    former_keys = {"tcp_aside_mm": "tcp_binormal_mm"}

    tcp_to_dome_mm: float
    tcp_lateral_mm: float = 0.0
    tcp_binormal_mm: float = 0.0
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

    def for_object(self, name: str) -> "RigSpec":
        """The rig in front of the object with this name, without ``placed``."""
        own = next((each for each in self.placed if each.object == name), None)
        known = {} if own is None else own.model_dump(exclude_none=True, exclude={"object"})
        return self.alter(**known | {"placed": ()})

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [each.object for each in self.placed]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"placed: '{twice}' is given twice; give every object once")
        return self
