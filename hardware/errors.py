"""Errors of attached devices, and devices as context managers.

The classes of errors are those that users of LeRobot expect. A ``Connection`` is connected when it is entered, and disconnected when it
is left.
"""

from abc import ABC, abstractmethod
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


class Connection(ABC):
    """Base of all devices with ``connect()`` and ``disconnect()``."""

    @abstractmethod
    def connect(self) -> None: ...

    @abstractmethod
    def disconnect(self) -> None: ...

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()
