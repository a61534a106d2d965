"""Writes a short video of what the page shows."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from twin.errors import TwinError
from twin.store import write_bytes
from twin.types import ImageArray

RATE_HZ = 15.0
"""Pictures per second of a video."""
LONGEST_S = 300.0
"""Time, s, after which a video ends by itself."""


class FilmWriter:
    """Writes pictures as an MP4, each for the time for which it was shown. The file appears when it is complete.

    Parameters
    ----------
    path : Path
        A new file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = TemporaryDirectory(prefix="tactip-video-")
        self._part = Path(self._folder.name) / "part.mp4"
        self._writer: cv2.VideoWriter | None = None
        self._size_px = (0, 0)
        self._begun_s, self._count = time.monotonic(), 0
        self._last: ImageArray | None = None

    def add(self, picture: ImageArray, *, at_s: float | None = None) -> None:
        """Show a picture (h, w, 3) RGB from now on, or from ``at_s``, s after the beginning.

        Raises
        ------
        TwinError
            OpenCV can't write MP4 files on this machine.
        """
        at_s = time.monotonic() - self._begun_s if at_s is None else at_s
        if at_s > LONGEST_S:
            return
        if self._writer is None:
            self._size_px = picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2
            self._writer = cv2.VideoWriter(str(self._part), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, self._size_px)
            if not self._writer.isOpened():
                raise TwinError(f"{self._path}: OpenCV can't write an MP4 here; save pictures instead")
            self._last = picture
        while self._last is not None and self._count < at_s * RATE_HZ:
            self._write(self._last)
        self._last = picture

    def _write(self, picture: ImageArray) -> None:
        assert self._writer is not None
        width, height = self._size_px
        canvas = np.zeros((height, width, 3), np.uint8)
        part = picture[:height, :width, ::-1]
        canvas[: part.shape[0], : part.shape[1]] = part
        self._writer.write(canvas)
        self._count += 1

    def close(self) -> str:
        """End the video, and return a line that states what was written.

        Raises
        ------
        StoreError
            The file can't be written.
        """
        if self._writer is None or self._last is None:
            self._folder.cleanup()
            return "no video: no picture was shown"
        self._write(self._last)
        self._writer.release()
        write_bytes(self._path, self._part.read_bytes())
        self._folder.cleanup()
        return f"saved {self._path} ({self._count / RATE_HZ:.1f} s)"
