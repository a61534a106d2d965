"""Targets of an arm of four axes with a parallel linkage, checked before anything is sent."""

import numpy as np

from hardware.arms.kinematics import LinkageKinematics, OutOfReachError
from hardware.errors import DeviceError


def linear_target(name: str, kinematics: LinkageKinematics, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose (6,) nearest to the requested one that the arm can take, and its joints (4,); NaN where a number is missing.

    Raises
    ------
    DeviceError
        It is out of reach.
    """
    sent = kinematics.nearest_pose(pose)
    try:
        return sent, kinematics.inverse(sent) if np.isfinite(sent).all() else np.full(4, np.nan)
    except OutOfReachError as error:
        raise DeviceError(f"{name}: {error}; nothing was sent") from error


def joint_target(name: str, joints_deg: np.ndarray) -> np.ndarray:
    """Joint angles (4,), or ``DeviceError`` where they are not four."""
    sent = np.array(joints_deg, float)
    if sent.shape != (4,):
        raise DeviceError(f"{name}: {sent.size} joint angles; it has 4 joints")
    return sent


def require_possible(name: str, kinematics: LinkageKinematics, numbers: np.ndarray, joints_deg: np.ndarray) -> None:
    """Raise ``DeviceError`` unless the joints (4,) are numbers within the limits. ``numbers`` are those that would be sent."""
    if not np.isfinite(joints_deg).all():
        raise DeviceError(f"{name}: the target {numbers} is not a number; nothing was sent")
    if violation := kinematics.violation(joints_deg):
        raise DeviceError(f"{name}: {violation.text}; nothing was sent. Choose a target within reach and limits")
