"""Reading of real frames, with checks: frames must be raw, have one size, be neither dark nor saturated, and show (nearly) all pins."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.projection import Disc
from twin.errors import FrameError, format_count
from twin.frames import open_recording, spread_indices
from twin.frames.forms import gray_levels
from twin.frames.recording import BadFrame
from twin.pins.pipeline import Pipeline
from twin.progress import Step, report_each, unheard
from twin.types import Form, Frame, Observation

# A frame counts as dark if this percentile of the disc's gray levels is at most this level.
DARK_LEVEL, BRIGHT_PERCENTILE = 40.0, 99.0
# Least gray level of a saturated pixel, and largest share of saturated pixels in the disc.
SATURATED_LEVEL, MOST_SATURATED = 250, 0.1
FEW_LOST = 0.03
"""Largest fraction of the visible pins that may be missing in a frame, if light and skin are fitted to the other pins. A glint or a dark
cap at the rim may hide a pin."""


@dataclass(frozen=True)
class RealFrame:
    """A real frame and the pins found in it.

    Attributes
    ----------
    frame : Frame
    pins_px : (N, 2) float
        Raw-frame px, in the specification's order.
    label : dict of str to float
        The numbers in the frame's row of the recording's table.
    """

    frame: Frame
    pins_px: np.ndarray
    label: dict[str, float]

    @property
    def gray(self) -> np.ndarray:
        """(H, W) uint8."""
        return gray_levels(self.frame.image)

    def like(self, rendered: np.ndarray) -> np.ndarray:
        """The frame (H, W) or (H, W, 3) uint8 with as many channels as a rendered one."""
        return self.frame.image if rendered.ndim == self.frame.image.ndim else self.gray


@dataclass(frozen=True)
class RealFrames:
    """The usable frames of a folder; ``refused``: ``image_name`` and ``reason`` of the others."""

    frames: list[RealFrame]
    refused: list[BadFrame] = field(default_factory=list)


def read_real(
    path: Path, spec: SensorSpec, disc: Disc, *, limit: int | None = None, fitted: int = 0, lost: float = 0.0, progress: Step = unheard
) -> RealFrames:
    """Read raw frames. If there are more than ``limit``, a selection that is evenly distributed over the recording is read.

    Parameters
    ----------
    limit : int, optional
    fitted : int
        Limit with which a specification was fitted. The frames that would be read with this limit are omitted.
    lost : float
        Largest fraction of the visible pins that may be missing in a frame. The missing pins are NaN.

    Raises
    ------
    FrameError
        The folder does not exist, or it has no raw frames, or none that can be used. The message names the first one and the reason.
    """
    recording = open_recording(path, spec)
    if recording.form is not Form.RAW:
        raise FrameError(
            f"{path}: these are thresholded recordings; light, colours and pictures show in raw camera frames only, give a folder of those"
        )
    pipeline = Pipeline(spec, Form.RAW)
    left = np.setdiff1d(np.arange(len(recording)), spread_indices(len(recording), fitted))
    if not len(left):
        raise FrameError(f"{path}: no frame is left without the {fitted} fitted ones; give a folder with more frames")
    chosen = left[spread_indices(len(left), len(left) if limit is None else limit)].tolist()
    frames: list[RealFrame] = []
    refused: list[BadFrame] = []
    for index in report_each(chosen, progress):
        name = recording.names[index]
        try:
            frame = recording.read(index)
            observation = check_frame(frame, pipeline, disc, lost)
        except FrameError as error:
            refused.append({"image_name": name, "reason": str(error).removeprefix(f"{name}: ")})
        else:
            numbers = {key: float(c[index]) for key, c in recording.labels.items() if c.dtype.kind == "f"}
            frames.append(RealFrame(frame, observation.pins_px, numbers))
    if not frames:
        first, given = refused[0], format_count(len(chosen), "frames")
        raise FrameError(f"{path}: none of {given} are valid; the first, {first['image_name']}: {first['reason']}")
    return RealFrames(frames, refused)


def check_frame(frame: Frame, pipeline: Pipeline, disc: Disc, lost: float = 0.0) -> Observation:
    """Check that a frame can be compared, and return its observation. At most the fraction ``lost`` of its pins may be missing.

    Raises
    ------
    FrameError
        The frame is too dark or saturated, or pins are missing. The message names the frame and the reason.
    """
    if frame.image.shape[:2] == disc.inside.shape:
        levels = gray_levels(frame.image)[disc.inside]
        bright, saturated = np.percentile(levels, BRIGHT_PERCENTILE), float(np.mean(levels >= SATURATED_LEVEL))
        if bright < DARK_LEVEL:
            raise FrameError(f"{frame.name}: black (99 % of the disc is below level {bright:.0f}); check the LEDs and the exposure")
        if saturated > MOST_SATURATED:
            raise FrameError(f"{frame.name}: saturated ({saturated:.0%} of the disc); record it with a shorter exposure")
    observation = pipeline(frame)
    least = int(np.ceil((1 - lost) * observation.expected))
    if observation.found < least or not observation.valid:
        needed = f"{least} are needed" if lost else "all are needed"
        why = observation.reason or f"{observation.found} of {observation.expected} pins found, {needed}"
        raise FrameError(f"{frame.name}: {why}; leave it out, or give the right `sensor`")
    return observation
