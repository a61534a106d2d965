"""The servo law, a pure function: from the surface in a frame and the arm's present pose to its next pose.

An estimate of depth and angle, together with the arm's pose when the frame was exposed, puts the surface's tangent into the
base frame. The law compares the present pose of the arm with that tangent, so a frame may be older than the last move.
Depth d and angle w of the tool against the tangent, reference r, sums S of the errors (bounded),

    e = r - (d, w),   S' = clip(S + e),   (d, w)' = (d, w) + kp e + ki S',   along' = along + feed

(Lepora & Lloyd's pose-based tactile servoing; positions are commanded, so the arm itself is one integrator).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.servo import ServoSpec
from twin.rig.arm_pose import matrix_of, pose_of
from twin.rig.kinematics import Mounting


@dataclass(frozen=True)
class Memory:
    """Sums of the errors of depth (mm) and angle (deg) over the steps."""

    depth_mm: float = 0.0
    angle_deg: float = 0.0


@dataclass(frozen=True)
class Reading:
    """Depth of the tool beyond first touch, and its angle from the surface's normal."""

    depth_mm: float
    angle_deg: float


@dataclass(frozen=True)
class LawStep:
    """The result of one step of the law.

    Attributes
    ----------
    pose : (6,) float
        The arm's next pose.
    memory : Memory
    """

    pose: np.ndarray
    memory: Memory


def tangent_of(mounting: Mounting, pose: np.ndarray, reading: Reading) -> np.ndarray:
    """``T_base_surface`` (4, 4), the pose of a tool that just touches the surface and stands normal to it.

    Parameters
    ----------
    mounting : Mounting
    pose : (6,) float
        The arm's pose when the frame was exposed.
    reading : Reading
    """
    axis, out_of_plane = mounting.axis, mounting.out_of_plane
    T = matrix_of(pose)
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(-np.radians(reading.angle_deg) * out_of_plane).as_matrix()
    T[:3, 3] -= reading.depth_mm * (T[:3, :3] @ axis)
    return T


def reading_at(mounting: Mounting, T_base_surface: np.ndarray, pose: np.ndarray) -> Reading:
    """Depth and angle of a tool at a pose (6,) against a tangent (4, 4)."""
    axis, out_of_plane = mounting.axis, mounting.out_of_plane
    seen = np.linalg.inv(T_base_surface) @ matrix_of(pose)
    turn = Rotation.from_matrix(seen[:3, :3]).as_rotvec(degrees=True)
    return Reading(float(axis @ seen[:3, 3]), float(out_of_plane @ turn))


def servo_step(
    spec: ServoSpec, mounting: Mounting, T_base_surface: np.ndarray, pose: np.ndarray, memory: Memory, *, fresh: bool = True
) -> LawStep:
    """The arm's next pose.

    Parameters
    ----------
    spec : ServoSpec
    mounting : Mounting
    T_base_surface : (4, 4) float
        The surface's tangent from ``tangent_of``.
    pose : (6,) float
        The arm's present pose, or the last pose to which it was sent.
    memory : Memory
    fresh : bool
        Whether the tangent comes from a new frame; an old frame does not change the sums.
    """
    axis, out_of_plane = mounting.axis, mounting.out_of_plane
    now = reading_at(mounting, T_base_surface, pose)
    error_mm, error_deg = spec.indent_mm - now.depth_mm, spec.angle_deg - now.angle_deg
    if fresh:
        bounds = np.array([spec.integral_mm, spec.integral_deg])
        memory = Memory(*np.clip([memory.depth_mm + error_mm, memory.angle_deg + error_deg], -bounds, bounds).tolist())
    press_mm = spec.kp_depth * error_mm + spec.ki_depth * memory.depth_mm
    turn_deg = spec.kp_angle * error_deg + spec.ki_angle * memory.angle_deg
    turn_deg = float(np.clip(turn_deg, -spec.largest_turn_deg, spec.largest_turn_deg))
    step_mm = spec.feed_mm * mounting.across + press_mm * axis
    step_mm *= min(1.0, spec.largest_move_mm / max(float(np.linalg.norm(step_mm)), 1e-9))
    T = matrix_of(pose)
    T[:3, :3] = T_base_surface[:3, :3] @ Rotation.from_rotvec(np.radians(now.angle_deg + turn_deg) * out_of_plane).as_matrix()
    T[:3, 3] += T_base_surface[:3, :3] @ step_mm
    return LawStep(pose_of(T, pose), memory)
