"""Ports that nobody listens on, for tests beside each other."""

import random
import socket
from contextlib import ExitStack

from hardware.arms.mg400_wire import DASHBOARD_PORT, FEEDBACK_PERIOD_S, MOTION_PORT

PORTS = (DASHBOARD_PORT, MOTION_PORT, *FEEDBACK_PERIOD_S)
LOW, HIGH = 1000, 35000  # offsets: 30006 + 35000 is a port


def free_offset() -> int:
    """An offset at which all of an MG400's ports are free just now."""
    while True:
        offset = random.randrange(LOW, HIGH)
        with ExitStack() as stack:
            try:
                for port in PORTS:
                    stack.enter_context(socket.socket()).bind(("127.0.0.1", port + offset))
            except OSError:
                continue
        return offset
