"""A small process that stops an arm whose program has died, also after SIGKILL.

It inherits the descriptor of the program's own connection, because an arm may take no second client. It does nothing while the program
lives. This file is also its program. It imports the standard library only, so that it starts in a few hundredths of a second.
"""

import contextlib
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable

# Interval, s, at which it checks that the program lives, and time, s, that an arm has for each message.
CHECK_S, MESSAGE_S = 0.05, 0.15
# Longest wait, s, for its end.
END_S = 2.0


def supervise_connection(fileno: Callable[[], int], messages: tuple[bytes, ...]) -> "Supervisor | None":
    """Start a supervisor of the connection with this descriptor; None on Windows, where processes inherit no descriptors."""
    return Supervisor(fileno(), messages) if hasattr(os, "fork") else None


class Supervisor:
    """Sends messages on a connection if this program ends without ``end``.

    Parameters
    ----------
    descriptor : int
        File descriptor of the connection, a socket or a serial port.
    messages : tuple of bytes
        What stops and disables the arm.
    """

    def __init__(self, descriptor: int, messages: tuple[bytes, ...]) -> None:
        command = [sys.executable, "-I", "-S", __file__, str(descriptor), str(os.getpid()), *(message.hex() for message in messages)]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, pass_fds=(descriptor,), start_new_session=True
        )

    def end(self) -> None:
        """End the process. It sends nothing."""
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            self._process.communicate(b"end", timeout=END_S)


def supervise(descriptor: int, program: int, messages: list[bytes]) -> None:
    """Wait for the end of the program with this process id, and then send the messages, unless the program ends the wait."""
    while os.getppid() == program:
        if select.select([0], [], [], CHECK_S)[0]:
            if os.read(0, 8):
                return
            break  # the program's end of the pipe was closed by its death
    for message in messages:
        with contextlib.suppress(OSError):
            select.select([], [descriptor], [], MESSAGE_S)
            os.write(descriptor, message)
        time.sleep(MESSAGE_S)


if __name__ == "__main__":
    supervise(int(sys.argv[1]), int(sys.argv[2]), [bytes.fromhex(text) for text in sys.argv[3:]])
