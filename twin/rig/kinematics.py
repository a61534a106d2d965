"""Kinematics of the rig: conversion of a label in robot coordinates to the object's path in the sensor frame; and the mounting of a sensor
on an arm's tool, with the labels of zero depth and zero angle.

The robot's work frame has the axes x, y and z. Without rotation, the sensor looks along the approach a0. b0 is the direction across: robot
x, or robot y if the approach is x. It appears in the image at the azimuth ``image_turn``. c0 is a0 x b0. With the static xyz rotation R by
``turn_sign (pose_4..6 + turn_offset)`` and p = ``pose_1..3``,

    origin of the sensor = p + R (tcp_to_dome a0 + tcp_lateral b0 + tcp_aside c0)

The z axis of the object's frame is along the approach. The frame is rotated about it by ``object_turn``, and tilted by ``plate_tilt``. An
unrotated sensor at the robot's origin indents the object by ``zero + contact_offset``; the object is shifted by ``object_shift`` along b0
and c0. The arm taps along a0, and then makes the move in a straight line.

All poses here are commanded poses. ``twin.rig.contact`` adds the effect of the contact force.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.body import SkinSpec
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from twin.geometry.shapes import shape_of
from twin.mechanics.path import SKIN_POINTS, ContactPath, march_to_touch
from twin.objects import ObjectField
from twin.rig.labels import ArmLabel

Number = TypeVar("Number", float, np.ndarray)

MOST_TURN_DEG = 1.0  # largest rotation between two poses of the path; its straight legs then differ from the arm's arc by a few um
CLEAR_MM = 10.0  # length by which the search extends the start of the tap; recorded taps of 5 mm begin up to 0.4 mm inside the object

TURNING = {"x": 5, "y": 5, "z": 4}  # by approach: index of the label that rotates the tool in the plane of approach and across
_WORK_AXES = {"x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
"""By approach: the directions across, approach x across, and approach, as columns in the work frame."""


@dataclass(frozen=True)
class ArmPath:
    """Path of the object in one contact, with the arm's labels along it.

    Attributes
    ----------
    path : ContactPath
    labels : list of ArmLabel
        Label of each pose of the path.
    touches : bool
        Whether the tap reaches the object.
    """

    path: ContactPath
    labels: list[ArmLabel]
    touches: bool

    def label(self, fraction: float) -> ArmLabel:
        """The label at a fraction of the path, interpolated between the labels of the poses before and after it."""
        progress = fraction * (len(self.labels) - 1)
        leg = int(np.clip(np.floor(progress), 0, len(self.labels) - 2))
        share, start, stop = progress - leg, self.labels[leg], self.labels[leg + 1]
        pose, move = ((1 - share) * getattr(start, key) + share * getattr(stop, key) for key in ("pose", "move"))
        return ArmLabel(pose, move)


def rig_of(sensor: SensorSpec, before: str | None = None) -> RigSpec:
    """The sensor's rig in front of the object with the name ``before`` (see ``RigSpec.before``).

    A sensor without a rig gets a default one: its tool point is the tip of the skin, and it has no compliance.
    """
    rig = sensor.rig or RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm)
    return rig if before is None else rig.for_object(before)


class Mounting:
    """A sensor on a tool: a skin on a rig, with an experiment's approach and zero.

    The servo follows a surface in the plane of ``axis`` and ``across``.

    Attributes
    ----------
    axis : (3,) float
        The sensor's z (out of the skin's apex) in the tool frame.
    across : (3,) float
        Direction in the tool frame along which the tool is fed; it is perpendicular to the axis.
    work_axes : (3, 3) float
        Axes of the frame in which tasks and policies move a tool, as columns in the tool frame: x ``across``, z ``axis``.
    image_turn_deg : float
        Azimuth of ``across`` in the sensor frame, from image x towards image y.
    centre_mm : (3,) float
        The sensor's origin in the tool frame: the centre of a dome, or the centre of a pad's outside.
    skin_apex_mm : float
        z of the skin's apex in the sensor frame: the radius of a dome, or 0 for a pad.
    skin_reach_mm : float
        Largest distance of the skin from the origin.
    depth_label, angle_label : str
        Names of the labels for the depth of the tool, and for its angle from the surface's normal.
    zero_mm, zero_deg : float
        Indentation at which the label of the depth is 0, and label of the angle at which the sensor is normal to the surface.
    angle_sign : int
        -1 if the label increases when the tool rotates from the axis towards ``across``.
    """

    def __init__(self, rig: RigSpec, experiment: ExperimentSpec, skin: SkinSpec) -> None:
        self.work_axes, self.image_turn_deg = np.array(_WORK_AXES[experiment.approach], float), rig.image_turn_deg
        self.across, _, self.axis = self.work_axes.T
        self.centre_mm = self.work_axes @ [rig.tcp_lateral_mm, rig.tcp_binormal_mm, rig.tcp_to_dome_mm]
        self.skin_apex_mm, self.skin_reach_mm = skin.apex_mm, max(skin.apex_mm, *skin.half_size_mm)
        about = TURNING[experiment.approach] - 3
        self.depth_label, self.angle_label = f"pose_{experiment.axis + 1}", f"pose_{about + 4}"
        self.angle_sign = int(np.sign(self.out_of_plane[about])) * rig.turn_sign
        self.zero_mm = experiment.zero_mm + rig.contact_offset_mm
        self.zero_deg = self.angle_sign * rig.plate_tilt_deg - rig.turn_offset_deg[about]

    @property
    def out_of_plane(self) -> np.ndarray:
        """Axis (3,) in the tool frame of a rotation by a positive angle: from ``across`` towards ``axis``."""
        return np.cross(self.across, self.axis)

    @property
    def apex_mm(self) -> np.ndarray:
        """The skin's apex (3,) in the tool frame."""
        return self.centre_mm + self.skin_apex_mm * self.axis

    @property
    def across_in_sensor(self) -> np.ndarray:
        """``across`` (3,) in the sensor frame."""
        return Rotation.from_euler("z", self.image_turn_deg, degrees=True).as_matrix()[:, 0]

    @property
    def tool_point_mm(self) -> np.ndarray:
        """The tool point (3,) in the sensor frame."""
        return -self.centre_mm @ self.T_tool_sensor[:3, :3]

    @property
    def T_tool_sensor(self) -> np.ndarray:
        """Pose (4, 4) of the sensor frame in the tool frame, mm."""
        T = np.eye(4)
        T[:3, :3] = self.work_axes @ Rotation.from_euler("z", -self.image_turn_deg, degrees=True).as_matrix()
        T[:3, 3] = self.centre_mm
        return T

    @property
    def label_turn(self) -> np.ndarray:
        """Axis (3,) in the sensor frame about which the tool rotates, right-handed, when the label of the angle increases."""
        return self.angle_sign * np.cross(self.across_in_sensor, [0.0, 0.0, 1.0])

    @classmethod
    def of(cls, sensor: SensorSpec, experiment: ExperimentSpec) -> "Mounting":
        """The mounting of a sensor on its own rig."""
        return cls(rig_of(sensor), experiment, sensor.skin)

    def depth_mm(self, label: Number) -> Number:
        """Depth from the first touch on for a label of the depth."""
        return label + self.zero_mm

    def angle_deg(self, label: Number) -> Number:
        """Angle from the surface's normal for a label of the angle."""
        return self.angle_sign * (label - self.zero_deg)

    def labels(self, depth_mm: Number, angle_deg: Number) -> tuple[Number, Number]:
        """Labels of the depth and of the angle for a given depth and angle."""
        return depth_mm - self.zero_mm, self.zero_deg + self.angle_sign * angle_deg


def object_pose(rig: RigSpec, experiment: ExperimentSpec, pose: np.ndarray, apex_mm: float) -> np.ndarray:
    """``T_sensor_object`` (4, 4) for a pose (6,) of the arm in mm and deg; ``apex_mm`` is the z of the skin's apex."""
    unturned = np.array(_WORK_AXES[experiment.approach], float)  # the sensor's x, y and z in the work frame
    turn = tool_turn(rig, pose)
    centre = pose[:3] + turn @ unturned @ [rig.tcp_lateral_mm, rig.tcp_binormal_mm, rig.tcp_to_dome_mm]
    height_mm = apex_mm + rig.tcp_to_dome_mm - experiment.zero_mm - rig.contact_offset_mm
    surface = unturned @ [*rig.object_shift_mm, height_mm]
    to_sensor = Rotation.from_euler("z", rig.image_turn_deg, degrees=True).as_matrix() @ (turn @ unturned).T
    T = np.eye(4)
    T[:3, :3] = to_sensor @ unturned @ Rotation.from_euler("zy", [rig.object_turn_deg, -rig.plate_tilt_deg], degrees=True).as_matrix()
    T[:3, 3] = to_sensor @ (surface - centre)
    return T


def tool_turn(rig: RigSpec, pose: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the tool in the work frame for a pose (6,) of the arm in mm and deg."""
    return Rotation.from_euler("xyz", rig.turn_sign * (np.asarray(pose[3:], float) + rig.turn_offset_deg), degrees=True).as_matrix()


def arm_path(rig: RigSpec, experiment: ExperimentSpec, skin: SkinSpec, field: ObjectField, label: ArmLabel) -> ArmPath:
    """Path of the object relative to the sensor: the poses at first touch and at the end of the tap, and of the move if it was executed.

    Parameters
    ----------
    field : ObjectField
        Its origin is a material point of the object, so the motion from pose to pose is also the motion for friction.

    Raises
    ------
    ContactError
        If the sensor is inside the object already ``CLEAR_MM`` before the tap.
    """
    shape = shape_of(skin)

    def at(pose: np.ndarray) -> np.ndarray:
        return object_pose(rig, experiment, pose, skin.apex_mm)

    tap = np.asarray(experiment.tap) * (1 + CLEAR_MM / experiment.tap[experiment.axis])
    tapped = np.asarray(label.pose, float) - label.move
    if experiment.tap_frame == "tool":
        tap = np.concatenate([tool_turn(rig, tapped) @ tap[:3], tap[3:]])
    skin_mm, start = shape.outside(shape.even(SKIN_POINTS)), at(tapped - tap)
    way = at(tapped)[:3, 3] - start[:3, 3]

    def gaps_at(share: float) -> np.ndarray:
        return field.distance((skin_mm - start[:3, 3] - share * way) @ start[:3, :3])

    too_late = f"the object is in the sensor's way {CLEAR_MM:g} mm before the tap; begin it elsewhere"
    share, _ = march_to_touch(gaps_at, 0.0, 1.0, too_late, unit_mm=float(np.linalg.norm(way)))
    touches, share = share <= 1, min(share, 1.0)
    still = np.zeros(6)
    labels = [ArmLabel(tapped - (1 - share) * tap, still), ArmLabel(tapped, still)]
    if label.executed:
        pieces = max(1, int(np.ceil(np.abs(label.move[3:]).max() / MOST_TURN_DEG)))
        labels += [ArmLabel(tapped + k / pieces * label.move, k / pieces * label.move) for k in range(1, pieces + 1)]
    if not touches:
        labels = labels[1:] if len(labels) > 2 else [replace(labels[1], pose=tapped - tap), labels[1]]
    return ArmPath(ContactPath(np.stack([at(each.pose) for each in labels])), labels, touches)
