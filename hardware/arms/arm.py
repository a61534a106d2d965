"""What a loop knows of an arm. Units at this edge are mm and degrees; times are ``time.monotonic()`` seconds."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class ArmState:
    """One report of an arm about itself.

    Attributes
    ----------
    pose : (6,) float
        ``x, y, z, rx, ry, rz`` of the tool in the base frame, mm and deg, static xyz Euler angles.
        An arm of four axes has ``rx = ry = 0`` and its turn R as ``rz``.
    joints_deg : (J,) float
    time_s : float
        ``time.monotonic()`` when the state arrived.
    enabled, moving : bool
    error : str
        The arm's error in words; "" if there is none.
    """

    pose: np.ndarray
    joints_deg: np.ndarray
    time_s: float
    enabled: bool
    moving: bool
    error: str = ""


class Arm(Protocol):
    """A robot arm. Nothing moves or opens in a constructor; nothing moves before ``enable``.

    Every method but ``connect`` raises ``DeviceNotConnectedError`` when not connected, and ``DeviceError`` when the arm
    refuses or fails; ``stop``, ``emergency_stop``, ``disable`` and ``clear_error`` are never gated.
    """

    name: str
    axes: int  # 4 for the Dobots, 6 where tilt can be commanded

    @property
    def is_connected(self) -> bool: ...

    def connect(self) -> None: ...

    def disconnect(self) -> None:
        """Stop the arm and close the connection. It has no effect when the arm is not connected."""

    def __enter__(self) -> "Arm": ...

    def __exit__(self, *_: object) -> None: ...

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def clear_error(self) -> None: ...

    def stop(self) -> None:
        """End the motion at once and forget what is queued."""

    def emergency_stop(self) -> None:
        """Stop and cut the motors' power, where the arm has a command for it; ``clear_error`` and ``enable`` bring it back."""

    def state(self, *, max_age_s: float = 1.0) -> ArmState:
        """The newest state; ``StaleDataError`` if it is older than ``max_age_s``."""

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None: ...

    def move_linear(self, pose: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray:
        """Move the tool straight to ``pose`` (6,); returns the pose really commanded (clamped to what the arm can do).

        With ``wait`` it returns only when feedback shows the arm at rest there, else ``DeviceError``.
        Without, it returns when the arm has accepted it.
        """

    def move_joints(self, joints_deg: np.ndarray, *, wait: bool = True, timeout_s: float = 10.0) -> np.ndarray: ...

    def wait_settled(self, pose: np.ndarray, *, tolerance_mm: float = 0.1, tolerance_deg: float = 0.1, timeout_s: float = 10.0) -> ArmState:
        """Wait for feedback of the arm at rest at ``pose``: the state that confirms it.

        Raises
        ------
        DeviceError
            It did not get there in time, or reports an error.
        """
