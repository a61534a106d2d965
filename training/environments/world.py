"""Poses of tools and objects: the motions of a tool, and the contact of a rigid sensor."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from scenes import ExperimentSpec, ObjectSpec, SensorSpec
from twin.rig.kinematics import Mounting
from twin.rig.touch import SmoothSurface
from twin.types import FloatArray

Axis = Literal["x", "y", "z", "Rx", "Ry", "Rz"]
AXES: tuple[str, ...] = get_args(Axis)
"""Motions of a tool in its work frame: z out of the dome's apex, x across it in the plane in which a surface is followed."""


@dataclass(frozen=True)
class Tool:
    """A sensor on a tool. The work frame has its origin at the tool point, x along the mounting's ``across`` and z along its ``axis``.

    Attributes
    ----------
    mounting : Mounting
    T_work_sensor : (4, 4) float
    """

    mounting: Mounting
    T_work_sensor: FloatArray

    @classmethod
    def of(cls, sensor: SensorSpec, experiment: ExperimentSpec) -> "Tool":
        """The tool of a sensor's own rig, with the approach of an experiment."""
        mounting = Mounting.of(sensor, experiment)
        return cls(mounting, np.linalg.inv(work_frame(mounting)) @ mounting.T_tool_sensor)

    def object_poses(self, T_world_work: FloatArray, T_world_object: FloatArray) -> FloatArray:
        """``T_sensor_object`` (B, 4, 4) of tools and objects in poses (B, 4, 4)."""
        return inverse(T_world_work @ self.T_work_sensor) @ T_world_object


def work_frame(mounting: Mounting) -> FloatArray:
    """``T_tool_work`` (4, 4): the frame in which tasks and policies move a tool."""
    T = np.eye(4)
    T[:3, :3] = mounting.work_axes
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Inverses of rigid motions (B, 4, 4)."""
    out = np.zeros_like(T)
    turn = np.swapaxes(T[:, :3, :3], 1, 2)
    out[:, :3, :3] = turn
    out[:, :3, 3] = -np.einsum("bij,bj->bi", turn, T[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out


def motions(step: FloatArray) -> FloatArray:
    """Rigid motions (B, 4, 4) of steps (B, 6): a shift in mm, and a turn vector in deg about the frame's origin."""
    T = np.tile(np.eye(4), (len(step), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_rotvec(step[:, 3:], degrees=True).as_matrix(), step[:, :3]
    return T


def turn_about(axis: Sequence[float], deg: float) -> FloatArray:
    """A turn (4, 4) about an axis (3,) through the origin."""
    return motions(np.concatenate([np.zeros(3), deg * np.asarray(axis, float)])[None])[0]


def standing_on(tool: Tool, surface: SmoothSurface, along_mm: float, indent_mm: float, angle_deg: float) -> FloatArray:
    """``T_object_work`` (4, 4) of a tool that presses the dome against a surface beside its object's origin.

    Parameters
    ----------
    along_mm : float
        Distance from the object's origin along its x.
    indent_mm : float
        Indentation of the dome.
    angle_deg : float
        Angle of the tool from the surface's normal, about the work frame's y.
    """
    at = np.array([[along_mm, 0.0, 0.0]])
    for _ in range(20):  # to the surface, in the plane y = 0
        distance, normal, _ = surface.field.probe(at)
        at = at - distance[:, None] * normal * [1.0, 0.0, 1.0]
    turned_deg = float(np.degrees(np.arctan2(-normal[0, 0], -normal[0, 2])))
    outward = turn_about((0, 1, 0), turned_deg)[:3, :3] @ [0.0, 0.0, -1.0]
    T = turn_about((0, 1, 0), turned_deg + angle_deg)
    dome = tool.T_work_sensor[:3, 3]
    centre = at[0] + (tool.mounting.skin_apex_mm + surface.raised_mm - indent_mm) * outward
    T[:3, 3] = centre - T[:3, :3] @ dome
    return T


class Surfaces(dict[ObjectSpec, SmoothSurface]):
    """The surfaces of the objects that a task uses, each built once.

    The key is the whole specification, because two files in different folders may have one name.
    """

    def __missing__(self, obj: ObjectSpec) -> SmoothSurface:
        self[obj] = SmoothSurface(obj)
        return self[obj]
