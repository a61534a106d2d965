"""Video streams of luma and colour differences, as cameras send them, and the 8-bit colours that come out of them.

Studio range: luma from 16 to 235, colour differences from 16 to 240. The way back is the usual integer arithmetic
(products with 256 times the coefficients, rounded), so that only about 18 % of all colours ever appear in such a frame.
"""

import numpy as np

from twin.types import BoolArray, FloatArray, ImageArray, IntArray

RED_BLUE = {"rgb": (0.299, 0.114), "bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}
"""Shares of red and blue in the luma, by stream (ITU-R BT.601 and BT.709)."""
STREAMS = ("bt601", "bt709")
"""Streams that can be told from the colours of a frame."""
LUMA_RANGE = 219
"""Studio range: number of steps of the luma."""
CHROMA_RANGE = 224
"""Studio range: number of steps of a colour difference."""
LUMA_FLOOR = 16
"""Studio range: luma of black."""
CHROMA_MIDDLE = 128
"""Studio range: colour difference of gray."""
ON_STREAM = 0.98
"""A frame came by a stream if at least this share of its pixels has colours that the stream can give."""
CLIPPED = (2, 253)
"""Pixels with a level at or beyond these are left out: their colours may have been cut off."""
MOST_PIXELS = 20_000
"""At most this many pixels are looked at."""


def luma_weights(stream: str) -> FloatArray:
    """(3,) shares of red, green and blue in the luma."""
    red, blue = RED_BLUE[stream]
    return np.array([red, 1 - red - blue, blue], np.float32)


def encoded(gray: FloatArray, stream: str) -> IntArray:
    """Whole numbers (..., 3) of luma, blue and red difference, of gray levels (..., 3)."""
    weights = luma_weights(stream)
    luma = gray @ weights
    difference = [(gray[..., k] - luma) * (0.5 / (1 - weights[k]) * CHROMA_RANGE / 255) + CHROMA_MIDDLE for k in (2, 0)]
    return np.clip(np.rint(np.stack([luma * (LUMA_RANGE / 255) + LUMA_FLOOR, *difference], axis=-1)), 0, 255).astype(np.int32)


def decoded(numbers: IntArray, stream: str) -> ImageArray:
    """Colours (..., 3) uint8 of luma and colour differences (..., 3)."""
    red, green, blue = (float(w) for w in luma_weights(stream))
    gain, difference = round(256 * 255 / LUMA_RANGE), 256 * 255 / CHROMA_RANGE
    luma = gain * (numbers[..., 0] - LUMA_FLOOR) + 128
    b, r = (numbers[..., k] - CHROMA_MIDDLE for k in (1, 2))
    to_red, to_blue = 2 * (1 - red) * difference, 2 * (1 - blue) * difference
    from_blue, from_red = round(to_blue * blue / green), round(to_red * red / green)
    colours = np.stack([luma + round(to_red) * r, luma - from_blue * b - from_red * r, luma + round(to_blue) * b], axis=-1)
    return np.clip(colours >> 8, 0, 255).astype(np.uint8)


def through_stream(gray: FloatArray, stream: str) -> ImageArray:
    """Colours (H, W, 3) uint8 that gray levels (H, W, 3) leave a stream with; "rgb": only rounded."""
    if stream == "rgb":
        return np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return decoded(encoded(np.clip(gray, 0, 255), stream), stream)


def stream_of(images: list[ImageArray]) -> str:
    """The stream that frames (H, W, 3) uint8 came by, told by which colours they have; "rgb" where none explains them."""
    pixels = np.concatenate([image.reshape(-1, 3) for image in images if image.ndim == 3] or [np.zeros((0, 3), np.uint8)])
    pixels = pixels[((pixels > CLIPPED[0]) & (pixels < CLIPPED[1])).all(axis=1)]
    pixels = pixels[:: max(len(pixels) // MOST_PIXELS, 1)]
    if not len(pixels):
        return "rgb"
    shares = {stream: float(_possible(pixels, stream).mean()) for stream in STREAMS}
    best = max(shares, key=lambda stream: shares[stream])
    return best if shares[best] >= ON_STREAM else "rgb"


def _possible(pixels: ImageArray, stream: str) -> BoolArray:
    """(n,) bool: colours (n, 3) that the stream can give."""
    near = encoded(pixels.astype(np.float32), stream)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 1, 3)
    return (decoded(near + steps, stream) == pixels).all(axis=2).any(axis=0)
