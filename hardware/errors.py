"""Errors of attached devices, and the base class that makes devices context managers.

The error classes are those that users of LeRobot expect. Entering a ``Connection`` connects the device, and leaving it disconnects the
device.
"""

import errno
import re
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self

from twin.errors import TwinError


class DeviceError(TwinError):
    """A device does not do what was commanded. The message names the device and the remedy."""


class DeviceNotConnectedError(DeviceError, ConnectionError):
    """The device is not (or no longer) connected."""


class DeviceAlreadyConnectedError(DeviceError, ConnectionError):
    """The device is already connected."""


class StaleDataError(DeviceError):
    """The newest frame or feedback is older than allowed."""


def cannot_listen(who: str, host: str, port: int, error: OSError, *, option: str = "`port`") -> DeviceError:
    """The error of a server that can't listen. It names the address, the reason and the remedy; ``option`` is the option for the port."""
    remedy = f"end what uses the port, or give another {option}"
    if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
        remedy = "give an address of this machine with `host`, such as 127.0.0.1"
    return DeviceError(f"{who}: can't listen on {host}:{port} ({error.strerror}); {remedy}")


class Connection(ABC):
    """Base class of all devices with ``connect()`` and ``disconnect()``."""

    name: str

    @property
    @abstractmethod
    def is_connected(self) -> bool:
        """Whether the connection is open."""

    @abstractmethod
    def connect(self) -> None: ...

    @abstractmethod
    def disconnect(self) -> None: ...

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None:
        leave(self.disconnect, error)

    def _require_connected(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self.name}: not connected; call connect() first")

    def _require_disconnected(self) -> None:
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self.name}: connected already; disconnect() first")


def leave(disconnect: Callable[[], None], error: BaseException | None) -> None:
    """Disconnect at the end of a context. If an exception is being raised already, a failure is added to it as a note."""
    try:
        disconnect()
    except DeviceError as failed:
        if error is None:
            raise
        error.add_note(str(failed))


def also(error: BaseException, what: str) -> None:
    """Add to an error what failed after it: at the end of the message of a ``DeviceError``, or as a note to any other error."""
    if isinstance(error, DeviceError) and error.args:
        error.args = (f"{error.args[0]}; {what}", *error.args[1:])
    else:
        error.add_note(what)


def undo(act: Callable[[], object], error: BaseException) -> None:
    """Stop or switch off a device after an error. If that fails, it is added to the error."""
    try:
        act()
    except DeviceError as failed:
        also(error, str(failed))


@contextmanager
def on_error(act: Callable[[], object]) -> Iterator[None]:
    """Context that stops, releases or switches off something after any error, Ctrl-C included. If that fails, it is added to the error."""
    try:
        yield
    except BaseException as error:
        undo(act, error)
        raise


# Longest line about an arm or a camera, in characters. Longer messages, and notes, go to a file.
LONGEST_LINE = 160
# Words by which a message says that an arm may still move, and what a line says instead of all such words.
_MOVES = {"switch it off": "the arm may still move: SWITCH IT OFF", "may move": "the arm may still move: PRESS ITS EMERGENCY STOP"}
# Advice to a Python program, which is no help to the user of a command.
_PYTHON = re.compile(r"[;,.]? *(?:then |or )?(?:call |\b)(?:(?:disconnect|connect|enable|stop|clear_error)\(\)[^;.]*)")


def in_short(text: str, most: int = LONGEST_LINE) -> str:
    """A device's error in one line of at most ``most`` characters: its cause, and whether the arm may still move."""
    lower = text.lower()
    end = next((told for word, told in _MOVES.items() if word in lower), "")
    cause = _PYTHON.sub("", text.split("\n")[0]).strip()
    left = most - len(end) - 2 * bool(end)
    if len(cause) > left:
        cause = cause[: left - 3].rstrip(" ;,.") + "..."
    return f"{cause}; {end}" if end else cause
