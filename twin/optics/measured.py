"""Pictures of measured signed values: red, green and blue as 8-bit levels that are fine near zero."""

import base64

import cv2
import numpy as np

from twin.errors import FrameError
from twin.types import FloatArray

MIDDLE, STEPS = 128, 127
"""Level of the value 0, and number of levels on either side."""
QUALITY = 97
"""JPEG quality of a written picture. Its errors are below those of the measured values."""


def picture_of(values: FloatArray, span: float, power: float) -> str:
    """The data URI of values (H, W, 3), clipped to +-span. Level v stands for ``sign(v - 128) span (|v - 128| / 127)^power``."""
    share = np.minimum(np.abs(values) / span, 1) ** (1 / power)
    levels = np.rint(MIDDLE + STEPS * np.sign(values) * share).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, content = cv2.imencode(".jpg", np.ascontiguousarray(levels[..., ::-1]), options)
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode('ascii')}"


def values_of(picture: str, span: float, power: float, what: str) -> FloatArray:
    """The values (H, W, 3) of a picture (see `picture_of`).

    Raises
    ------
    FrameError
        It is no picture; the message begins with ``what``.
    """
    try:
        content = np.frombuffer(base64.b64decode(picture.partition(",")[2], validate=True), np.uint8)
    except ValueError:
        content = np.zeros(0, np.uint8)
    decoded = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    if decoded is None:
        raise FrameError(f"{what}: the picture can't be decoded; give the whole content of a PNG, JPEG or WebP file")
    share = (decoded[..., ::-1].astype(np.float32) - MIDDLE) / STEPS
    return np.asarray(np.sign(share) * np.abs(share) ** np.float32(power) * np.float32(span), np.float32)
