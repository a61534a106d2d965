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


class Supervisor:
    """Sends messages on a connection if this program ends without ``end``. Not on Windows, where processes inherit no descriptors.

    Parameters
    ----------
    fileno : callable
        Gives the file descriptor of the connection, a socket or a serial port.
    messages : tuple of bytes
        What stops and disables the arm; without any there is no supervisor.
    """

    def __init__(self, fileno: Callable[[], int] = lambda: -1, messages: tuple[bytes, ...] = ()) -> None:
        self._process: subprocess.Popen | None = None
        if messages and hasattr(os, "fork"):
            descriptor, quiet = fileno(), subprocess.DEVNULL
            command = [sys.executable, "-I", "-S", __file__, str(descriptor), str(os.getpid()), *(message.hex() for message in messages)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, pass_fds=(descriptor,), start_new_session=True
            )

    def end(self) -> None:
        """End the process. It sends nothing."""
        process, self._process = self._process, None
        if process is not None:
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(b"end", timeout=END_S)


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
