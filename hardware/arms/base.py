"""What all drivers share: errors when the arm is not connected, and waiting until the arm is at rest."""

import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np

from hardware.arms.arm import ArmState
from hardware.arms.motion import turn_between_deg
from hardware.connection import Connection
from hardware.errors import DeviceAlreadyConnectedError, DeviceError, DeviceNotConnectedError

POLL_S = 0.005  # shorter than the 8 ms period of the fastest feedback
BELIEVE_REST_S = 0.15  # a move shows in feedback sooner than this; an arm that rests elsewhere for longer does not execute it


class BaseArm(Connection):
    """Base of the arms; see ``hardware.arms.arm.Arm`` for what each method promises."""

    name: str
    axes: int

    @property
    @abstractmethod
    def is_connected(self) -> bool: ...

    @abstractmethod
    def stop(self) -> None: ...

    @abstractmethod
    def disable(self) -> None: ...

    def emergency_stop(self) -> None:
        """Stop and disable; see ``Arm``."""
        self.stop()
        self.disable()

    @abstractmethod
    def state(self, *, max_age_s: float = 1.0) -> ArmState: ...

    def wait_settled(self, pose: np.ndarray, *, tolerance_mm: float = 0.1, tolerance_deg: float = 0.1, timeout_s: float = 10.0) -> ArmState:
        """Wait for feedback of the arm at rest at ``pose``; see ``Arm``."""
        deadline = time.monotonic() + timeout_s
        asked_s, rest_since = time.monotonic(), None
        while True:
            state = self.state()
            if state.error:
                raise DeviceError(f"{self.name}: {state.error}")
            off_mm = float(np.linalg.norm(state.pose[:3] - np.asarray(pose)[:3]))
            off_deg = turn_between_deg(state.pose, np.asarray(pose, float))
            if state.moving or state.time_s < asked_s:
                rest_since = None
            elif off_mm <= tolerance_mm and off_deg <= tolerance_deg:
                return state
            else:
                rest_since = rest_since or state.time_s
            if rest_since is not None and state.time_s - rest_since > max(BELIEVE_REST_S, 0.1 * timeout_s):
                raise DeviceError(
                    f"{self.name}: at rest {off_mm:.2f} mm and {off_deg:.2f} deg from where it was sent; the move was not executed. "
                    "Check for a stop button, a brake or an obstacle, call stop() and clear_error(), then move again"
                )
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"{self.name}: not there after {timeout_s:g} s ({off_mm:.2f} mm and {off_deg:.2f} deg to go); "
                    "call stop(), then give more time or more speed"
                )
            time.sleep(POLL_S)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        """Context in which a move is waited for. After any error, Ctrl-C included, the arm is stopped: no move goes on unwatched."""
        try:
            yield
        except BaseException:
            with suppress(DeviceError):
                self.stop()
            raise

    def _too_long(self, timeout_s: float) -> DeviceError:
        return DeviceError(
            f"{self.name}: the move did not end within {timeout_s:g} s and was stopped; give more time or more speed, "
            "or look for what holds the arm"
        )

    def _require_connected(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self.name}: not connected; call connect() first")

    def _require_disconnected(self) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self.name}: connected already; disconnect() first")
