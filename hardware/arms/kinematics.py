"""Kinematics of arms, and checks of targets before anything is sent.

Poses are (6,): ``x, y, z, rx, ry, rz`` in mm and deg, static xyz Euler angles. Both Dobots carry their wrist on a parallel linkage: J2
and J3 are absolute angles of the two links, J2 from the vertical and J3 downwards from the horizontal. So

    rho = R0 + L1 sin J2 + L2 cos J3        z = Z0 + L1 cos J2 - L2 sin J3        R = J1 + J4 (not wrapped)
"""

from dataclasses import dataclass

import numpy as np

from hardware.errors import DeviceError
from scenes.files import quote

# Numbers of the Dobots' alarms that planning raises (see ``hardware.arms.dobot_alarms``).
NO_INVERSE, TARGET_LIMIT, LINE_LEAVES_WORKSPACE = 17, 18, 23
# Alarm of J1 above its range. The following numbers are J1 below, J2 above, ... up to 71.
FIRST_JOINT_ALARM = 64
LINKAGE_ABOVE, LINKAGE_BELOW = 72, 73
# Largest number that is believed in a pose or joint angle, mm or deg. No arm reaches ten metres, or turns a joint that far.
FARTHEST = 1e4
# Largest violation of a limit, deg, that is accepted, because the inverse kinematics has rounding errors.
LIMIT_TOLERANCE_DEG = 1e-6


@dataclass(frozen=True)
class Violation:
    """Why joints or a pose are not allowed. ``code`` is the number of the Dobots' alarm."""

    code: int
    text: str


class OutOfReachError(ValueError):
    """No joint angles reach the pose."""


@dataclass(frozen=True)
class LinkageKinematics:
    """An arm of four axes on a parallel linkage.

    Attributes
    ----------
    l1_mm, l2_mm : float
        Upper arm and forearm.
    r0_mm, z0_mm : float
        The part of the tool's reach and height that does not come from the two links.
    limits_deg : (4, 2) tuple
        Smallest and largest angle of each joint.
    linkage_deg : float or None
        Largest J3 - J2; None if no such limit is known.
    axes : int
        Number of joints.
    """

    l1_mm: float
    l2_mm: float
    r0_mm: float
    z0_mm: float
    limits_deg: tuple[tuple[float, float], ...]
    linkage_deg: float | None = None
    axes: int = 4

    def forward(self, joints_deg: np.ndarray) -> np.ndarray:
        """Pose (6,) at the joints (J,)."""
        j1, j2, j3, _ = np.radians(joints_deg)
        rho = self.r0_mm + self.l1_mm * np.sin(j2) + self.l2_mm * np.cos(j3)
        z = self.z0_mm + self.l1_mm * np.cos(j2) - self.l2_mm * np.sin(j3)
        return np.array([rho * np.cos(j1), rho * np.sin(j1), z, 0.0, 0.0, joints_deg[0] + joints_deg[3]])

    def inverse(self, pose: np.ndarray) -> np.ndarray:
        """Joints (J,) at the pose (6,); ``OutOfReachError`` where there are none."""
        x, y, z, _, _, turn = pose
        out, up = np.hypot(x, y) - self.r0_mm, z - self.z0_mm  # from the shoulder to the wrist
        span = np.hypot(out, up)
        if not abs(self.l1_mm - self.l2_mm) < span <= self.l1_mm + self.l2_mm:
            raise OutOfReachError(f"x {x:.1f}, y {y:.1f}, z {z:.1f} mm is out of reach (J1 to J3 have no solution)")
        from_vertical = np.arctan2(out, up)
        at_shoulder = np.arccos((self.l1_mm**2 + span**2 - self.l2_mm**2) / (2 * self.l1_mm * span))
        at_wrist = np.arccos((self.l2_mm**2 + span**2 - self.l1_mm**2) / (2 * self.l2_mm * span))
        j1 = np.degrees(np.arctan2(y, x))
        return np.array([j1, np.degrees(from_vertical - at_shoulder), np.degrees(from_vertical + at_wrist) - 90.0, turn - j1])

    def violation(self, joints_deg: np.ndarray) -> Violation | None:
        """The limit that the joints break, if any."""
        for n, (angle, (low, high)) in enumerate(zip(joints_deg, self.limits_deg, strict=True)):
            if not low - LIMIT_TOLERANCE_DEG <= angle <= high + LIMIT_TOLERANCE_DEG:
                code = FIRST_JOINT_ALARM + 2 * n + int(angle < low)
                return Violation(code, f"J{n + 1} at {angle:.2f} deg is outside [{low:g}, {high:g}] deg")
        apart = joints_deg[2] - joints_deg[1]
        if self.linkage_deg is not None and apart > self.linkage_deg + LIMIT_TOLERANCE_DEG:
            return Violation(LINKAGE_ABOVE, f"J3 - J2 = {apart:.2f} deg is more than the linkage's {self.linkage_deg:g} deg")
        return None

    def nearest_pose(self, pose: np.ndarray) -> np.ndarray:
        """The pose with ``rx = ry = 0`` and R changed by full turns, so that J4 is as close as possible to the middle of its range."""
        x, y, z, _, _, turn = np.asarray(pose, float)
        j1 = np.degrees(np.arctan2(y, x))
        return np.array([x, y, z, 0.0, 0.0, turn - 360.0 * np.round((turn - j1) / 360.0)])


_MG400_LIMITS_DEG = ((-160.0, 160.0), (-25.0, 85.0), (-25.0, 105.0), (-180.0, 180.0))
# The manual does not give the linkage's limit. A real arm raised an alarm at exactly 60 deg.
MG400 = LinkageKinematics(174.207, 175.070, 109.500, -53.000, _MG400_LIMITS_DEG, 60.0)  # fitted to ten joint/pose pairs of a real arm
_MAGICIAN_LIMITS_DEG = ((-125.0, 125.0), (-5.0, 90.0), (-15.0, 70.0), (-150.0, 150.0))  # as public clients of the Magician use them
MAGICIAN = LinkageKinematics(135.0, 147.0, 0.0, 0.0, _MAGICIAN_LIMITS_DEG)


@dataclass(frozen=True)
class StageKinematics:
    """An ideal stage of six axes: its "joints" are the pose, three in mm and three in deg."""

    axes: int = 6

    def forward(self, joints_deg: np.ndarray) -> np.ndarray:
        return np.array(joints_deg, float)

    def inverse(self, pose: np.ndarray) -> np.ndarray:
        return np.array(pose, float)

    def violation(self, joints_deg: np.ndarray) -> Violation | None:
        return None

    def nearest_pose(self, pose: np.ndarray) -> np.ndarray:
        return np.array(pose, float)


# From joints to pose and back, and the limits of the joints.
Kinematics = LinkageKinematics | StageKinematics


def finite_numbers(what: str, given: np.ndarray, count: int) -> np.ndarray:
    """The target of a move (count,), whatever a caller gave for it.

    Raises
    ------
    DeviceError
        It is not so many finite numbers, or one is beyond what any arm reaches. The message begins with ``what``.
    """
    try:
        numbers = np.asanyarray(given)
    except (TypeError, ValueError):  # rows of different lengths
        numbers = np.array("")
    numbers = np.ma.filled(numbers.astype(float), np.nan) if numbers.dtype.kind in "iuf" else np.array(np.nan)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise DeviceError(f"{what} must be {count} finite numbers (mm, deg), not {quote(repr(given))}")
    if not (np.abs(numbers) < FARTHEST).all():
        raise DeviceError(f"{what} {quote(repr(given))} is farther than any arm reaches; give mm and deg")
    return numbers
