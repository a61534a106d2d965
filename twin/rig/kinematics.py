"""Kinematics of the rig: conversion of a label in robot coordinates to the object's path in the sensor frame.

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

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.body import SkinSpec
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.geometry.shapes import shape_of
from twin.mechanics.path import ContactPath
from twin.objects import ObjectField
from twin.rig.labels import ArmLabel

MOST_TURN_DEG = 1.0  # largest rotation between two poses of the path; its straight legs then differ from the arm's arc by a few um
TOUCH_TOLERANCE_MM = 1e-6  # tolerance of a first touch: largest distance between object and skin
TOUCH_POINTS = 20_000  # points on a whole sphere; between them a dome bulges by less than 2 um
MOST_MARCHES = 400  # largest number of steps in the search for the first touch; about ten are usual
CLEAR_MM = 10.0  # length by which the search extends the start of the tap; recorded taps of 5 mm begin up to 0.4 mm inside the object

TURNING = {"x": 5, "y": 5, "z": 4}  # by approach: index of the label that rotates the tool in the plane of approach and across
_UNTURNED = {  # by approach; columns are the sensor's x (across), y and z (approach) in the work frame
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "z": np.eye(3),
}


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


def object_pose(rig: RigSpec, experiment: ExperimentSpec, pose: np.ndarray, apex_mm: float) -> np.ndarray:
    """``T_sensor_object`` (4, 4) for a pose (6,) of the arm in mm and deg; ``apex_mm`` is the z of the skin's apex."""
    unturned = _UNTURNED[experiment.approach]
    turn = tool_turn(rig, pose)
    centre = pose[:3] + turn @ unturned @ [rig.tcp_lateral_mm, rig.tcp_binormal_mm, rig.tcp_to_dome_mm]
    height_mm = apex_mm + rig.tcp_to_dome_mm - experiment.zero_mm - rig.contact_offset_mm
    surface = unturned @ [*rig.object_shift_mm, height_mm]
    sensor = turn @ unturned
    T = np.eye(4)
    stands = Rotation.from_euler("y", -rig.plate_tilt_deg, degrees=True) * Rotation.from_euler("z", rig.object_turn_deg, degrees=True)
    T[:3, :3] = sensor.T @ unturned @ stands.as_matrix()
    T[:3, 3] = sensor.T @ (surface - centre)
    in_image = np.eye(4)
    in_image[:3, :3] = Rotation.from_euler("z", rig.image_turn_deg, degrees=True).as_matrix()
    return in_image @ T


def tool_turn(rig: RigSpec, pose: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the tool in the work frame for a pose (6,) of the arm in mm and deg."""
    turn: np.ndarray = Rotation.from_euler(
        "xyz", rig.turn_sign * (np.asarray(pose[3:], float) + rig.turn_offset_deg), degrees=True
    ).as_matrix()
    return turn


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
    share, touches = _first_touch(field, at(tapped - tap), at(tapped), shape.outside(shape.even(TOUCH_POINTS)))
    still = np.zeros(6)
    labels = [ArmLabel(tapped - (1 - share) * tap, still), ArmLabel(tapped, still)]
    if label.executed:
        pieces = max(1, int(np.ceil(np.abs(label.move[3:]).max() / MOST_TURN_DEG)))
        labels += [ArmLabel(tapped + k / pieces * label.move, k / pieces * label.move) for k in range(1, pieces + 1)]
    if not touches:
        labels = labels[1:] if len(labels) > 2 else [replace(labels[1], pose=tapped - tap), labels[1]]
    return ArmPath(ContactPath(np.stack([at(each.pose) for each in labels])), labels, touches)


def _first_touch(field: ObjectField, start: np.ndarray, stop: np.ndarray, skin_mm: np.ndarray) -> tuple[float, bool]:
    """Fraction of the straight path between two poses at which the object first touches the skin, and whether it touches at all.

    The object advances again and again by its smallest distance to the skin. If distances are exact, it never passes the first touch
    (sphere tracing, Hart 1996).
    """
    turn, way = start[:3, :3], stop[:3, 3] - start[:3, 3]
    length_mm = float(np.linalg.norm(way))
    share = 0.0
    free: float | None = None  # the largest fraction without contact so far
    for _ in range(MOST_MARCHES):
        gap_mm = float(field.distance((skin_mm - start[:3, 3] - share * way) @ turn).min())
        if abs(gap_mm) <= TOUCH_TOLERANCE_MM:
            return share, True
        if gap_mm < 0:
            if free is None:
                raise ContactError(f"the object is in the sensor's way {CLEAR_MM:g} mm before the tap; begin it elsewhere")
            share = (share + free) / 2  # the distance was too large, which happens near wires and far from a mesh: go back half of the step
            continue
        free = share
        share += gap_mm / length_mm
        if share >= 1:
            return 1.0, False
    return free or 0.0, True
