"""Paths of the object: the poses through which it moves relative to the sensor."""

from collections.abc import Callable
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
"""Largest tilt of a contact pose about each axis. The dome does not extend further."""
_LARGEST_TWIST_DEG = 90.0
"""Largest twist of a contact pose: a quarter turn."""
TOUCH_TOLERANCE_MM = 1e-6
"""Tolerance of the first touch: largest distance between object and dome."""
SKIN_POINTS = 20_000
"""Number of points on a whole sphere for the first search of the nearest point: they are 0.5 mm apart on a dome of 20 mm."""
_NEAR_POINTS = 2000
"""Number of points for the second search, around the nearest point of the first search, with a 30 times smaller distance."""
_START_MM = 60.0
"""Height above the apex from which the object is lowered."""
_MOST_MARCHES = 400
"""Largest number of steps in which the object is moved to its first touch; about ten are usual."""


@dataclass(frozen=True)
class ContactPose:
    """One contact, as the object's motion relative to the sensor.

    At first the object's origin is at the apex and its axes are parallel to the sensor's. The object is then

    1. rotated by R = Ry(tilt_y) Rx(tilt_x) about the apex (right-handed, sensor axes) and moved sideways by ``offset_mm``,
    2. lowered along the sensor's z to its first touch,
    3. pressed further by ``indent_mm``,
    4. moved by ``shear_mm`` along x and y, while it rotates by ``twist_deg`` about the sensor's z axis.

    Attributes
    ----------
    indent_mm : float
        Indentation from the first touch on. Zero or less means no contact.
    tilt_deg, shear_mm, offset_mm : (2,) float
        Tilt about the sensor's x and y; shear and offset along x and y.
    twist_deg : float
        Rotation about the sensor's z.

    Raises
    ------
    ContactError
        An attribute is no number, or no pair of numbers.
    """

    indent_mm: float
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    shear_mm: tuple[float, float] = (0.0, 0.0)
    twist_deg: float = 0.0
    offset_mm: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            shape, expected = ((), "a number") if name in ("indent_mm", "twist_deg") else ((2,), "two numbers")
            if np.shape(value) != shape or np.asarray(value).dtype.kind not in "iuf":
                raise ContactError(f"`{name}`: expected {expected}, got {value!r}")
            if shape and not isinstance(value, tuple):
                object.__setattr__(self, name, tuple(map(float, value)))


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
        Time at which each pose is reached, in rising order. It matters for viscoelastic sensors only. Between two equal poses the object
        stands still. Default: one second from pose to pose.

    Raises
    ------
    ContactError
        There are fewer than two poses, a pose is not finite or no rigid motion, or the times do not rise.
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
        """``times_s``, which is never None after ``__post_init__``."""
        assert self.times_s is not None
        return self.times_s

    def at(self, progress: float) -> FloatArray:
        """``T_sensor_object`` (4, 4) at a progress from 0 (first pose) to k - 1 (last)."""
        leg = int(np.clip(np.floor(progress), 0, len(self.poses) - 2))
        share = progress - leg
        start, stop = self.poses[leg], self.poses[leg + 1]
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(share * self._turns[leg]).as_matrix() @ start[:3, :3]
        T[:3, 3] = (1 - share) * start[:3, 3] + share * stop[:3, 3]
        return T

    @cached_property
    def _turns(self) -> FloatArray:
        """Rotation vectors (k - 1, 3) of the legs."""
        return Rotation.from_matrix(self.poses[1:, :3, :3] @ self.poses[:-1, :3, :3].transpose(0, 2, 1)).as_rotvec()

    def time_s(self, progress: float) -> float:
        """Time (s) at a progress from 0 to k - 1."""
        return float(np.interp(progress, np.arange(len(self.poses)), self._clock))

    def there_and_back(self) -> "ContactPath":
        """The path, followed by the same path in the opposite direction."""
        clock = self._clock
        span = clock[-1] - clock[::-1]
        return ContactPath(np.concatenate([self.poses, self.poses[-2::-1]]), np.concatenate([clock, clock[-1] + span[1:]]))


def carry_points(points_mm: FloatArray, start: FloatArray, stop: FloatArray) -> FloatArray:
    """Displacements (k, 3) of points (k, 3) that move with an object from the pose ``start`` (4, 4) to the pose ``stop`` (4, 4)."""
    return (points_mm - start[:3, 3]) @ start[:3, :3] @ stop[:3, :3].T + stop[:3, 3] - points_mm


def deepest_mm(geometry: GeometrySpec) -> float:
    """Largest permitted indentation: half the gel's depth."""
    return 0.5 * (geometry.skin.apex_mm - geometry.skin.thickness_mm - geometry.lens.z_mm)


def plan_path(geometry: GeometrySpec, field: ObjectField, pose: ContactPose) -> ContactPath:
    """Path of a contact pose: the poses at first touch, at full indentation, and (with shear or twist) after the shear.

    To find the first touch with the undeformed skin, the object is lowered along z. The points on the dome are evenly distributed in the
    first search, and densely around the nearest point in the second.

    Raises
    ------
    ContactError
        If a value is out of range, or the object misses the skin or starts inside it.
    """
    _check(geometry, pose)
    skin, shape = geometry.skin, shape_of(geometry.skin)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xy", pose.tilt_deg, degrees=True).as_matrix()
    T[:3, 3] = [*pose.offset_mm, skin.apex_mm]
    size_mm = max(skin.half_size_mm)

    def lower(points_mm: FloatArray, height_mm: float) -> tuple[float, int]:
        """Height above ``T`` at which the object just touches the points, and the index of the touched point."""

        def gaps_at(depth_mm: float) -> FloatArray:
            return field.distance((points_mm - T[:3, 3] + [0, 0, depth_mm]) @ T[:3, :3])

        too_late = "the object is in the skin's way before it comes down; use a smaller tilt or another offset"
        depth_mm, nearest = march_to_touch(gaps_at, -height_mm, size_mm, too_late)
        if nearest is None:
            raise ContactError("the object misses the skin; use a smaller offset or tilt")
        return -depth_mm, nearest

    places = shape.even(SKIN_POINTS)
    height, nearest = lower(shape.outside(places), _START_MM)
    spread = 3 / np.sqrt(SKIN_POINTS)
    height, _ = lower(shape.outside(shape.near(complex(places[nearest]), spread, _NEAR_POINTS)), height + spread * size_mm)
    T[2, 3] += height
    pressed = T.copy()
    pressed[2, 3] -= max(pose.indent_mm, 0.0)
    poses = [T, pressed]
    if any(pose.shear_mm) or pose.twist_deg:
        move = np.eye(4)
        move[:3, :3] = Rotation.from_euler("z", pose.twist_deg, degrees=True).as_matrix()
        move[:2, 3] = pose.shear_mm
        poses.append(move @ pressed)
    return ContactPath(np.stack(poses))


def _check(geometry: GeometrySpec, pose: ContactPose) -> None:
    values = np.concatenate([[pose.indent_mm, pose.twist_deg], pose.tilt_deg, pose.shear_mm, pose.offset_mm])
    if not np.isfinite(values).all():
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


def march_to_touch(
    gaps_at: Callable[[float], FloatArray], at: float, stop: float, too_late: str, *, unit_mm: float = 1.0
) -> tuple[float, int | None]:
    """Move an object from ``at`` up to ``stop`` to its first touch, by its smallest gap to the skin again and again.

    If distances are exact, it never passes the first touch (sphere tracing, Hart 1996).

    Parameters
    ----------
    gaps_at : callable
        Function that returns the gaps (k,) in mm of points of the skin with the object at a place of its way.
    too_late : str
        Message of the ContactError for an object that begins inside the skin.
    unit_mm : float
        Length of the unit of ``at`` and ``stop``.

    Returns
    -------
    at : float
        Place of the first touch. It is beyond ``stop`` if there is none, and the last place without contact if the search does not end.
    nearest : int or None
        Index of the touched point.
    """
    free: float | None = None  # the last place without contact
    for _ in range(_MOST_MARCHES):
        gaps = gaps_at(at)
        nearest = int(gaps.argmin())
        if abs(gaps[nearest]) <= TOUCH_TOLERANCE_MM:
            return at, nearest
        if gaps[nearest] > 0:
            free = at
            at += gaps[nearest] / unit_mm
        elif free is None:
            raise ContactError(too_late)
        else:  # the distance was too large, which happens near wires and far from a mesh: go back half of the step
            at = (at + free) / 2
        if at > stop:
            return at, None
    return free or 0.0, None
