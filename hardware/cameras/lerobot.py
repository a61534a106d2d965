"""A frame source in the shape that users of LeRobot expect of a camera: images in, no import of LeRobot."""

import numpy as np

from hardware.cameras.source import FrameSource
from hardware.devices import cameras
from hardware.errors import StaleDataError


class LeRobotCamera:
    """``connect``, ``read``, ``async_read``, ``read_latest`` and ``disconnect`` as LeRobot's cameras have them.

    Parameters
    ----------
    source : FrameSource
    """

    def __init__(self, source: FrameSource) -> None:
        self._source = source

    @property
    def is_connected(self) -> bool:
        return self._source.is_connected

    @staticmethod
    def find_cameras() -> list[dict]:
        """USB cameras of this machine."""
        return [{"type": "OpenCV", "id": device.node, "name": device.description} for device in cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open it; with ``warmup`` return when the first frame has come."""
        self._source.connect()
        if warmup:
            self._source.read(timeout_s=self._source.first_frame_s)

    def read(self) -> np.ndarray:
        """The next image (H, W) or (H, W, 3), uint8 RGB."""
        return self._source.read().image

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """The newest image not read yet; ``TimeoutError``."""
        return self._source.read(timeout_s=timeout_ms / 1e3).image

    def read_latest(self, max_age_ms: float = 500) -> np.ndarray:
        """The newest image; ``TimeoutError`` if it is older."""
        try:
            return self._source.read_latest(max_age_s=max_age_ms / 1e3).image
        except StaleDataError as error:
            raise TimeoutError(str(error)) from error

    def disconnect(self) -> None:
        """Let go of it."""
        self._source.disconnect()
