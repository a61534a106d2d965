"""Kinematics of a UR, and its poses: m and rotation vectors there, mm and static xyz angles in deg here.

The joints have the Denavit-Hartenberg parameters ``d1, a2, a3, d4, d5, d6`` of the maker's table, and twists of 90, 0, 0, 90, -90, 0 deg.
The closed inverse is that of K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", 2013.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.arms.motion import LIMIT_TOLERANCE_DEG, TARGET_LIMIT, OutOfReachError, StageKinematics, Violation
from twin.rig.arm_pose import matrix_of

# d1, a2, a3, d4, d5, d6 in mm, by the model and the major version of its software (from 5 on: e-Series).
MODELS = {
    ("UR3", 3): (151.9, -243.65, -213.25, 112.35, 85.35, 81.9),
    ("UR5", 3): (89.159, -425.0, -392.25, 109.15, 94.65, 82.3),
    ("UR10", 3): (127.3, -612.0, -572.3, 163.941, 115.7, 92.2),
    ("UR3", 5): (151.85, -243.55, -213.2, 131.05, 85.35, 92.1),
    ("UR5", 5): (162.5, -425.0, -392.2, 133.3, 99.7, 99.6),
    ("UR10", 5): (180.7, -612.7, -571.55, 174.15, 119.85, 116.55),
    ("UR16", 5): (180.7, -478.4, -360.0, 174.15, 119.85, 116.55),
}
TWISTS = np.radians([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])
FULL_TURN_DEG = 360.0  # range of each joint, to both sides
# Sine of the angle of joint 5 below which joints 4 and 6 have the same axis.
STRAIGHT = 1e-6


def pose_from_ur(pose: np.ndarray) -> np.ndarray:
    """The pose (6,) of one of a UR: its rx is between -90 and 270 deg, so that it does not jump where the tool points down."""
    angles = Rotation.from_rotvec(pose[3:]).as_euler("xyz", degrees=True)
    return np.r_[1000.0 * np.asarray(pose[:3]), (angles[0] + 90.0) % 360.0 - 90.0, angles[1:]]


def pose_to_ur(pose: np.ndarray) -> list[float]:
    """The reverse of ``pose_from_ur``."""
    return [*(np.asarray(pose[:3]) / 1000.0).tolist(), *Rotation.from_euler("xyz", pose[3:], degrees=True).as_rotvec().tolist()]


@dataclass(frozen=True, eq=False)
class UrKinematics(StageKinematics):
    """A UR with a tool. The driver writes into all arrays at ``connect``, because only then the model and the tool are known.

    Attributes
    ----------
    lengths_mm : (6,) float
        A row of ``MODELS``.
    T_flange_tool : (4, 4) float
    near_deg : (6,) float
        Joints whose side of shoulder, elbow and wrist ``inverse`` keeps. It gives the nearest turns within the joints' range.
    """

    lengths_mm: np.ndarray = field(default_factory=lambda: np.array(MODELS["UR5", 3]))
    T_flange_tool: np.ndarray = field(default_factory=lambda: np.eye(4))
    near_deg: np.ndarray = field(default_factory=lambda: np.array([0.0, -90.0, 90.0, -90.0, -90.0, 0.0]))

    def flange(self, joints_deg: np.ndarray) -> np.ndarray:
        """``T_base_flange`` (4, 4) at the joints (6,)."""
        d1, a2, a3, d4, d5, d6 = self.lengths_mm
        T = np.eye(4)
        for q, d, a, twist in zip(np.radians(joints_deg), (d1, 0, 0, d4, d5, d6), (0, a2, a3, 0, 0, 0), TWISTS, strict=True):
            T = T @ _link(q, d, a, twist)
        return T

    def forward(self, joints_deg: np.ndarray) -> np.ndarray:
        T = self.flange(joints_deg) @ self.T_flange_tool
        return pose_from_ur(np.r_[T[:3, 3] / 1000.0, Rotation.from_matrix(T[:3, :3]).as_rotvec()])

    def inverse(self, pose: np.ndarray) -> np.ndarray:
        """Joints (6,) at the pose (6,); ``OutOfReachError`` where there are none."""
        d1, a2, a3, d4, d5, d6 = self.lengths_mm
        near = np.radians(self.near_deg)
        T = matrix_of(pose) @ np.linalg.inv(self.T_flange_tool)
        wrist = T[:3, 3] - d6 * T[:3, 2]  # of joint 5
        reach = np.hypot(*wrist[:2])
        beside = self._arccos(d4 / reach if reach else np.inf, pose)
        q1 = min((np.arctan2(wrist[1], wrist[0]) + sign * beside + np.pi / 2 for sign in (1, -1)), key=lambda q: abs(_turn(q - near[0])))
        side = np.array([np.sin(q1), -np.cos(q1), 0.0])
        q5 = np.copysign(self._arccos((side @ T[:3, 3] - d4) / d6, pose), np.sin(near[4]))
        q6 = near[5]
        if abs(np.sin(q5)) > STRAIGHT:
            q6 = np.arctan2(-side @ T[:3, 1] / np.sin(q5), side @ T[:3, 0] / np.sin(q5))
        T_14 = np.linalg.inv(_link(q1, d1, 0, TWISTS[0])) @ T @ np.linalg.inv(_link(q5, d5, 0, TWISTS[4]) @ _link(q6, d6, 0, 0.0))
        x, y = (T_14 @ [0.0, -d4, 0.0, 1.0])[:2]
        q3 = np.copysign(self._arccos((x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3), pose), np.sin(near[2]))
        q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
        q4 = np.arctan2(T_14[1, 0], T_14[0, 0]) - q2 - q3
        joints = np.degrees(near + _turn(np.array([q1, q2, q3, q4, q5, q6]) - near))
        return joints - FULL_TURN_DEG * np.trunc(joints / (FULL_TURN_DEG + LIMIT_TOLERANCE_DEG))

    def violation(self, joints_deg: np.ndarray) -> Violation | None:
        beyond = np.flatnonzero(np.abs(joints_deg) > FULL_TURN_DEG + LIMIT_TOLERANCE_DEG)
        return (
            Violation(TARGET_LIMIT, f"J{beyond[0] + 1} at {joints_deg[beyond[0]]:.2f} deg is beyond a full turn") if beyond.size else None
        )

    def _arccos(self, cosine: float, pose: np.ndarray) -> float:
        if not abs(cosine) <= 1.0 + STRAIGHT:
            raise OutOfReachError(f"x {pose[0]:.1f}, y {pose[1]:.1f}, z {pose[2]:.1f} mm is out of reach in this orientation")
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _link(q: float, d: float, a: float, twist: float) -> np.ndarray:
    c, s, ct, st = np.cos(q), np.sin(q), np.cos(twist), np.sin(twist)
    return np.array([[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s], [0, st, ct, d], [0, 0, 0, 1]])


def _turn(angle: np.ndarray) -> np.ndarray:
    """Angles in rad, changed by full turns to the shortest."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
