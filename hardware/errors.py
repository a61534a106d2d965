"""Errors of attached devices. Their shape is what users of LeRobot expect."""

from twin.errors import TwinError


class DeviceError(TwinError):
    """A device does not do what it was told; the message names the device and the remedy."""


class DeviceNotConnectedError(DeviceError, ConnectionError):
    """The device is not (or no longer) connected."""


class DeviceAlreadyConnectedError(DeviceError, ConnectionError):
    """The device is connected already."""


class StaleDataError(DeviceError):
    """The newest frame or feedback is older than allowed."""
