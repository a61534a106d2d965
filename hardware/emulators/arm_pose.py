"""The pose of an MG400 from its feedback port alone. An emulated camera needs it when the arm runs in another process."""

import numpy as np

from hardware.arms.arm import ArmState
from hardware.arms.mg400_link import Feedback
from hardware.arms.mg400_wire import DASHBOARD_PORT, FEEDBACK_PERIOD_S, require_ports
from hardware.errors import DeviceError

MAX_AGE_S = 1.0


class FeedbackPose:
    """Reads the newest state from the feedback ports. It opens no command connection, so a driver may be connected at the same time.

    Parameters
    ----------
    host : str
    ports : tuple of int
        Feedback ports, tried in order.
    """

    def __init__(self, host: str, ports: tuple[int, ...] = tuple(FEEDBACK_PERIOD_S)) -> None:
        self._feedback = Feedback(f"arm at {host}", host, ports)

    @classmethod
    def of(cls, spec: str) -> "FeedbackPose":
        """From ``mg400:ADDRESS[:DASHBOARD_PORT]``. The feedback ports have the same offset as the dashboard port."""
        kind, _, rest = spec.partition(":")
        host, _, port = rest.partition(":")
        if kind != "mg400" or not host or (port and not port.isdecimal()):
            raise DeviceError(f"--arm {spec}: expected mg400:ADDRESS, for example mg400:127.0.0.1 with 'twin emulate mg400' running")
        offset = int(port) - DASHBOARD_PORT if port else 0
        require_ports(offset)
        return cls(host, tuple(number + offset for number in FEEDBACK_PERIOD_S))

    def __enter__(self) -> "FeedbackPose":
        self._feedback.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._feedback.close()

    def __call__(self) -> ArmState:
        """The newest state; ``StaleDataError``."""
        packet, time_s = self._feedback.newest(MAX_AGE_S)
        x, y, z, turn = packet["tool_actual"][:4]
        return ArmState(np.array([x, y, z, 0.0, 0.0, turn]), packet["q_actual"][:4].copy(), time_s, bool(packet["enabled"]), False)
