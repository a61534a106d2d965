"""Poses of an arm as numbers, x, y, z in mm and static xyz angles in deg, and as matrices."""

import numpy as np
from scipy.spatial.transform import Rotation


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """``T_base_tool`` (4, 4) of an arm's pose (6,) in mm and deg."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", np.asarray(pose, float)[3:], degrees=True).as_matrix()
    T[:3, 3] = pose[:3]
    return T


def pose_of(T: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The arm's pose (6,) of ``T_base_tool`` (4, 4). Its turn about z differs from that of ``near`` (6,) by at most half a turn."""
    angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
    angles[2] += 360.0 * np.round((near[5] - angles[2]) / 360.0)
    return np.concatenate([T[:3, 3], angles])
