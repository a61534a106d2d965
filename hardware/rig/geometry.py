"""Poses of tool, sensor and object as matrices, and the true contact of a sensor at a pose of the arm."""

from dataclasses import fields

import numpy as np

from scenes.object import ObjectSpec
from scenes.servo import PlacementSpec
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting
from twin.rig.touch import SmoothSurface, TrueTouch


def shift_in_tool(pose: np.ndarray, step_mm: np.ndarray) -> np.ndarray:
    """The pose (6,) shifted by a step (3,) that is given in the tool's frame."""
    out = np.array(pose, float)
    out[:3] += matrix_of(pose)[:3, :3] @ np.asarray(step_mm, float)
    return out


def distance_to_axis(a: np.ndarray, b: np.ndarray) -> float:
    """Smallest distance from the origin to the line segment from a to b in the plane."""
    along = b - a
    length = float(along @ along)
    share = 0.0 if length == 0 else float(np.clip(-(a @ along) / length, 0.0, 1.0))
    return float(np.linalg.norm(a + share * along))


def object_in_base(placement: PlacementSpec) -> np.ndarray:
    """``T_base_object`` (4, 4)."""
    c, s = np.cos(np.radians(placement.turn_deg)), np.sin(np.radians(placement.turn_deg))
    T = np.eye(4)
    T[:3, :3] = np.column_stack([[c, s, 0], [0, 0, -1], [-s, c, 0]])
    T[:3, 3] = placement.position_mm
    return T


class PlacedObject:
    """An object in front of a mounted sensor.

    Parameters
    ----------
    spec : ObjectSpec
    placement : PlacementSpec
    mounting : Mounting
    """

    def __init__(self, spec: ObjectSpec, placement: PlacementSpec, mounting: Mounting) -> None:
        self.spec, self.mounting = spec, mounting
        self.T_base_object = object_in_base(placement)
        self._T_tool_sensor = mounting.T_tool_sensor
        self._surface = SmoothSurface(spec)

    def object_from(self, pose: np.ndarray) -> np.ndarray:
        """``T_sensor_object`` (4, 4) if the arm is at a pose (6,)."""
        return np.linalg.inv(matrix_of(pose) @ self._T_tool_sensor) @ self.T_base_object

    def start_pose(self, indent_mm: float) -> np.ndarray:
        """The arm's pose (6,) at which the sensor stands normal to the object at its origin, with the indentation ``indent_mm``."""
        x, y, z = self.mounting.across, self.mounting.axis, self.mounting.out_of_plane
        T = np.eye(4)  # the tool's across, axis and plane's normal lie along the object's x, z and -y
        T[:3, :3] = self.T_base_object[:3, [0, 2, 1]] * [1, 1, -1] @ np.stack([x, y, z])
        out_mm = self.mounting.skin_apex_mm + self._surface.raised_mm - indent_mm
        centre = self.T_base_object[:3, 3] - out_mm * self.T_base_object[:3, 2]
        T[:3, 3] = centre - T[:3, :3] @ self.mounting.centre_mm
        return pose_of(T, np.zeros(6))

    def touch(self, pose: np.ndarray) -> TrueTouch:
        """The true contact of the sensor if the arm is at a pose (6,), as a ``TrueTouch`` whose arrays have no axis of poses."""
        found = self._surface.depth_and_angle(self.mounting, self.object_from(pose)[None])
        return TrueTouch(*(getattr(found, field.name)[0] for field in fields(TrueTouch)))

    def distance_mm(self, place_mm: np.ndarray) -> float:
        """Distance of a point (3,) of the base frame from the surface, in the section through the object's origin; negative inside."""
        local = (place_mm - self.T_base_object[:3, 3]) @ self.T_base_object[:3, :3] * [1, 0, 1]
        return float(self._surface.field.distance(local[None])[0]) - self._surface.raised_mm

    def outline(self) -> np.ndarray:
        """The object's section through its origin (see ``Surface.outline``)."""
        return self._surface.outline
