"""Errors of attached devices, and devices as context managers.

The classes of errors are those that users of LeRobot expect. A ``Connection`` is connected when it is entered, and disconnected when it
is left.
"""

import errno
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Self

from twin.errors import TwinError


class DeviceError(TwinError):
    """A device does not do what it was told. The message names the device and the remedy."""


class DeviceNotConnectedError(DeviceError, ConnectionError):
    """The device is not (or no longer) connected."""


class DeviceAlreadyConnectedError(DeviceError, ConnectionError):
    """The device is connected already."""


class StaleDataError(DeviceError):
    """The newest frame or feedback is older than allowed."""


def cannot_listen(who: str, host: str, port: int, error: OSError, *, option: str = "--port") -> DeviceError:
    """The error to raise where a server can't listen: names address, reason and remedy; ``option`` is that of the port."""
    foreign = isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL
    remedy = (
        "give an address of this machine with --host, such as 127.0.0.1" if foreign else f"end what uses the port, or give another {option}"
    )
    return DeviceError(f"{who}: can't listen on {host}:{port} ({error.strerror}); {remedy}")


class Connection(ABC):
    """Base of all devices with ``connect()`` and ``disconnect()``."""

    @abstractmethod
    def connect(self) -> None: ...

    @abstractmethod
    def disconnect(self) -> None: ...

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None:
        leave(self.disconnect, error)


def leave(disconnect: Callable[[], None], error: BaseException | None) -> None:
    """Disconnect at the end of a context. A failure becomes a note of the exception that is on its way, if there is one."""
    try:
        disconnect()
    except DeviceError as failed:
        if error is None:
            raise
        error.add_note(str(failed))


def also(error: BaseException, what: str) -> None:
    """Say in an error what failed after it: at the end of a device's message, else as a note."""
    if isinstance(error, DeviceError) and error.args:
        error.args = (f"{error.args[0]}; {what}", *error.args[1:])
    else:
        error.add_note(what)
