"""How a sensor sits on an arm's tool, and which labels mean zero depth and zero angle; from a rig and an experiment."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from scenes.body import SkinSpec
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from twin.rig.kinematics import TURNING, rig_of

Number = TypeVar("Number", float, np.ndarray)
_DIRECTIONS = {"x": ((1, 0, 0), (0, 1, 0)), "y": ((0, 1, 0), (1, 0, 0)), "z": ((0, 0, 1), (1, 0, 0))}  # the approach, and across it
_SENSOR_AXIS = np.array([0.0, 0.0, 1.0])  # in the sensor frame


@dataclass(frozen=True)
class Mounting:
    """A sensor on a tool. The servo follows a surface in the plane of ``axis`` and ``across``.

    Attributes
    ----------
    axis : (3,) float
        The sensor's z (out of the skin's apex) in the tool frame.
    across : (3,) float
        Direction of the tool frame, at right angles to the axis, along which the tool is fed.
    image_turn_deg : float
        Azimuth of ``across`` in the sensor frame, from image x towards image y.
    centre_mm : (3,) float
        The sensor's origin in the tool frame: a dome's centre, the middle of a pad's outside.
    skin_apex_mm : float
        z of the skin's apex in the sensor frame: a dome's radius, a pad's 0.
    skin_reach_mm : float
        Farthest that the skin reaches from the origin.
    depth_label, angle_label : str
        The labels that tell how deep the tool is, and how far it is turned from the surface's normal.
    zero_mm, zero_deg : float
        Indentation at which the depth's label is 0, and the angle's label at which the sensor stands normal to the surface.
    angle_sign : int
        -1 where the label grows as the tool turns from the axis towards ``across``.
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
        """(3,) axis of the tool frame about which a positive angle turns it: ``across`` towards ``axis``."""
        return np.cross(self.across, self.axis)

    @property
    def apex_mm(self) -> np.ndarray:
        """(3,) the skin's apex in the tool frame."""
        apex: np.ndarray = self.centre_mm + self.skin_apex_mm * self.axis
        return apex

    @property
    def across_in_sensor(self) -> np.ndarray:
        """(3,) ``across`` in the sensor frame."""
        return np.array([np.cos(np.radians(self.image_turn_deg)), np.sin(np.radians(self.image_turn_deg)), 0.0])

    @property
    def tool_point_mm(self) -> np.ndarray:
        """(3,) the tool point in the sensor frame."""
        frame = np.stack([self.axis, self.across, np.cross(self.axis, self.across)])
        here = np.stack([_SENSOR_AXIS, self.across_in_sensor, np.cross(_SENSOR_AXIS, self.across_in_sensor)])
        point: np.ndarray = -(frame @ self.centre_mm) @ here
        return point

    @property
    def work_axes(self) -> np.ndarray:
        """(3, 3) axes of the frame in which tasks and policies move a tool, as columns in the tool frame: x ``across``, z ``axis``."""
        return np.column_stack([self.across, np.cross(self.axis, self.across), self.axis])

    @property
    def T_tool_sensor(self) -> np.ndarray:
        """(4, 4) pose of the sensor's frame in the tool's, mm."""
        turn = np.radians(self.image_turn_deg)
        side = np.cross(self.axis, self.across)  # where the sensor's azimuth goes on to, a quarter turn after ``across``
        T = np.eye(4)
        T[:3, 0] = np.cos(turn) * self.across - np.sin(turn) * side
        T[:3, 1] = np.sin(turn) * self.across + np.cos(turn) * side
        T[:3, 2] = self.axis
        T[:3, 3] = self.centre_mm
        return T

    @property
    def label_turn(self) -> np.ndarray:
        """(3,) axis in the sensor frame about which the tool turns, right-handed, while the angle's label grows."""
        axis: np.ndarray = self.angle_sign * np.cross(self.across_in_sensor, _SENSOR_AXIS)
        return axis

    @classmethod
    def of(cls, sensor: SensorSpec, experiment: ExperimentSpec) -> "Mounting":
        """The mounting of a sensor on its own rig."""
        return cls.on(rig_of(sensor), experiment, sensor.skin)

    @classmethod
    def on(cls, rig: RigSpec, experiment: ExperimentSpec, skin: SkinSpec) -> "Mounting":
        """The mounting of a skin that a rig describes, with the experiment's approach and zero."""
        axis, across = (np.array(direction, float) for direction in _DIRECTIONS[experiment.approach])
        turn = np.cross(across, axis)
        about = TURNING[experiment.approach] - 3
        sign = int(np.sign(turn[about])) * rig.turn_sign
        return cls(
            axis,
            across,
            rig.image_turn_deg,
            rig.tcp_to_dome_mm * axis + rig.tcp_lateral_mm * across + rig.tcp_aside_mm * np.cross(axis, across),
            skin.apex_mm,
            max(skin.apex_mm, *skin.half_size_mm),
            f"pose_{experiment.axis + 1}",
            f"pose_{about + 4}",
            experiment.zero_mm + rig.contact_offset_mm,
            sign * rig.plate_tilt_deg - rig.turn_offset_deg[about],
            sign,
        )

    def depth_mm(self, label: Number) -> Number:
        """Depth beyond first touch that a label stands for."""
        return label + self.zero_mm

    def angle_deg(self, label: Number) -> Number:
        """Angle from the surface's normal that a label stands for."""
        return self.angle_sign * (label - self.zero_deg)

    def labels(self, depth_mm: Number, angle_deg: Number) -> tuple[Number, Number]:
        """The depth's and the angle's label that a depth and an angle would have."""
        return depth_mm - self.zero_mm, self.zero_deg + self.angle_sign * angle_deg
