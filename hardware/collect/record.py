"""Records frames of a new sensor with a camera: the frame without contact, then contacts while a person presses the sensor.

A frame is kept when the picture is still, differs from every frame before, and is neither blurred nor too bright or dark. All limits were
chosen, not derived.
"""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from hardware.cameras.mjpeg import PicturePage
from hardware.cameras.source import FrameSource, await_frame
from hardware.errors import DeviceError
from twin.frames.forms import gray_levels
from twin.frames.images import write_image
from twin.progress import Progress, silent, stage
from twin.store import writes
from twin.types import FloatArray, ReadableResult

COUNT, ENOUGH = 40, 12
"""Usual number of contacts, and the least with which a recording ends before it is complete."""
SETTLING = 10
"""Frames at the beginning, in which the camera settles and its noise is measured."""
STILL, STILL_LEVELS = 2.0, 0.1
"""Largest change to the frame before in a still picture: this many times the usual change at the beginning, and gray levels."""
OTHER, OTHER_LEVELS = 4.0, 0.4
"""Least change to every kept frame in a new contact: likewise."""
SHRINK = 4
"""Frames are compared at this fraction of their size."""
PATIENCE_S, GIVE_UP_S = 15.0, 60.0
"""Time after which a picture with a fault is kept nevertheless, and the user reminded; and after which no more contacts are expected."""
WHITE, MOST_WHITE = 250, 0.3
"""Gray level of a saturated pixel, and the largest share of them. The housing may be white."""
DARKEST = 40
"""Least gray level of the brightest hundredth of a picture."""
WIDEST_EDGE = 1 / 50
"""Largest width of the sharpest edges, relative to the picture's width."""
TWO_LEVELS = 8
"""Largest number of gray levels in a thresholded picture, of which exposure and sharpness can't be told."""


@dataclass(frozen=True, repr=False)
class RecordedFrames(ReadableResult):
    """A folder with ``count`` frames in contact and one without, and what was irregular."""

    folder: Path
    count: int
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The result as lines of text."""
        wrote = f"wrote contacts ({self.count}), and init_0.png without contact, into {self.folder}"
        return [wrote, *(f"note: {note}" for note in self.notes), f"next: twin new {self.folder} --out MY.toml"]


@writes("init_0.png", "images")
def record_frames(
    source: FrameSource, out: Path, *, count: int = COUNT, port: int = 0, say: Callable[[str], object] = print, progress: Progress = silent
) -> RecordedFrames:
    """Record a frame without contact (``init_0.png``), and then contacts while a person presses the sensor.

    A page on this machine shows the camera's picture, what to do next, and what is wrong with the picture.

    Parameters
    ----------
    source : FrameSource
        A live camera, not yet connected.
    out : Path
        New folder for the frames.
    count : int
        Number of contacts.
    port : int
        Port of the page; 0 for a free one.
    say : callable
        Called with each line for the person.

    Raises
    ------
    DeviceError
        The camera gives no frames, or hardly any contact is seen for ``GIVE_UP_S``; the frames so far stay in the folder. Or the folder
        has frames already.
    """
    if not source.is_live:
        raise DeviceError(f"{source.name}: recorded already; give it to 'twin new', or give a live camera")
    images = out / "images"
    if images.exists():
        raise DeviceError(f"{out}: has frames already; give a new folder, or remove it")
    with ExitStack() as opened:
        page = opened.enter_context(PicturePage(port))
        say(f"the camera's picture is on {page.url}")
        opened.enter_context(source)
        chosen, done, reminded = _Chosen(), 0, -1
        with stage(progress, "contacts") as step:
            while len(chosen.kept) <= count:
                frame = await_frame(source)
                wish = chosen.consider(frame.image, frame.time_s)
                if not wish:
                    name = images / f"frame_{len(chosen.kept) - 1:03d}.png" if len(chosen.kept) > 1 else out / "init_0.png"
                    images.mkdir(exist_ok=True)
                    write_image(name, frame.image)
                elif frame.time_s - chosen.since_s > GIVE_UP_S:
                    if len(chosen.kept) > ENOUGH:
                        chosen.notes.append(f"ended at {done} of {count} contacts, after {GIVE_UP_S:.0f} s without a new one ({wish})")
                        break
                    remedy = "press the sensor at different places and hold it still, or check the camera"
                    got = f"{done} of {count} contacts after {GIVE_UP_S:.0f} s without a new one"
                    raise DeviceError(f"{out}: {got}; {remedy} ({wish})")
                done = max(len(chosen.kept) - 1, 0)
                page.show(frame.image, f"{done}/{count}  {wish or 'kept'}")
                if wish and frame.time_s - chosen.since_s > PATIENCE_S and reminded < done:
                    reminded = done
                    say(f"{done} of {count} contacts; {wish}. Without a new one it ends in {GIVE_UP_S - PATIENCE_S:.0f} s")
                step(done, count, wish or "kept")
    return RecordedFrames(out, done, [*chosen.notes, *source.notes()])


class _Chosen:
    """The frames that were kept, small, the first without contact, and the time of the newest."""

    def __init__(self) -> None:
        self.kept: list[FloatArray] = []
        self.notes: list[str] = []
        self.since_s = 0.0
        self._changes: list[float] = []
        self._before: FloatArray | None = None

    def consider(self, image: np.ndarray, time_s: float) -> str:
        """Keep a frame, or say what to do first; "" if it was kept."""
        gray = gray_levels(image)
        small = cv2.resize(gray, None, fx=1 / SHRINK, fy=1 / SHRINK, interpolation=cv2.INTER_AREA).astype(np.float32)
        before, self._before = self._before, small
        if before is None or before.shape != small.shape:
            self.since_s = time_s
            return "keep the sensor free of contact"
        change = float(np.abs(small - before).mean())
        if len(self._changes) < SETTLING:
            self._changes.append(change)
            return "keep the sensor free of contact"
        usual = float(np.median(self._changes))
        if change > STILL * usual + STILL_LEVELS:
            return "hold still"
        if any(np.abs(small - one).mean() < OTHER * usual + OTHER_LEVELS for one in self.kept):
            return "press at another place, lightly or firmly, and hold still"
        if fault := describe_picture(gray):
            if time_s - self.since_s < PATIENCE_S:
                return fault
            if fault not in self.notes:
                self.notes.append(fault)
        self.kept.append(small)
        self.since_s = time_s
        return ""


def describe_picture(gray: np.ndarray) -> str:
    """What is wrong with the light or focus of a picture (H, W) uint8, with the remedy; "" if nothing."""
    if len(np.unique(gray)) <= TWO_LEVELS:
        return ""
    dark, bright = np.percentile(gray, (5, 99))
    if bright < DARKEST:
        return "too dark: raise the exposure, or switch the LEDs on"
    if np.mean(gray >= WHITE) > MOST_WHITE:
        return "too bright: lower the exposure or the LEDs"
    slope = np.hypot(*(cv2.Sobel(gray, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1))))
    if bright - dark > WIDEST_EDGE * gray.shape[1] * np.percentile(slope, 99.5):
        return "blurred: focus the camera on the pins"
    return ""
