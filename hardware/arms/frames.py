"""Poses as matrices and back."""

import numpy as np
from scipy.spatial.transform import Rotation


def pose_matrix(pose: np.ndarray, axes: str = "sxyz") -> np.ndarray:
    """(4, 4) of ``x, y, z`` in mm and three Euler angles in deg; axes as ``sxyz``: s static, r rotating."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler(_scipy_axes(axes), np.asarray(pose, float)[3:], degrees=True).as_matrix()
    T[:3, 3] = np.asarray(pose, float)[:3]
    return T


def matrix_pose(T: np.ndarray, axes: str = "sxyz") -> np.ndarray:
    """The reverse of ``pose_matrix``."""
    return np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_euler(_scipy_axes(axes), degrees=True)]


def _scipy_axes(axes: str) -> str:
    return axes[1:] if axes[0] == "s" else axes[1:].upper()
