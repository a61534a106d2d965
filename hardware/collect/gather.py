"""Takes frames of a live camera into a folder, as input of 'twin new' for an unknown sensor."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hardware.cameras.source import FrameSource
from hardware.errors import DeviceError
from twin.frames.images import write_image
from twin.store import output

FRAMES = 40
"""Number of frames, including the one without contact."""
EVERY_S = 0.5
"""Time, s, between two frames: enough to press at another place."""
MOST_WAIT_S = 10.0
"""Longest wait, s, for one frame."""


def gather_frames(
    source: FrameSource,
    folder: Path,
    *,
    count: int = FRAMES,
    every_s: float = EVERY_S,
    say: Callable[[str], object] = print,
    sleep: Callable[[float], object] = time.sleep,
) -> Path:
    """Take frames of a camera: first one without contact (``init_0.png``), then others while a person presses the sensor.

    Parameters
    ----------
    source : FrameSource
        Not yet connected.
    folder : Path
        Folder for the frames. Frames of an earlier run are replaced.
    count : int
        Total number of frames.
    every_s : float
        Time between two frames.
    say : callable
        Called with each line that asks the person what to do.
    sleep : callable
        Function that waits for a time in s.

    Returns
    -------
    Path
        ``folder``.

    Raises
    ------
    DeviceError
        The camera gives no frames, or all its frames are the same.
    """
    with output(folder, "init_0.png", "images"):
        images = folder / "images"
        shutil.rmtree(images, ignore_errors=True)
        source.connect()
        try:
            say("keep the sensor free of contact")
            sleep(2 * every_s)
            first = source.read(timeout_s=MOST_WAIT_S)
            write_image(folder / "init_0.png", first.image)
            say(f"now press the sensor in different places, lightly and firmly, for {count * every_s:.0f} s")
            changed = 0.0
            for number in range(1, count):
                sleep(every_s)
                frame = source.read(timeout_s=MOST_WAIT_S)
                changed = max(changed, float(np.abs(frame.image.astype(int) - first.image).mean()))
                images.mkdir(exist_ok=True)
                write_image(images / f"frame_{number:03d}.png", frame.image)
        finally:
            source.disconnect()
        if not changed:
            raise DeviceError(f"all {count} frames of the camera are the same; check whether it is frozen, and press the sensor")
    return folder
