"""Real frames: reading with checks, the light of their gray levels, and frames with the skin fitted to their pins.

Frames must be raw, have one size, be neither dark nor saturated, and show (nearly) all pins. All stages of the calibration use frames with
their fitted skin.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import CameraSpec, ResponseSpec, SensorSpec
from twin.camera.projection import Disc, lens_disc
from twin.errors import FrameError, format_count
from twin.frames import open_recording, spread_indices
from twin.frames.forms import gray_levels
from twin.frames.recording import BadFrame
from twin.mechanics.skin_fit import FittedPins
from twin.pins.pipeline import Pipeline
from twin.progress import Step, report_each, unheard
from twin.types import Form, Frame, Observation

# A frame counts as dark if this percentile of the disc's gray levels is at most this level.
DARK_LEVEL, BRIGHT_PERCENTILE = 40.0, 99.0
# Gray level from which on a pixel counts as saturated, and largest share of such pixels in the disc.
SATURATED, MOST_SATURATED = 250, 0.1
FEW_LOST = 0.03
"""Largest fraction of the visible pins that may be missing in a frame, if light and skin are fitted to the other pins. A glint or a dark
cap at the rim may hide a pin."""
# Frames that do not have the camera's channels: their kind, the camera's, and a remedy.
OTHER_CHANNELS = {"color": ("colour", "is mono", "convert the frames to gray"), "mono": ("gray", "has colour", "give the colour frames")}


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


def read_real(
    path: Path, spec: SensorSpec, disc: Disc, *, limit: int | None = None, fitted: int = 0, lost: float = 0.0, progress: Step = unheard
) -> tuple[list[RealFrame], list[BadFrame]]:
    """Usable raw frames of a folder, and the refused ones. Of more than ``limit``, an even selection over the recording is read.

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
    return frames, refused


def check_frame(frame: Frame, pipeline: Pipeline, disc: Disc, lost: float = 0.0) -> Observation:
    """Check that a frame can be compared, and return its observation. At most the fraction ``lost`` of its pins may be missing.

    Raises
    ------
    FrameError
        The frame is too dark or saturated, or pins are missing. The message names the frame and the reason.
    """
    if frame.image.shape[:2] == disc.inside.shape:
        levels = gray_levels(frame.image)[disc.inside]
        bright, saturated = np.percentile(levels, BRIGHT_PERCENTILE), float(np.mean(levels >= SATURATED))
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


@dataclass(frozen=True)
class Aligned:
    """A real frame and its pins in space.

    Attributes
    ----------
    name : str
    image : (H, W, 3) or (H, W) uint8
    pins_px : (N, 2) float
        Raw-frame px, in the specification's order.
    state : FittedPins
        Pins of the fitted skin.
    """

    name: str
    image: np.ndarray
    pins_px: np.ndarray
    state: FittedPins


def read_frames(
    folder: Path, spec: SensorSpec, limit: int, progress: Step
) -> tuple[list[tuple[str, np.ndarray, np.ndarray]], list[BadFrame]]:
    """Read usable frames of a folder, spread evenly: name, image (H, W[, 3]) uint8 and pins (N, 2) px of each; and the refused ones.

    A frame may lack a few pins (``FEW_LOST``), which are NaN.

    Raises
    ------
    FrameError
        No frame can be used, or a frame does not fit the camera: its size differs, or one of both is colour and the other mono. The
        message names the first such frame and the reason.
    """
    real, refused = read_real(folder, spec, lens_disc(spec.view, spec.housing), limit=limit, lost=FEW_LOST, progress=progress)
    read = [(found.frame.name, in_channels(found.frame.image, spec.camera), found.pins_px) for found in real]
    for name, image, _ in read:
        require_cameras_own(image, name, spec.camera)
    return read, refused


def in_channels(image: np.ndarray, camera: CameraSpec) -> np.ndarray:
    """A frame (H, W[, C]) with one channel for a mono camera, if its channels are alike: files often hold gray frames as colour."""
    alike = image.ndim == 3 and bool((image == image[..., :1]).all())
    return image[..., 0] if alike and camera.channels == "mono" else image


def require_cameras_own(image: np.ndarray, name: str, camera: CameraSpec) -> None:
    """Raise ``FrameError`` if an image does not have the camera's size and channels, because it could not be compared with renders."""
    height, width = image.shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        own = f"{camera.width_px} x {camera.height_px}"
        raise FrameError(f"{name}: {width} x {height} px, the specification's camera has {own}; give frames as they come")
    channels = "color" if image.ndim == 3 and image.shape[2] == 3 else "mono"
    if channels != camera.channels:
        kind, camera_is, remedy = OTHER_CHANNELS[channels]
        set_it = f'set channels = "{channels}" under [camera]'
        raise FrameError(f"{name}: a {kind} frame, but the specification's camera {camera_is}; {set_it}, or {remedy}")


def to_light(levels: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Light in the renderer's unit from gray levels, by the inverse of response curve, white balance and exposure."""
    share = np.clip((np.asarray(levels, float) - response.black_level) / (255 - response.black_level), 0, 1)
    return share**response.gamma / _gain(levels, response)


def to_levels(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Gray levels (float, not rounded) from light: the inverse of ``to_light``."""
    return response.black_level + (255 - response.black_level) * np.clip(_gain(light, response) * light, 0, 1) ** (1 / response.gamma)


def levels_slope(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Derivative of ``to_levels`` by the light; it is finite in the dark."""
    gain = _gain(light, response)
    share = np.clip(gain * light, 1e-6, 1)
    return (255 - response.black_level) / response.gamma * share ** (1 / response.gamma - 1) * gain


def _gain(values: np.ndarray, response: ResponseSpec) -> float | np.ndarray:
    """Factor on the light before the response curve: exposure, and white balance if the last axis has the three colours."""
    colour = np.ndim(values) and np.shape(values)[-1] == 3
    return response.exposure * (np.array(response.white_balance) if colour else 1.0)


def with_changes(spec: SensorSpec, **sections: Mapping[str, Any]) -> SensorSpec:
    """A validated copy with values changed section by section (``camera={"k1": 0.1}``)."""
    data = spec.model_dump()
    for name, values in sections.items():
        data[name] = data[name] | values
    return SensorSpec.model_validate(data)
