"""A live source without a device: a new noisy picture at a steady rate, its number in its first pixels."""

import time

import numpy as np

from hardware.cameras.reader import DevicePicture, LiveSource
from twin.types import Form


class NoisyCamera(LiveSource):
    """Pictures (H, W) or (H, W, 3), by default of 64 x 48 px; ``number_of`` tells which one a frame is."""

    def __init__(self, *, fps: float = 100.0, color: bool = False, size_px: tuple[int, int] = (64, 48)) -> None:
        super().__init__("noisy camera", Form.RAW)
        self.fps = fps
        self._period_s, self._shape = 1.0 / fps, (*size_px[::-1], 3) if color else size_px[::-1]
        self._rng, self._number = np.random.default_rng(0), 0

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass

    def _grab(self) -> DevicePicture:
        self._end.wait(self._period_s)
        self._number += 1
        image = self._rng.integers(60, 200, self._shape, np.uint8)
        image[:16, :16] = 10 * (self._number % 20) + 30
        return DevicePicture(image, time.monotonic())


def number_of(image: np.ndarray) -> int:
    """Number of the picture modulo 20; survives JPEG."""
    return int(round((float(image[4:12, 4:12].mean()) - 30) / 10))
