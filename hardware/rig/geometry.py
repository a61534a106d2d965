"""Poses of tool, sensor and object as matrices, the true contact of a sensor at a pose of the arm, and its path around an object.

The last axis of an arm of four axes turns the sensor about the vertical, and its range has two ends. R = J1 + J4 is not wrapped, and J4 has
a range of at most one full turn. Therefore each orientation of the sensor has at most one R within the range. An orientation slightly
beyond an end is held at the end. Farther beyond the end, the axis has to turn back by a full turn, for which the sensor leaves the object.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields

import numpy as np

from hardware.arms.motion import Kinematics, LinkageKinematics
from hardware.errors import DeviceError
from scenes import ObjectSpec, PlacementSpec
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting
from twin.rig.touch import SmoothSurface, TrueTouch

# Distance between the dome and the circle around the object, in mm.
MARGIN_MM = 10.0
# Largest angle between two poses along this circle, in deg.
STEP_DEG = 30.0
# Distance, in mm, between the points of a straight path at which the gap is checked.
SAMPLE_MM = 1.0
# Angle beyond the end of the range, deg, above which an orientation needs a turn back. It is larger than the noise of an estimated angle.
# Otherwise the axis would turn back and forth.
HOLD_DEG = 5.0
# Distance, deg, from the end of the range at which the axis is held. With it, rounding can't change the turn to which a pose belongs.
EDGE_DEG = 0.01
# Angle, deg, above which a turn is a turn back. No step of a servo is as large.
HALF_TURN_DEG = 180.0
# Number of iterations in which place and turn of a held sensor are matched.
HOLD_STEPS = 4


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
        turned = matrix_of(np.array([*placement.position_mm, 0.0, 0.0, placement.turn_deg]))
        self.T_base_object = turned[:, [0, 2, 1, 3]] * [1, -1, 1, 1]  # its z lies along the turned y, and its y points down
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
        return TrueTouch(*(getattr(found, part.name)[0] for part in fields(TrueTouch)))

    def distance_mm(self, place_mm: np.ndarray) -> float:
        """Distance of a point (3,) of the base frame from the surface, in the section through the object's origin; negative inside."""
        local = (place_mm - self.T_base_object[:3, 3]) @ self.T_base_object[:3, :3] * [1, 0, 1]
        return float(self._surface.field.distance(local[None])[0]) - self._surface.raised_mm

    def outline(self) -> np.ndarray:
        """The object's section through its origin (see ``Surface.outline``)."""
        return self._surface.outline


def path_around(placed: PlacedObject, start: np.ndarray, clear: np.ndarray) -> list[np.ndarray]:
    """Poses (6,) of the path from any pose (6,) around the object to one clear of it, which is the last.

    The path is straight if the dome stays outside a circle around the object's section. Otherwise the arm first leaves the circle if it is
    inside, and then takes the shorter way along it, with the sensor turned towards the object. The object is treated as infinitely high.
    Therefore the path avoids it at every height. The arm's links and the object's holder are not known and not considered.

    An infinite object (a plane, an edge) can't be passed. Only its surface is considered, and the path is straight.

    Raises
    ------
    DeviceError
        The straight path to an infinite object leads through it.
    """
    outline = placed.outline()
    if not np.allclose(outline[0], outline[-1]):
        _require_in_front(placed, start, clear)
        return [clear]
    surface = outline @ placed.T_base_object[:2, [0, 2]].T + placed.T_base_object[:2, 3]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    radius_mm = np.linalg.norm(surface - middle, axis=1).max() + placed.mounting.skin_reach_mm + MARGIN_MM
    domes = [matrix_of(pose)[:2, :3] @ placed.mounting.centre_mm + pose[:2] - middle for pose in (start, clear)]
    if distance_to_axis(*domes) >= min(radius_mm, np.linalg.norm(domes[1])):
        return [clear]
    angle, end = (np.arctan2(dome[1], dome[0]) for dome in domes)
    turn = (angle - end + np.pi) % (2 * np.pi) - np.pi  # from the clear pose back to the start's side
    outward_mm = max(0.0, radius_mm / np.cos(np.radians(STEP_DEG / 2)) - np.linalg.norm(domes[1]))
    way, last = [], start
    inside_mm = np.linalg.norm(domes[1]) + outward_mm - np.linalg.norm(domes[0])
    if inside_mm > 0:
        last = start.copy()
        last[:2] += inside_mm * np.array([np.cos(angle), np.sin(angle)])
        way.append(last)
    for at in np.linspace(turn, 0.0, int(np.ceil(abs(np.degrees(turn)) / STEP_DEG)) + 1):
        spun = _spun(matrix_of(clear), at, middle)
        spun[:2, 3] += outward_mm * np.array([np.cos(end + at), np.sin(end + at)])
        last = pose_of(spun, last)
        way.append(last)
    if outward_mm > 0:
        way.append(clear)
    return way


def _require_in_front(placed: PlacedObject, start: np.ndarray, clear: np.ndarray) -> None:
    """Raise ``DeviceError`` unless the dome's centre stays in front of the surface on its straight path. The path may begin in contact."""
    ends = [matrix_of(pose)[:3, :3] @ placed.mounting.centre_mm + pose[:3] for pose in (start, clear)]
    samples = max(2, int(np.ceil(np.linalg.norm(ends[1] - ends[0]) / SAMPLE_MM)))
    gap_mm = min(placed.distance_mm(ends[0] + share * (ends[1] - ends[0])) for share in np.linspace(0.0, 1.0, samples))
    if gap_mm < 0.0:
        way = f"the straight path to the {placed.spec.name} leads {-gap_mm:.0f} mm behind its surface, whose extent is not known"
        place = "correct the object's place ('placement' in the file for `servo`)"
        raise DeviceError(f"{way}; jog the arm to the side from which the sensor is to touch it, or {place}")


def _spun(T: np.ndarray, angle: float, middle: np.ndarray) -> np.ndarray:
    """A pose (4, 4) turned about the vertical through ``middle`` (2,)."""
    turn = matrix_of(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.degrees(angle)]))
    turn[:2, 3] = middle - turn[:2, :2] @ middle
    return turn @ T


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
        T = matrix_of(np.array([x, 0.0, z, 0.0, -np.degrees(angle), 0.0]))
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
