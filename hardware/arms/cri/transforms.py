"""Poses in the form of the sensor group's ``cri``, and their conversion between frames. The names are those of ``cri.transforms``.

A pose in Euler angles is ``x, y, z`` in mm and three angles in deg; ``axes`` names their convention: ``s`` static or ``r`` rotating, and
the order. A pose as a quaternion is ``x, y, z`` in mm and ``w, x, y, z`` of the turn.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hardware.errors import DeviceError

Numbers = Sequence[float] | np.ndarray
# Euler axes that cri knows: s for static, r for rotating axes, then their order.
EULER_AXES = tuple(
    frame + order for frame in "sr" for order in ("xyz", "xyx", "xzy", "xzx", "yzx", "yzy", "yxz", "yxy", "zxy", "zxz", "zyx", "zyz")
)


class InvalidEulerAxes(DeviceError, ValueError):  # noqa: N818  (cri's name)
    """There are no such Euler axes."""


class InvalidEulerPose(DeviceError, ValueError):  # noqa: N818  (cri's name)
    """A pose does not have six numbers."""


def euler2mat(pose: Numbers, axes: str = "sxyz") -> np.ndarray:
    """(4, 4) of a pose (6,) in Euler angles."""
    numbers = np.asarray(pose, float).ravel()
    if numbers.size != 6:
        raise InvalidEulerPose(f"a pose has 6 numbers (x, y, z in mm and three angles in deg), got {numbers.size}")
    return quat2mat(np.r_[numbers[:3], Rotation.from_euler(_scipy_axes(axes), numbers[3:], degrees=True).as_quat(scalar_first=True)])


def mat2euler(T: np.ndarray, axes: str = "sxyz") -> np.ndarray:
    """The reverse of ``euler2mat``."""
    return np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_euler(_scipy_axes(axes), degrees=True)]


def quat2mat(pose: Numbers) -> np.ndarray:
    """(4, 4) of a pose (7,) as a quaternion."""
    numbers = np.asarray(pose, float).ravel()
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(numbers[3:], scalar_first=True).as_matrix()
    T[:3, 3] = numbers[:3]
    return T


def mat2quat(T: np.ndarray) -> np.ndarray:
    """The reverse of ``quat2mat``; w is not negative."""
    return np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True, scalar_first=True)]


def euler2quat(pose: Numbers, axes: str = "sxyz") -> np.ndarray:
    """(7,) of a pose (6,)."""
    return mat2quat(euler2mat(pose, axes))


def quat2euler(pose: Numbers, axes: str = "sxyz") -> np.ndarray:
    """(6,) of a pose (7,)."""
    return mat2euler(quat2mat(pose), axes)


def transform(pose: Numbers, frame: Numbers) -> np.ndarray:
    """A pose (7,) relative to a frame (7,); both are given in the same frame."""
    return mat2quat(np.linalg.inv(quat2mat(frame)) @ quat2mat(pose))


def inv_transform(pose: Numbers, frame: Numbers) -> np.ndarray:
    """A pose (7,) that is given relative to a frame (7,), in the frame in which that frame is given."""
    return mat2quat(quat2mat(frame) @ quat2mat(pose))


def transform_euler(pose: Numbers, frame: Numbers, axes: str = "sxyz") -> np.ndarray:
    """As ``transform``, for poses (6,)."""
    return mat2euler(np.linalg.inv(euler2mat(frame, axes)) @ euler2mat(pose, axes), axes)


def inv_transform_euler(pose: Numbers, frame: Numbers, axes: str = "sxyz") -> np.ndarray:
    """As ``inv_transform``, for poses (6,)."""
    return mat2euler(euler2mat(frame, axes) @ euler2mat(pose, axes), axes)


def require_axes(axes: str) -> None:
    """Raise ``InvalidEulerAxes`` if there are no such Euler axes."""
    if axes not in EULER_AXES:
        raise InvalidEulerAxes(f"no Euler axes '{axes}'; there are: {', '.join(EULER_AXES)}")


def _scipy_axes(axes: str) -> str:
    require_axes(axes)
    return axes[1:] if axes[0] == "s" else axes[1:].upper()
