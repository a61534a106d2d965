"""The two forms of a sensor's frames, and the way between their pixel coordinates.

A recording is the camera's frame cropped, thresholded and resized at capture, so with crop (x0, y0, x1, y1) and
recorded size (w, h): x_rec = (x_raw - x0 + 0.5) w / (x1 - x0) - 0.5, likewise for y (pixel centres at integers).
"""

import cv2
import numpy as np

from scenes.sensor import BlobSpec, SensorSpec
from twin.errors import FrameError
from twin.types import Form


def _crop_scale(spec: SensorSpec) -> tuple[np.ndarray, np.ndarray]:
    recording = spec.recording
    if recording is None:
        raise FrameError(f"sensor '{spec.name}' has no recording form: its recordings are raw frames; use the raw form")
    x0, y0, x1, y1 = recording.crop_px
    return np.array([x0, y0], float), np.array([recording.width_px / (x1 - x0), recording.height_px / (y1 - y0)])


def raw_to_recording(spec: SensorSpec, raw_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the camera's frame to pixels of the recording."""
    corner, scale = _crop_scale(spec)
    return (np.asarray(raw_px, float) - corner + 0.5) * scale - 0.5


def recording_to_raw(spec: SensorSpec, recording_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the recording to pixels of the camera's frame."""
    corner, scale = _crop_scale(spec)
    return (np.asarray(recording_px, float) + 0.5) / scale + corner - 0.5


def from_raw(spec: SensorSpec, form: Form, raw_px: np.ndarray) -> np.ndarray:
    """Pixels (..., 2) of the camera's frame to pixels of the given form."""
    return raw_to_recording(spec, raw_px) if form == Form.RECORDING else np.asarray(raw_px, float)


def frame_size(spec: SensorSpec, form: Form) -> tuple[int, int]:
    """(width, height) in px of the sensor's frames of a form."""
    if form == Form.RAW:
        return spec.camera.width_px, spec.camera.height_px
    _crop_scale(spec)
    return spec.recording.width_px, spec.recording.height_px


def blob_spec(spec: SensorSpec, form: Form) -> BlobSpec:
    """How pins are found in frames of a form."""
    frame_size(spec, form)
    return spec.pipeline.raw if form == Form.RAW else spec.pipeline.recording


def gray_levels(image: np.ndarray) -> np.ndarray:
    """(H, W) uint8 luminance of a gray or RGB image."""
    if image.ndim == 2:
        return image
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.shape[2] == 3 else image[..., 0]
