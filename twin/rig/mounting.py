"""Mounting of a sensor on an arm's tool, and the labels of zero depth and zero angle; from a rig and an experiment."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from scenes.body import SkinSpec
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from twin.rig.kinematics import TURNING, rig_of

Number = TypeVar("Number", float, np.ndarray)
_DIRECTIONS = {"x": ((1, 0, 0), (0, 1, 0)), "y": ((0, 1, 0), (1, 0, 0)), "z": ((0, 0, 1), (1, 0, 0))}  # approach, across
_SENSOR_AXIS = np.array([0.0, 0.0, 1.0])  # in the sensor frame


@dataclass(frozen=True)
class Mounting:
    """A sensor on a tool. The servo follows a surface in the plane of ``axis`` and ``across``.

    Attributes
    ----------
    axis : (3,) float
        The sensor's z (out of the skin's apex) in the tool frame.
    across : (3,) float
        Direction in the tool frame along which the tool is fed; it is perpendicular to the axis.
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

    axis: np.ndarray
    across: np.ndarray
    image_turn_deg: float
    centre_mm: np.ndarray
    skin_apex_mm: float
    skin_reach_mm: float
    depth_label: str
    angle_label: str
    zero_mm: float
    zero_deg: float
    angle_sign: int

    @property
    def out_of_plane(self) -> np.ndarray:
        """Axis (3,) in the tool frame of a rotation by a positive angle: from ``across`` towards ``axis``."""
        return np.cross(self.across, self.axis)

    @property
    def apex_mm(self) -> np.ndarray:
        """The skin's apex (3,) in the tool frame."""
        apex: np.ndarray = self.centre_mm + self.skin_apex_mm * self.axis
        return apex

    @property
    def across_in_sensor(self) -> np.ndarray:
        """``across`` (3,) in the sensor frame."""
        return np.array([np.cos(np.radians(self.image_turn_deg)), np.sin(np.radians(self.image_turn_deg)), 0.0])

    @property
    def tool_point_mm(self) -> np.ndarray:
        """The tool point (3,) in the sensor frame."""
        frame = np.stack([self.axis, self.across, np.cross(self.axis, self.across)])
        here = np.stack([_SENSOR_AXIS, self.across_in_sensor, np.cross(_SENSOR_AXIS, self.across_in_sensor)])
        point: np.ndarray = -(frame @ self.centre_mm) @ here
        return point

    @property
    def work_axes(self) -> np.ndarray:
        """Axes (3, 3) of the frame in which tasks and policies move a tool, as columns in the tool frame: x ``across``, z ``axis``."""
        return np.column_stack([self.across, np.cross(self.axis, self.across), self.axis])

    @property
    def T_tool_sensor(self) -> np.ndarray:
        """Pose (4, 4) of the sensor frame in the tool frame, mm."""
        turn = np.radians(self.image_turn_deg)
        side = np.cross(self.axis, self.across)  # direction whose azimuth in the sensor frame is 90 deg larger than that of ``across``
        T = np.eye(4)
        T[:3, 0] = np.cos(turn) * self.across - np.sin(turn) * side
        T[:3, 1] = np.sin(turn) * self.across + np.cos(turn) * side
        T[:3, 2] = self.axis
        T[:3, 3] = self.centre_mm
        return T

    @property
    def label_turn(self) -> np.ndarray:
        """Axis (3,) in the sensor frame about which the tool rotates, right-handed, when the label of the angle increases."""
        axis: np.ndarray = self.angle_sign * np.cross(self.across_in_sensor, _SENSOR_AXIS)
        return axis

    @classmethod
    def of(cls, sensor: SensorSpec, experiment: ExperimentSpec) -> "Mounting":
        """The mounting of a sensor on its own rig."""
        return cls.on(rig_of(sensor), experiment, sensor.skin)

    @classmethod
    def on(cls, rig: RigSpec, experiment: ExperimentSpec, skin: SkinSpec) -> "Mounting":
        """The mounting of a skin on a rig, with the experiment's approach and zero."""
        axis, across = (np.array(direction, float) for direction in _DIRECTIONS[experiment.approach])
        turn = np.cross(across, axis)
        about = TURNING[experiment.approach] - 3
        sign = int(np.sign(turn[about])) * rig.turn_sign
        return cls(
            axis,
            across,
            rig.image_turn_deg,
            rig.tcp_to_dome_mm * axis + rig.tcp_lateral_mm * across + rig.tcp_binormal_mm * np.cross(axis, across),
            skin.apex_mm,
            max(skin.apex_mm, *skin.half_size_mm),
            f"pose_{experiment.axis + 1}",
            f"pose_{about + 4}",
            experiment.zero_mm + rig.contact_offset_mm,
            sign * rig.plate_tilt_deg - rig.turn_offset_deg[about],
            sign,
        )

    def depth_mm(self, label: Number) -> Number:
        """Depth from the first touch on for a label of the depth."""
        return label + self.zero_mm

    def angle_deg(self, label: Number) -> Number:
        """Angle from the surface's normal for a label of the angle."""
        return self.angle_sign * (label - self.zero_deg)

    def labels(self, depth_mm: Number, angle_deg: Number) -> tuple[Number, Number]:
        """Labels of the depth and of the angle for a given depth and angle."""
        return depth_mm - self.zero_mm, self.zero_deg + self.angle_sign * angle_deg
