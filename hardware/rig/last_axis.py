"""The last axis of an arm of four axes. It turns the sensor about the vertical, and its range has two ends.

R = J1 + J4 is not wrapped, and J4 has a range of at most one full turn. Therefore each orientation of the sensor has at most one R within
the range. An orientation slightly beyond an end is held at the end. Farther beyond the end, the axis has to turn back by a full turn, for
which the sensor leaves the object.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hardware.arms.kinematics import Kinematics, LinkageKinematics
from hardware.rig.geometry import PlacedObject
from twin.rig.arm_pose import matrix_of, pose_of

# Angle beyond the end of the range, deg, above which an orientation needs a turn back. It is larger than the noise of an estimated angle.
# Otherwise the axis would turn back and forth.
HOLD_DEG = 5.0
# Distance, deg, from the end of the range at which the axis is held. With it, rounding can't change the turn to which a pose belongs.
EDGE_DEG = 0.01
# Angle, deg, above which a turn is a turn back. No step of a servo is as large.
HALF_TURN_DEG = 180.0
# Number of iterations in which place and turn of a held sensor are matched.
HOLD_STEPS = 4


@dataclass(frozen=True)
class LastAxis:
    """Range of the last axis. Arms of other kinds have no limited last axis.

    Attributes
    ----------
    kinematics : Kinematics or None
    centre_mm : (3,) float
        Point in the tool's frame that does not move when the axis is held.
    """

    kinematics: Kinematics | None
    centre_mm: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def on_turn(self, pose: np.ndarray, near_deg: float) -> tuple[np.ndarray, float]:
        """The pose (6,) with R on the same turn as ``near_deg``, held at the axis' end, and the angle in deg by which it was changed."""
        if not isinstance(self.kinematics, LinkageKinematics):
            return np.array(pose, float), 0.0
        low, high = self.kinematics.limits_deg[3]
        out = np.array(pose, float)
        wanted = out[5] + 360.0 * np.round((near_deg - out[5]) / 360.0)
        centre = out[:3] + matrix_of(out)[:3, :3] @ self.centre_mm
        for _ in range(HOLD_STEPS):
            j1 = np.degrees(np.arctan2(out[1], out[0]))
            out[5] = j1 + np.clip(wanted - j1, low + EDGE_DEG, high - EDGE_DEG)
            out[:3] = centre - matrix_of(out)[:3, :3] @ self.centre_mm
        return out, abs(float(out[5] - wanted))

    def turned_back(self, here: np.ndarray, target: np.ndarray) -> np.ndarray | None:
        """The pose (6,) at ``here`` after a turn back, from which a target (6,) beyond the end can be reached; None if there is none."""
        if self.kinematics is None:
            return None
        other = self.kinematics.nearest_pose(target)
        if self.on_turn(target, other[5])[1] > HOLD_DEG:
            return None
        turned, _ = self.on_turn(here, other[5])
        return turned if abs(turned[5] - here[5]) > HALF_TURN_DEG else None


def poses_along(placed: PlacedObject, indent_mm: float, length_mm: float) -> Iterator[tuple[float, np.ndarray]]:
    """Distance along the outline, in mm, and the arm's pose (6,) in contact there, from the start on."""
    outline = placed.outline()
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
    way = np.gradient(outline, axis=0)
    angles = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    first = matrix_of(placed.start_pose(indent_mm))
    for (x, z), angle, distance in zip(outline, angles - angles[0], along, strict=True):
        if distance > length_mm:
            return
        c, s = np.cos(angle), np.sin(angle)
        T = np.array([[c, 0, -s, x], [0, 1, 0, 0], [s, 0, c, z], [0, 0, 0, 1.0]])
        yield float(distance), pose_of(placed.T_base_object @ T @ np.linalg.inv(placed.T_base_object) @ first, np.zeros(6))


def turns_back_mm(placed: PlacedObject, axis: LastAxis, indent_mm: float, length_mm: float) -> list[float]:
    """Distances along the outline, in mm, after which the last axis will turn back if the object stands at its specified place."""
    near, found = None, []
    for distance, pose in poses_along(placed, indent_mm, length_mm):
        if near is None:
            near = pose[5] if axis.kinematics is None else axis.kinematics.nearest_pose(pose)[5]
        held, off = axis.on_turn(pose, near)
        if off > HOLD_DEG and (turned := axis.turned_back(held, pose)) is not None:
            found.append(distance)
            held = turned
        near = held[5]
    return found
