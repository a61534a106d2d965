"""The capture side: from light on the film to the frames a camera and its recorder deliver."""

import cv2
import numpy as np

from scenes.sensor import RecordingSpec, ResponseSpec
from twin.errors import FrameError

MEDIAN_PX = 5  # the recorder's own despeckling before its threshold


def expose(linear: np.ndarray, response: ResponseSpec, rng: np.random.Generator | None = None) -> np.ndarray:
    """What the camera makes of the light: a raw frame.

    Blur (defocus and optics) acts on light, then ``gray = black + (255 - black) * clip(exposure * balance * light)^(1 / gamma)``,
    then noise. Its sd is one number in gray levels: measured over time in real frames it hardly depends on the level,
    the response curve compressing the shot noise of bright pixels.

    Parameters
    ----------
    linear : (H, W, 3) or (H, W) float
    response : ResponseSpec
        White balance applies to colour only.
    rng : numpy.random.Generator, optional
        Source of the noise; no noise without it.

    Returns
    -------
    (H, W, 3) or (H, W) uint8
    """
    light = np.asarray(linear, np.float32)
    if response.blur_sigma_px > 0:
        light = cv2.GaussianBlur(light, (0, 0), response.blur_sigma_px, borderType=cv2.BORDER_REPLICATE)
    gain = response.exposure * (np.array(response.white_balance, np.float32) if light.ndim == 3 else 1.0)
    gray = response.black_level + (255 - response.black_level) * np.clip(gain * light, 0, 1) ** (1 / response.gamma)
    if rng is not None and response.noise_sd > 0:
        gray = gray + response.noise_sd * rng.standard_normal(gray.shape, dtype=np.float32)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def record(raw: np.ndarray, recording: RecordingSpec, *, origin_px: tuple[int, int] = (0, 0)) -> np.ndarray:
    """A raw frame as the recorder stores it: crop, gray, median, adaptive Gaussian threshold, area resize.

    This is the preprocessing camera of the makers' capture software (``CvPreprocVideoCamera``). Where the
    stored size differs from the crop's, the binary image gets gray edges from the resize.

    Parameters
    ----------
    raw : (H, W, 3) or (H, W) uint8
        RGB or gray.
    recording : RecordingSpec
    origin_px : (x, y)
        Place of ``raw``'s first pixel in the camera's full frame, where only a part was rendered.

    Raises
    ------
    FrameError
        If the crop does not lie within the frame.
    """
    x0, y0, x1, y1 = np.array(recording.crop_px) - [*origin_px, *origin_px]
    height, width = raw.shape[:2]
    if x0 < 0 or y0 < 0 or x1 > width or y1 > height:
        raise FrameError(f"recording.crop_px {recording.crop_px} does not fit a {width} x {height} px frame that starts at {origin_px}")
    gray = cv2.cvtColor(raw, cv2.COLOR_RGB2GRAY) if raw.ndim == 3 else raw
    calm = cv2.medianBlur(np.ascontiguousarray(gray[y0:y1, x0:x1]), MEDIAN_PX)
    block, offset = recording.threshold_block_px, recording.threshold_offset
    binary = cv2.adaptiveThreshold(calm, 255, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY, block, offset)
    size = (recording.width_px, recording.height_px)
    return binary if binary.shape[::-1] == size else cv2.resize(binary, size, interpolation=cv2.INTER_AREA)
