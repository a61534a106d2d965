"""Where the object goes: a path of poses through which it is moved."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.sensor import GeometrySpec
from twin.errors import ContactError
from twin.geometry.shapes import shape_of
from twin.objects import ObjectField
from twin.types import FloatArray

_LARGEST_TILT_DEG = 60.0
"""Largest tilt of a contact pose about each axis: the dome reaches no further."""
_LARGEST_TWIST_DEG = 90.0
"""Largest twist of a contact pose: a quarter turn."""
_TOUCH_TOLERANCE_MM = 1e-6
"""The object is at first touch when its distance to the dome is at most this."""
_SKIN_POINTS = 20_000
"""Points on a whole sphere at which the distance of the object is looked for: 0.5 mm apart on a dome of 20 mm."""
_NEAR_POINTS = 2000
"""Points around the nearest of them, 30 times finer, for the second search."""
_START_MM = 60.0
"""Height above the apex from which the object comes down."""
_MOST_DESCENTS = 400
"""Most steps in which the object is brought down."""


@dataclass(frozen=True)
class ContactPose:
    """One contact, as the object's motion relative to the sensor.

    The object, its origin on the apex and its axes parallel to the sensor's, is turned by
    R = Ry(tilt_y) Rx(tilt_x) about the apex (right-handed, sensor axes), moved sideways by
    ``offset_mm``, brought down the sensor's z to first touch, pressed ``indent_mm`` further,
    then moved by ``shear_mm`` along x, y while it twists about the sensor's z axis.

    Attributes
    ----------
    indent_mm : float
        Beyond first touch; zero or less: no contact.
    tilt_deg, shear_mm, offset_mm : (2,) float
        About / along the sensor's x and y.
    twist_deg : float
        About the sensor's z.
    """

    indent_mm: float
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    shear_mm: tuple[float, float] = (0.0, 0.0)
    twist_deg: float = 0.0
    offset_mm: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class ContactPath:
    """Poses through which an object is moved: approach, tap, shear, twist, slide, hold, retract, in any order.

    Between two poses the object's origin moves on a straight line while it turns about a fixed axis (slerp).
    The first pose must be free of contact or a first touch.

    Attributes
    ----------
    poses : (k, 4, 4) float
        ``T_sensor_object``, k >= 2.
    times_s : (k,) float, optional
        When each is reached, rising; only a viscoelastic sensor cares. Two equal poses hold the object still.
        Default: one second each.
    """

    poses: FloatArray
    times_s: FloatArray | None = None

    def __post_init__(self) -> None:
        poses = np.asarray(self.poses, float)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) < 2 or not np.isfinite(poses).all():
            raise ContactError(f"a path needs at least two finite 4x4 poses, got an array of shape {poses.shape}")
        turn = poses[:, :3, :3]
        if np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max() > 1e-6 or (np.linalg.det(turn) < 0).any():
            raise ContactError("a pose of the path is not a rigid motion; give rotations in its upper left 3x3")
        times = np.arange(len(poses), dtype=float) if self.times_s is None else np.asarray(self.times_s, float)
        if times.shape != (len(poses),) or not (np.diff(times) > 0).all():
            raise ContactError(f"times_s must rise, one for each of the {len(poses)} poses, got {times}")
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "times_s", times)

    @property
    def _clock(self) -> FloatArray:
        """``times_s``, which is there once the path is made."""
        assert self.times_s is not None
        return self.times_s

    def at(self, progress: float) -> FloatArray:
        """``T_sensor_object`` (4, 4) at a progress from 0 (first pose) to k - 1 (last)."""
        leg = int(np.clip(np.floor(progress), 0, len(self.poses) - 2))
        share = progress - leg
        start, stop = self.poses[leg], self.poses[leg + 1]
        angle, once, twice = self._turns[leg]
        T = np.eye(4)
        T[:3, :3] = start[:3, :3] + (np.sin(share * angle) * once + (1 - np.cos(share * angle)) * twice) @ start[:3, :3]
        T[:3, 3] = (1 - share) * start[:3, 3] + share * stop[:3, 3]
        return T

    @cached_property
    def _turns(self) -> list[tuple[float, FloatArray, FloatArray]]:
        """Angle of each leg's turn, the cross product with its axis as a matrix (3, 3), and that matrix' square (Rodrigues' formula)."""
        out = []
        for way in Rotation.from_matrix(self.poses[1:, :3, :3] @ self.poses[:-1, :3, :3].transpose(0, 2, 1)).as_rotvec():
            angle = float(np.linalg.norm(way))
            x, y, z = way / max(angle, 1e-300)
            once = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            out.append((angle, once, once @ once))
        return out

    def time_s(self, progress: float) -> float:
        """Time at a progress."""
        return float(np.interp(progress, np.arange(len(self.poses)), self._clock))

    def there_and_back(self) -> "ContactPath":
        """The path, then the same way back."""
        clock = self._clock
        span = clock[-1] - clock[::-1]
        return ContactPath(np.concatenate([self.poses, self.poses[-2::-1]]), np.concatenate([clock, clock[-1] + span[1:]]))


def carried(points_mm: FloatArray, start: FloatArray, stop: FloatArray) -> FloatArray:
    """How far points (k, 3) move with an object that goes from one pose (4, 4) to another."""
    return (points_mm - start[:3, 3]) @ start[:3, :3] @ stop[:3, :3].T + stop[:3, 3] - points_mm


def deepest_mm(geometry: GeometrySpec) -> float:
    """Half the gel's depth: no contact goes deeper."""
    return 0.5 * (geometry.skin.apex_mm - geometry.skin.thickness_mm - geometry.lens.z_mm)


def plan_path(geometry: GeometrySpec, field: ObjectField, pose: ContactPose) -> ContactPath:
    """Check a pose and find its first touch with the undeformed skin: poses at touch, pressed, and (if it moves further) sheared.

    The object comes down along z by its smallest distance to the dome, again and again. Where distances are exact this
    never passes the first touch (sphere tracing, Hart 1996). The dome is sampled evenly at first, then finely around the nearest
    point.

    Raises
    ------
    ContactError
        If a value is out of range, or the object misses the skin or starts inside it.
    """
    _check(geometry, pose)
    rx, ry = np.radians(pose.tilt_deg)
    turn_x = np.array([[1, 0, 0], [0, np.cos(rx), -np.sin(rx)], [0, np.sin(rx), np.cos(rx)]])
    turn_y = np.array([[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]])
    skin, shape = geometry.skin, shape_of(geometry.skin)
    T = np.eye(4)
    T[:3, :3] = turn_y @ turn_x
    T[:3, 3] = [*pose.offset_mm, skin.apex_mm]
    size_mm = max(skin.half_size_mm)
    places = shape.even(_SKIN_POINTS)
    height, nearest = _bring_down(field, T, shape.outside(places), _START_MM, size_mm)
    # around the nearest point the sampling is refined 30 times
    spread = 3 / np.sqrt(_SKIN_POINTS)
    near = shape.outside(shape.near(complex(places[nearest]), spread, _NEAR_POINTS))
    height, _ = _bring_down(field, T, near, height + spread * size_mm, size_mm)
    T[2, 3] += height
    pressed = T.copy()
    pressed[2, 3] -= max(pose.indent_mm, 0.0)
    poses = [T, pressed]
    if any(pose.shear_mm) or pose.twist_deg:
        move = np.eye(4)
        angle = np.radians(pose.twist_deg)
        move[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        move[:2, 3] = pose.shear_mm
        poses.append(move @ pressed)
    return ContactPath(np.stack(poses))


def _check(geometry: GeometrySpec, pose: ContactPose) -> None:
    values = np.concatenate([[pose.indent_mm, pose.twist_deg], pose.tilt_deg, pose.shear_mm, pose.offset_mm])
    if values.shape != (8,) or not np.isfinite(values).all():
        raise ContactError(f"a contact pose needs finite numbers, got {values}; give numbers in mm and deg")
    size = max(geometry.skin.half_size_mm)
    limits = [
        ("indent_mm", pose.indent_mm, deepest_mm(geometry), "half the gel's depth"),
        ("tilt_deg", max(map(abs, pose.tilt_deg)), _LARGEST_TILT_DEG, "the dome's reach"),
        ("shear_mm", float(np.hypot(*pose.shear_mm)), size / 2, "half the skin's radius"),
        ("twist_deg", abs(pose.twist_deg), _LARGEST_TWIST_DEG, "a quarter turn"),
        ("offset_mm", max(map(abs, pose.offset_mm)), 50 * size, "fifty radii"),
    ]
    for name, value, limit, reason in limits:
        if value > limit:
            raise ContactError(f"{name}: {value:g} is more than {limit:g} ({reason}); give a smaller value")


def _bring_down(field: ObjectField, T: FloatArray, points_mm: FloatArray, height_mm: float, depth_mm: float) -> tuple[float, int]:
    """Height above ``T`` (mm) where the object just touches the points, and the index of the touched one."""
    turn, shift = T[:3, :3], T[:3, 3]
    free_mm = None
    for _ in range(_MOST_DESCENTS):
        distance = field.distance((points_mm - shift - [0, 0, height_mm]) @ turn)
        nearest = int(distance.argmin())
        if abs(distance[nearest]) <= _TOUCH_TOLERANCE_MM:
            return height_mm, nearest
        if distance[nearest] > 0:
            free_mm = height_mm
            height_mm -= distance[nearest]
        elif free_mm is None:
            raise ContactError("the object is in the skin's way before it comes down; use a smaller tilt or another offset")
        else:  # the distance was too large, as it can be near wires and far from a mesh: go back half the way
            height_mm = (height_mm + free_mm) / 2
        if height_mm < -depth_mm:
            break
    raise ContactError("the object misses the skin; use a smaller offset or tilt")
