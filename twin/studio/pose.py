"""Pose of the object relative to the sensor, as six numbers that a user can type."""

from dataclasses import asdict, dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from twin.errors import ContactError
from twin.mechanics.path import carry_points
from twin.rig.arm_pose import matrix_of
from twin.types import FloatArray

LIMITS: dict[str, tuple[float, float, str]] = {
    "x_mm": (-20.0, 20.0, "farther from the axis the object does not reach the dome"),
    "y_mm": (-20.0, 20.0, "farther from the axis the object does not reach the dome"),
    "depth_mm": (-10.0, 20.0, "the object's place below the tip at rest, positive where it presses"),
    "tilt_x_deg": (-60.0, 60.0, "the dome does not reach farther"),
    "tilt_y_deg": (-60.0, 60.0, "the dome does not reach farther"),
    "twist_deg": (-90.0, 90.0, "a quarter turn"),
}
"""Lowest and highest value of each number, and the reason for the limits."""
STRAIGHT_POINTS_MM = 8.0 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
"""Points (5, 3) of the object frame at which two motions are compared. Their distances are about the width of a contact."""


@dataclass(frozen=True)
class ObjectPose:
    """The object's pose relative to the sensor.

    The object's origin (the point that touches first if the sensor approaches straight) is at ``x_mm``, ``y_mm`` and ``depth_mm`` below the
    dome's tip, so that positive depths press. The object is turned about the sensor's x by ``tilt_x_deg``, then about its y by
    ``tilt_y_deg``, then about its z by ``twist_deg`` (right-handed).
    """

    x_mm: float = 0.0
    y_mm: float = 0.0
    depth_mm: float = -2.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    twist_deg: float = 0.0

    def matrix(self, apex_mm: float) -> FloatArray:
        """``T_sensor_object`` (4, 4) for a skin whose apex is at the height ``apex_mm``."""
        return matrix_of(np.array([self.x_mm, self.y_mm, apex_mm - self.depth_mm, self.tilt_x_deg, self.tilt_y_deg, self.twist_deg]))

    @classmethod
    def of(cls, T: FloatArray, apex_mm: float) -> "ObjectPose":
        """The numbers of a pose ``T_sensor_object`` (4, 4)."""
        tilt_x, tilt_y, twist = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
        return cls(*map(float, (T[0, 3], T[1, 3], apex_mm - T[2, 3], tilt_x, tilt_y, twist)))

    def within_limits(self) -> tuple["ObjectPose", str]:
        """The nearest pose whose numbers are within ``LIMITS``, and why it differs ("" if it does not).

        Raises
        ------
        ContactError
            A number is not finite.
        """
        reasons, kept = [], {}
        for name, value in asdict(self).items():
            low, high, why = LIMITS[name]
            if not np.isfinite(value):
                raise ContactError(f"{name}: {value} is not a finite number; give one between {low:g} and {high:g}")
            kept[name] = min(max(value, low), high)
            if kept[name] != value:
                reasons.append(f"{readable_name(name)} is limited to {kept[name]:g} {unit_of(name)}: {why}")
        return ObjectPose(**kept), "; ".join(reasons)


@dataclass(frozen=True)
class PressedPose(ObjectPose):
    """A pose with the depth of the rigid object inside the undeformed dome, as a saved contact stores it."""

    indent_mm: float = 0.0


NAMES = tuple(field.name for field in fields(ObjectPose))
"""Names of the six numbers, in their order."""


def readable_name(name: str) -> str:
    """A number's readable name: ``tilt_x_deg`` gives 'tilt x'."""
    return name.rpartition("_")[0].replace("_", " ")


def unit_of(name: str) -> str:
    """A number's unit, which is the end of its name."""
    return name.rpartition("_")[2]


def bend_mm(way: list[FloatArray]) -> float:
    """Largest distance of the poses (4, 4) of a path from the straight motion between its ends, at ``STRAIGHT_POINTS_MM``."""
    points = np.array([STRAIGHT_POINTS_MM @ T[:3, :3].T + T[:3, 3] for T in way])
    off, along = points[1:-1] - points[0], points[-1] - points[0]
    length2 = np.maximum((along**2).sum(axis=1, keepdims=True), 1e-12)
    share = np.clip((off * along).sum(axis=2, keepdims=True) / length2, 0, 1)
    return float(np.linalg.norm(off - share * along, axis=2).max(initial=0.0))


def motion_mm(places_mm: FloatArray, start: FloatArray, stop: FloatArray) -> float:
    """Largest displacement of points (k, 3) that move with an object from one pose (4, 4) to another; 0 for no points."""
    return float(np.linalg.norm(carry_points(places_mm, start, stop), axis=1).max(initial=0.0))
