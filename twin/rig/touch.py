"""Depth and angle of a rigid sensor at a surface, with one definition for objects of any shape.

The surface is replaced by a flat plate. The plate is tangential to the surface at the point nearest to the sensor's origin (the centre of a
dome, or the centre of a pad's outside). With the distance g of the origin from the surface, the angle w of the tool's axis from the normal,
the z ``apex`` of the skin's apex (the radius of a dome, or 0 for a pad), and the position of the origin relative to the tool point, ``tcp``
along the axis and ``lateral`` across it,

    indentation = apex - g,   depth of the tool = apex + tcp - (g + tcp cos w + lateral sin w)
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.rig import RigSpec
from twin.objects import build_field
from twin.rig.kinematics import Mounting

OUTLINE_STEP_MM = 0.5
"""Distance between two points of an outline."""
LONGEST_OUTLINE_MM = 2000.0
"""Largest length of an outline. An outline that is not closed after this length belongs to an infinite object, and ends there."""


@dataclass(frozen=True)
class TrueTouch:
    """True depth and angle of a rigid sensor in M poses of a rigid object.

    Attributes
    ----------
    depth_mm : (M,) float
        Depth of the tool along the surface's normal. It is 0 where a sensor normal to the surface first touches. The label of the depth is
        this depth minus ``Mounting.zero_mm``.
    angle_deg : (M,) float
        Angle of the tool from the surface's normal, in the plane of the mounting's ``axis`` and ``across``.
    indent_mm : (M,) float
        Indentation of a dome, or of the centre of a pad.
    place_mm : (M, 3) float
        Point of the surface nearest to the sensor's origin, in the object frame.
    """

    depth_mm: np.ndarray
    angle_deg: np.ndarray
    indent_mm: np.ndarray
    place_mm: np.ndarray


class SmoothSurface:
    """Smooth surface of an object: the object without its texture, moved outwards by the height of the texture.

    Parameters
    ----------
    spec : ObjectSpec

    Attributes
    ----------
    field : ObjectField
        The object without its texture.
    raised_mm : float
        Height of the texture.
    """

    def __init__(self, spec: ObjectSpec) -> None:
        self.field = build_field(spec.alter(texture=None))
        self.raised_mm = spec.texture.wire_diameter_mm if spec.texture else 0.0

    @cached_property
    def outline(self) -> np.ndarray:
        """Outline of the object in the plane y = 0: x and z (M, 2) in the object frame, mm. It starts at the origin along x. Read-only."""
        at, points = np.zeros(3), [np.zeros(2)]
        while len(points) * OUTLINE_STEP_MM < LONGEST_OUTLINE_MM:
            _, gradient, _ = self.field.probe(at[None])
            outward = gradient[0] * [1, 0, 1]
            outward /= np.linalg.norm(outward)
            at = at + OUTLINE_STEP_MM * np.array([-outward[2], 0.0, outward[0]])
            for _ in range(4):
                distance, gradient, _ = self.field.probe(at[None])
                at = at - distance[0] * gradient[0] * [1, 0, 1]
            points.append(at[[0, 2]])
            if len(points) > 10 and np.linalg.norm(points[-1]) < 0.75 * OUTLINE_STEP_MM:
                points[-1] = np.zeros(2)
                break
        outline = np.array(points)
        outline.flags.writeable = False
        return outline

    def depth_and_angle(self, mounting: Mounting, T_sensor_object: np.ndarray) -> TrueTouch:
        """Depth and angle of a mounted sensor for poses (M, 4, 4) of the object."""
        turn, shift = T_sensor_object[:, :3, :3], T_sensor_object[:, :3, 3]
        centre_mm = -np.einsum("mji,mj->mi", turn, shift)
        distance_mm, outward, _ = self.field.probe(centre_mm)
        gap_mm = distance_mm - self.raised_mm
        inward = -np.einsum("mij,mj->mi", turn, outward)  # in the sensor frame
        azimuth = np.radians(mounting.image_turn_deg)
        across, axial = inward[:, 0] * np.cos(azimuth) + inward[:, 1] * np.sin(azimuth), inward[:, 2]  # a product of BLAS depends on M
        along_mm, lateral_mm = mounting.centre_mm @ mounting.axis, mounting.centre_mm @ mounting.across
        return TrueTouch(
            mounting.skin_apex_mm + along_mm - (gap_mm + along_mm * axial + lateral_mm * across),
            np.degrees(np.arctan2(across, axial)),
            mounting.skin_apex_mm - gap_mm,
            centre_mm - gap_mm[:, None] * outward,
        )


def surface_labels(
    experiment: ExperimentSpec, mounting: Mounting, surface: SmoothSurface, T_sensor_object: np.ndarray
) -> dict[str, np.ndarray]:
    """Labels of depth and angle that an arm would have for the same contact with a flat plate.

    Returns
    -------
    dict of str to (M,) float
        By column of the table; mm and deg. Empty if the experiment also rotates the tool about other axes, because one angle then does not
        describe the contact.
    """
    ranges = experiment.ranges()
    turned = {name for name in ("pose_4", "pose_5", "pose_6", "move_4", "move_5", "move_6") if ranges[name] != (0.0, 0.0)}
    if not turned <= {mounting.angle_label, mounting.angle_label.replace("pose", "move")}:
        return {}
    touch = surface.depth_and_angle(mounting, T_sensor_object)
    depth, angle = mounting.labels(touch.depth_mm, touch.angle_deg)
    return {mounting.depth_label: depth, mounting.angle_label: angle}


def tilted_labels(
    rig: RigSpec, experiment: ExperimentSpec, surface: SmoothSurface, apex_mm: float, T_sensor_object: np.ndarray
) -> dict[str, float]:
    """Labels of depth and both tilts that an arm would have for the same contact with a flat plate.

    The function inverts ``object_pose`` for one pose (4, 4). The arm's other three labels count as zero.

    Returns
    -------
    dict of str to float
        ``pose_3`` in mm, ``pose_4`` and ``pose_5`` in deg. Empty if the experiment does not approach along z.
    """
    if experiment.approach != "z":
        return {}
    turn_of_object, centre_mm = T_sensor_object[:3, :3], -T_sensor_object[:3, :3].T @ T_sensor_object[:3, 3]
    distance_mm, outward, _ = surface.field.probe(centre_mm[None])
    in_image = Rotation.from_euler("z", -rig.image_turn_deg, degrees=True)
    # the plate's normal, into the object, in the sensor frame without the rotation of the image
    seen = in_image.apply(-turn_of_object @ outward[0])
    plate = Rotation.from_euler("y", -rig.plate_tilt_deg, degrees=True).apply([0.0, 0.0, 1.0])
    about_z = Rotation.from_euler("z", rig.turn_sign * rig.turn_offset_deg[2], degrees=True)
    unspun = about_z.inv().apply(plate)
    tilt_x = np.arctan2(seen[1], seen[2]) - np.arcsin(np.clip(unspun[1] / np.hypot(seen[1], seen[2]), -1, 1))
    leaned = Rotation.from_euler("x", tilt_x).apply(seen)
    tilt_y = np.arctan2(unspun[0], unspun[2]) - np.arctan2(leaned[0], leaned[2])
    turn = about_z * Rotation.from_euler("xy", [tilt_x, tilt_y])
    arm_mm = turn.apply([rig.tcp_lateral_mm, rig.tcp_binormal_mm, rig.tcp_to_dome_mm])
    stands_mm = (apex_mm + rig.tcp_to_dome_mm - experiment.zero_mm - rig.contact_offset_mm) * plate[2]
    depth_mm = (stands_mm - plate @ arm_mm - (distance_mm[0] - surface.raised_mm)) / plate[2]
    tilts = rig.turn_sign * np.degrees([tilt_x, tilt_y]) - np.array(rig.turn_offset_deg[:2])
    return {"pose_3": float(depth_mm), "pose_4": float(tilts[0]), "pose_5": float(tilts[1])}
