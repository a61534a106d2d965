"""Kinematics of arms, the Dobots' alarms, checks of targets before anything is sent, and the motion of a simulated or emulated arm.

Poses are (6,): ``x, y, z, rx, ry, rz`` in mm and deg, static xyz Euler angles. Both Dobots carry their wrist on a parallel linkage: J2
and J3 are absolute angles of the two links, J2 from the vertical and J3 downwards from the horizontal. So

    rho = R0 + L1 sin J2 + L2 cos J3        z = Z0 + L1 cos J2 - L2 sin J3        R = J1 + J4 (not wrapped)

A motion is a sequence of moves, each with a trapezoidal or constant speed.
"""

from collections import deque
from dataclasses import dataclass, replace
from threading import Lock

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from hardware.errors import DeviceError
from scenes.files import quote

# Numbers of the alarms that planning raises.
NO_INVERSE, TARGET_LIMIT, LINE_LEAVES_WORKSPACE = 17, 18, 23
# That of J1 above its range. The following numbers are J1 below, J2 above, ... up to 71.
FIRST_JOINT_ALARM = 64
LINKAGE_ABOVE, LINKAGE_BELOW = 72, 73
# Largest number that is believed in a pose or joint angle, mm or deg. No arm reaches ten metres, or turns a joint that far.
FARTHEST = 1e4
# Largest violation of a limit, deg, that is accepted, because the inverse kinematics has rounding errors.
LIMIT_TOLERANCE_DEG = 1e-6
_JOINT_ENDS = [f"J{joint} is {side} its range" for joint in (1, 2, 3, 4) for side in ("above", "below")]
# Meanings and remedies of the alarms. The MG400 and the Magician use the same numbers.
ALARMS = {
    -2: "collision",
    1: "a command was not understood",
    16: "the target is at a singularity",
    NO_INVERSE: "no joint angles reach the target",
    TARGET_LIMIT: "the target is beyond a joint's range",
    20: "the places of an arc lie on one line",
    LINE_LEAVES_WORKSPACE: "the line to the target leaves the workspace",
    **dict(enumerate(_JOINT_ENDS, start=FIRST_JOINT_ALARM)),
    LINKAGE_ABOVE: "the parallelogram is at its end (J3 - J2 too large)",
    LINKAGE_BELOW: "the parallelogram is at its end (J3 - J2 too small)",
    **{79 + joint: f"J{joint} lost steps" for joint in (1, 2, 3, 4)},
    85: "the emergency stop is or was pressed",
    112: "collision",
}
_REMEDIES = {
    **dict.fromkeys(range(80, 84), "free the arm and home it"),
    -2: "free the arm by hand",
    85: "release the emergency stop",
    112: "free the arm by hand",
}


def explain(alarms: list[int]) -> str:
    """One line on the given alarms, with the remedy."""
    if not alarms:
        return "alarm (the arm does not report which); call clear_error(), then enable()"
    said = "; ".join(dict.fromkeys(f"alarm {alarm}: {ALARMS.get(alarm, 'see the vendor manual')}" for alarm in alarms))
    first = next((_REMEDIES[alarm] for alarm in alarms if alarm in _REMEDIES), "move away from the limit")
    return f"{said}; {first}, then call clear_error() and enable()"


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


class StageKinematics:
    """An ideal stage of six axes: its "joints" are the pose, three in mm and three in deg."""

    axes = 6

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


LINE_STEP_MM = 5.0  # distance between the places of a line at which limits are checked
# Largest distance in mm between a circle and the lines that approximate it, and largest number of lines. A Magician queues 32.
CIRCLE_MM, CIRCLE_LINES = 0.02, 30
# Sine of the angle between places below which they lie on one line.
STRAIGHT = 1e-6
HISTORY_N = 512  # number of moves that are kept, so that a camera can ask for past poses


@dataclass(frozen=True)
class Speeds:
    """Speed and acceleration along a line (mm) and of turns and joints (deg). Infinite acceleration means constant speed."""

    linear_mm_s: float
    angular_deg_s: float
    linear_mm_s2: float = np.inf
    angular_deg_s2: float = np.inf

    def scale_time(self, factor: float) -> "Speeds":
        """The same motion in ``1 / factor`` of the time."""
        return Speeds(
            self.linear_mm_s * factor, self.angular_deg_s * factor, self.linear_mm_s2 * factor**2, self.angular_deg_s2 * factor**2
        )


def travel_time_s(length: float, speed: float, acceleration: float) -> float:
    """Time to go ``length`` from rest to rest."""
    if length <= 0:
        return 0.0
    if np.isinf(speed) or length * acceleration < speed**2:  # never reaches full speed
        return 2.0 * np.sqrt(length / acceleration)
    return length / speed + speed / acceleration


def travelled_share(fraction: float, ramp: float) -> float:
    """Share of the path after a share of the time. Acceleration and braking each take the share ``ramp`` of the time."""
    t = min(max(fraction, 0.0), 1.0)
    if ramp > 0:
        if t < ramp:
            return t**2 / (2 * ramp * (1 - ramp))
        if t > 1 - ramp:
            return 1 - (1 - t) ** 2 / (2 * ramp * (1 - ramp))
    return (t - ramp / 2) / (1 - ramp)


@dataclass(frozen=True)
class Piece:
    """One move: from pose to pose in a straight line, or from joints to joints.

    ``cut_s`` is the time at which a stop ended it (inf: it was not stopped).
    """

    kinematics: Kinematics
    start: np.ndarray  # pose (6,) if linear, else joints (J,)
    end: np.ndarray
    linear: bool
    start_s: float
    duration_s: float
    ramp: float
    cut_s: float = np.inf

    @property
    def end_s(self) -> float:
        return min(self.start_s + self.duration_s, max(self.cut_s, self.start_s))

    def pose(self, time_s: float) -> np.ndarray:
        value = self._value(time_s)
        return value if self.linear else self.kinematics.forward(value)

    def joints_deg(self, time_s: float) -> np.ndarray:
        """Joints (J,) at a time."""
        value = self._value(time_s)
        return self.kinematics.inverse(value) if self.linear else value

    def _value(self, time_s: float) -> np.ndarray:
        elapsed = min(time_s, self.cut_s) - self.start_s
        share = travelled_share(elapsed / self.duration_s if self.duration_s > 0 else 1.0, self.ramp)
        return between(self.kinematics, self.start, self.end, share, self.linear)


def between(kinematics: Kinematics, start: np.ndarray, end: np.ndarray, share: float, linear: bool) -> np.ndarray:
    """The pose or joints at a share of the path; at 0 and 1 exactly the ends.

    An arm of six axes turns the shorter way. An arm of four axes turns by the difference of R, which is not wrapped.
    """
    if share <= 0 or share >= 1:
        return (start if share <= 0 else end).copy()
    value = start + share * (end - start)
    if linear and kinematics.axes == 6:
        turns = Rotation.from_euler("xyz", [start[3:], end[3:]], degrees=True)
        value[3:] = Slerp([0.0, 1.0], turns)(share).as_euler("xyz", degrees=True)
    return value


def check_line(kinematics: Kinematics, start: np.ndarray, end: np.ndarray) -> Violation | None:
    """The first limit that a straight move would violate: its end is checked first, then its path."""
    steps = max(1, int(np.ceil(np.linalg.norm(end[:3] - start[:3]) / LINE_STEP_MM)))
    for n in range(steps):  # the first one is the end
        try:
            broken = kinematics.violation(kinematics.inverse(between(kinematics, start, end, n / steps if n else 1.0, True)))
        except OutOfReachError as error:
            broken = Violation(NO_INVERSE, str(error))
        if broken and n:
            return Violation(LINE_LEAVES_WORKSPACE, f"the line to it leaves the workspace: {broken.text}")
        if broken:
            return broken if broken.code == NO_INVERSE else Violation(TARGET_LIMIT, broken.text)
    return None


class MotionTrack:
    """Past, present and planned poses of an arm. It can be used from several threads.

    Parameters
    ----------
    kinematics : Kinematics
    joints_deg : (J,) float
        Joints at the start.
    """

    def __init__(self, kinematics: Kinematics, joints_deg: np.ndarray) -> None:
        self.kinematics = kinematics
        self._lock = Lock()
        rest = Piece(kinematics, np.asarray(joints_deg, float), np.asarray(joints_deg, float), False, -np.inf, 0.0, 0.0)
        self._pieces: deque[Piece] = deque([rest], maxlen=HISTORY_N)

    @property
    def end_s(self) -> float:
        """Time at which the last piece ends (-inf if there was none)."""
        return self._pieces[-1].end_s

    def pose(self, time_s: float) -> np.ndarray:
        return self._at(time_s).pose(time_s)

    def joints_deg(self, time_s: float) -> np.ndarray:
        """Joints (J,) at a time."""
        return self._at(time_s).joints_deg(time_s)

    def moving(self, time_s: float) -> bool:
        """Whether a piece is in progress at that time."""
        return bool(self.end_s > time_s)

    def target(self) -> Piece:
        """The last piece."""
        return self._pieces[-1]

    def move(self, end: np.ndarray, speeds: Speeds, *, linear: bool, now_s: float) -> Piece | Violation:
        """Append a move to a pose (linear) or to joints; it begins when the last one ends. A violation changes nothing."""
        with self._lock:
            last = self._pieces[-1]
            begins_s = max(now_s, last.end_s)
            start = last.pose(begins_s) if linear else last.joints_deg(begins_s)
            end = np.asarray(end, float)
            broken = check_line(self.kinematics, start, end) if linear else self.kinematics.violation(end)
            if broken:
                return broken
            rates = (speeds.linear_mm_s, speeds.linear_mm_s2), (speeds.angular_deg_s, speeds.angular_deg_s2)
            lengths = way_between(start, end, self.kinematics.axes) if linear else (0.0, float(np.abs(end - start).max()))
            times = [travel_time_s(length, *rate) for length, rate in zip(lengths, rates, strict=True)]
            slowest = int(np.argmax(times))
            speed, acceleration = rates[slowest]
            ramp = min(0.5, speed / acceleration / times[slowest]) if times[slowest] > 0 else 0.0
            self._pieces.append(Piece(self.kinematics, start, end, linear, begins_s, times[slowest], ramp))
            return self._pieces[-1]

    def dwell(self, duration_s: float, *, now_s: float) -> Piece:
        """Append a time in which the arm rests at the end of the last piece."""
        with self._lock:
            begins_s = max(now_s, self.end_s)
            joints = self._pieces[-1].joints_deg(begins_s)
            self._pieces.append(Piece(self.kinematics, joints, joints, False, begins_s, duration_s, 0.0))
            return self._pieces[-1]

    def stop(self, now_s: float) -> None:
        """Stand still from ``now_s`` on, and drop the remaining motion."""
        with self._lock:
            kept = [piece for piece in self._pieces if piece.start_s < now_s] or [self._pieces[0]]
            if kept[-1].end_s > now_s:
                kept[-1] = replace(kept[-1], cut_s=now_s)
            self._pieces = deque(kept, maxlen=HISTORY_N)

    def _at(self, time_s: float) -> Piece:
        with self._lock:
            return next((piece for piece in reversed(self._pieces) if piece.start_s <= time_s), self._pieces[0])


def way_between(start: np.ndarray, end: np.ndarray, axes: int) -> tuple[float, float]:
    """Length, mm, and turn, deg, of a straight move between two poses (6,). R of an arm of four axes is not wrapped."""
    turn_deg = float(abs(end[5] - start[5])) if axes == 4 else turn_between_deg(start, end)
    return float(np.linalg.norm(end[:3] - start[:3])), turn_deg


def turn_between_deg(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between the orientations of two poses (6,)."""
    first, second = Rotation.from_euler("xyz", [a[3:], b[3:]], degrees=True)
    return float(np.degrees((first.inv() * second).magnitude()))


def circle(start: np.ndarray, via: np.ndarray, end: np.ndarray, *, whole: bool = False) -> list[np.ndarray]:
    """Poses (6,) of short lines along the circle through the places of three poses (6,).

    They turn evenly from pose to pose, and the last one is ``end``. A ``whole`` circle comes back to ``start`` and does not turn. Places on
    one straight line give the two lines between them.
    """
    a, ab, ac = start[:3], via[:3] - start[:3], end[:3] - start[:3]
    normal = np.cross(ab, ac)
    if np.linalg.norm(normal) < STRAIGHT * max(float(ab @ ab), float(ac @ ac), STRAIGHT):
        return [via, end]
    middle = a + np.cross(normal, ab) * (ac @ ac) / (2 * normal @ normal) + np.cross(ac, normal) * (ab @ ab) / (2 * normal @ normal)
    radius = float(np.linalg.norm(a - middle))
    x = (a - middle) / radius
    y = np.cross(normal / np.linalg.norm(normal), x)
    at_via, at_end = (float(np.arctan2((pose[:3] - middle) @ y, (pose[:3] - middle) @ x) % (2 * np.pi)) for pose in (via, end))
    length = 2 * np.pi if whole else at_end
    lines = int(np.ceil(length / (2 * np.arccos(1 - min(1.0, CIRCLE_MM / radius)))))
    angles = np.linspace(0.0, length, int(np.clip(lines, 2, CIRCLE_LINES)) + 1)[1:]
    places = middle + radius * (np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y)
    if whole:
        return [*np.c_[places, np.tile(start[3:], (len(angles), 1))][:-1], start]
    known = np.array([start[3:], via[3:], end[3:]])
    if np.any(known[:, :2]):
        turns = Slerp([0.0, at_via, at_end], Rotation.from_euler("xyz", known, degrees=True))(angles).as_euler("xyz", degrees=True)
    else:  # about z alone, where R is not wrapped
        turns = np.c_[np.zeros((len(angles), 2)), np.interp(angles, [0.0, at_via, at_end], known[:, 2])]
    return [*np.c_[places, turns][:-1], end]
