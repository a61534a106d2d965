"""Conversion of light on the film to the frames that a camera and its recorder deliver.

Cameras send luma and colour differences, which the computer converts to 8-bit colours. Luma is in the studio range 16 to 235, colour
differences are in 16 to 240. The conversion uses the usual integer arithmetic (products with 256 times the coefficients, rounded). Only
about 18 % of all 8-bit colours can be the result.
"""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from scenes.body import GelSpec
from scenes.sensor import CameraSpec, CaptureSpec, RecordingSpec, ResponseSpec
from twin.camera.residual import refine
from twin.errors import FrameError
from twin.types import BoolArray, FloatArray, Form, Frame, ImageArray, IntArray

RED_BLUE = {"rgb": (0.299, 0.114), "bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}
"""Shares of red and blue in the luma, by stream (ITU-R BT.601 and BT.709)."""
STREAMS = ("bt601", "bt709")
"""Streams that can be recognised by the colours of a frame."""
LUMA_RANGE = 219
"""Studio range: number of steps of the luma."""
CHROMA_RANGE = 224
"""Studio range: number of steps of a colour difference."""
LUMA_FLOOR = 16
"""Studio range: luma of black."""
CHROMA_MIDDLE = 128
"""Studio range: colour difference of gray."""
ON_STREAM = 0.98
"""Least share of a frame's pixels whose colours a stream can produce, for the frame to be recognised as sent by this stream."""
CLIPPED = (2, 253)
"""Gray levels at or beyond which a pixel is not used to recognise a stream, because its colour may be clipped."""
MOST_PIXELS = 20_000
"""Most pixels that are used to recognise a stream."""
WIDE_PX = 8.0
"""Standard deviation, px, above which a blur is computed with the few cosines that it leaves, not with a kernel."""
LEAST_KEPT = 1e-5
"""Least share of its size that a cosine must keep after a blur. Other cosines are left out."""
JPEG_BLOCK_PX = 16
"""Side of the blocks of a JPEG whose chroma has half the resolution."""
WEIGHTS = {"gaussian": cv2.ADAPTIVE_THRESH_GAUSSIAN_C, "mean": cv2.ADAPTIVE_THRESH_MEAN_C}
"""OpenCV's names of the averages that a recorder's threshold may use."""


def expose(
    linear: FloatArray, capture: CaptureSpec, rng: np.random.Generator | None = None, *, origin_px: tuple[int, int] = (0, 0)
) -> ImageArray:
    """The raw frame that gel, lens and camera make of the light.

    Gel haze, lateral chromatic aberration, blur and vignetting act on light. They are followed by gain, sharpening of the luma, the
    response curve, loss of colour detail, the video stream and its compression (`GelSpec`, `CameraSpec`, `ResponseSpec`). Noise is added
    to the sharpened light, and is not sharpened itself. If a residual network is switched on, it acts before the stream. A step whose
    parameter is neutral changes nothing.

    Parameters
    ----------
    linear : (H, W, 3) or (H, W) float
        Chromatic aberration and white balance apply to colour only.
    capture : CaptureSpec
    rng : numpy.random.Generator, optional
        Source of the frame's random gain and noise; without it the frame has neither.
    origin_px : (x, y)
        Place of ``linear``'s first pixel in the camera's full frame, if only a part was rendered.

    Returns
    -------
    (H, W, 3) or (H, W) uint8
    """
    response = capture.response
    residual = response.residual if response.residual is not None and response.residual.used and np.ndim(linear) == 3 else None
    gray = before_stream(linear, capture, rng, origin_px=origin_px, columns=1 if residual else response.chroma_columns)
    if residual is not None:
        gray = refine(gray, residual, luma_weights(response.stream), response.chroma_columns, rng, origin_px)
    frame = through_stream(gray, response.stream) if gray.ndim == 3 else np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return compressed(frame, response.jpeg_quality, origin_px)


def before_stream(
    linear: FloatArray, capture: CaptureSpec, rng: np.random.Generator | None, *, origin_px: tuple[int, int] = (0, 0), columns: int = 1
) -> FloatArray:
    """Gray levels (H, W[, 3]) float after gel, lens, noise and response curve, before a stream rounds them; parameters as for ``expose``.

    Groups of ``columns`` columns share colour differences.
    """
    camera, response = capture.camera, capture.response
    light = hazed(np.asarray(linear, np.float32), capture.gel)
    light = dispersed(light, camera, origin_px)
    light = blurred(light, response.blur_sigma_px)
    light = vignetted(light, camera, origin_px)
    light = amplified(light, response, rng)
    return developed(light, noisy(light, response, rng), response, columns, origin_px)


def hazed(light: FloatArray, gel: GelSpec) -> FloatArray:
    """Light after the gel has scattered a share of it forward."""
    if gel.haze == 0:
        return light
    return light + np.float32(gel.haze) * (blurred(light, gel.haze_sigma_px) - light)


def dispersed(light: FloatArray, camera: CameraSpec, origin_px: tuple[int, int] = (0, 0)) -> FloatArray:
    """Lateral chromatic aberration: ``red'(c + scale (p - c) + shift) = red(p)`` with c the principal point; blue alike."""
    own = ((0, camera.red_scale, camera.red_shift_px), (2, camera.blue_scale, camera.blue_shift_px))
    moved = [(channel, scale, shift) for channel, scale, shift in own if light.ndim == 3 and (scale != 1 or any(shift))]
    light = light.copy() if moved else light
    for channel, scale, shift in moved:
        across = _scaled(np.ascontiguousarray(light[..., channel].T), scale, camera.cx_px - origin_px[0], shift[0])
        light[..., channel] = _scaled(np.ascontiguousarray(across.T), scale, camera.cy_px - origin_px[1], shift[1])
    return light


def blurred(light: FloatArray, sigma_px: float) -> FloatArray:
    """Gaussian blur. The frame is mirrored at its border, so that the sum of the light stays the same."""
    if sigma_px <= 0:
        return light
    if sigma_px < WIDE_PX:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT), light.dtype)
    height, width = light.shape[:2]
    (down, up), (across, back) = _wide_blur(height, sigma_px), _wide_blur(width, sigma_px)
    rows = back @ (across @ (down @ light.reshape(height, -1)).reshape(len(down), width, -1))
    return np.asarray((up @ rows.reshape(len(down), -1)).reshape(light.shape), light.dtype)


@lru_cache(maxsize=16)
def _wide_blur(length: int, sigma_px: float) -> tuple[FloatArray, FloatArray]:
    """A Gaussian blur of a mirrored line of pixels as two matrices, (m, length) and (length, m), that are applied one after the other.

    The cosines of the DCT-II are the eigenvectors of such a blur. Their eigenvalues ``exp(-(sigma w)^2 / 2)`` fall so fast that few count.
    """
    w = np.pi * np.arange(length) / length
    kept = np.exp(-0.5 * (sigma_px * w) ** 2)
    w, kept = w[kept > LEAST_KEPT], kept[kept > LEAST_KEPT]
    waves = np.cos(w[:, None] * (np.arange(length) + 0.5)) * np.sqrt(np.where(w == 0, 1, 2) / length)[:, None]
    return (kept[:, None] * waves).astype(np.float32), np.ascontiguousarray(waves.T, np.float32)


def vignetted(light: FloatArray, camera: CameraSpec, origin_px: tuple[int, int] = (0, 0)) -> FloatArray:
    """Light times ``1 - vignetting r^2``, r the distance from the full frame's middle over that of its corners."""
    if camera.vignetting == 0:
        return light
    x = origin_px[0] + np.arange(light.shape[1]) - (camera.width_px - 1) / 2
    y = origin_px[1] + np.arange(light.shape[0]) - (camera.height_px - 1) / 2
    r2 = 4 * (x**2 + y[:, None] ** 2) / (camera.width_px**2 + camera.height_px**2)
    loss = (1 - camera.vignetting * r2).astype(np.float32)
    return light * (loss[..., None] if light.ndim == 3 else loss)


def amplified(light: FloatArray, response: ResponseSpec, rng: np.random.Generator | None = None) -> FloatArray:
    """Light times exposure, white balance (colour only) and, with a generator, the frame's random gain."""
    gain = response.exposure * np.array(response.white_balance if light.ndim == 3 else 1.0)
    if rng is not None and response.brightness_drift > 0:
        gain = gain * max(1 + response.brightness_drift * rng.standard_normal(), 0)
    return light if np.all(gain == 1) else light * gain.astype(np.float32)


def noisy(light: FloatArray, response: ResponseSpec, rng: np.random.Generator | None = None) -> FloatArray:
    """Normal noise of variance ``read_noise^2 + shot_noise * light``; none without a generator."""
    if rng is None or (response.read_noise == 0 and response.shot_noise == 0):
        return light
    sd = np.sqrt(np.float32(response.read_noise**2) + np.float32(response.shot_noise) * np.maximum(light, 0))
    return light + sd * rng.standard_normal(light.shape, dtype=np.float32)


def curve(light: FloatArray, response: ResponseSpec) -> FloatArray:
    """Gray levels ``black + (255 - black) clip(light)^(1 / gamma)``, not rounded."""
    shown = np.clip(light, 0, 1)
    shown = shown if response.gamma == 1 else shown ** np.float32(1 / response.gamma)
    return np.float32(response.black_level) + np.float32(255 - response.black_level) * shown


def sharpened(light: FloatArray, response: ResponseSpec) -> FloatArray:
    """Light with an unsharp mask of its luma added to every channel. The response curve then amplifies the dark side of edges."""
    if response.sharpening == 0:
        return light
    luma = light @ luma_weights(response.stream) if light.ndim == 3 else light
    mask = np.float32(response.sharpening) * (luma - blurred(luma, response.sharpening_sigma_px))
    return light + (mask[..., None] if light.ndim == 3 else mask)


def developed(light: FloatArray, grainy: FloatArray, response: ResponseSpec, columns: int, origin_px: tuple[int, int]) -> FloatArray:
    """Gray levels of ``light``, with the noise of ``grainy``: all colours are sharpened by their luma, and colour differences are softened.

    The camera does not sharpen the noise. Neighbouring columns of the full frame have the same colour differences.
    """
    gray = curve(sharpened(light, response), response)
    if grainy is not light:
        gray = gray + blurred(curve(grainy, response) - curve(light, response), response.noise_sigma_px)
    if gray.ndim == 2 or (response.chroma_sigma_px == 0 and response.chroma_median_px == 0 and columns == 1):
        return gray
    luma = (gray @ luma_weights(response.stream))[..., None]
    soft = cleaned(blurred(gray - luma, response.chroma_sigma_px), response)
    return shared(soft, columns, origin_px[0]) + luma


def cleaned(chroma: FloatArray, response: ResponseSpec) -> FloatArray:
    """Colour differences (H, W, 3) after a median over squares for red and blue. Green follows, because the luma is not changed."""
    if response.chroma_median_px == 0:
        return chroma
    red, blue = (cv2.medianBlur(np.ascontiguousarray(chroma[..., k], np.float32), response.chroma_median_px) for k in (0, 2))
    of_red, of_green, of_blue = luma_weights(response.stream)
    return np.dstack([red, -(of_red * red + of_blue * blue) / of_green, blue])


def shared(chroma: FloatArray, columns: int, left_px: int = 0) -> FloatArray:
    """Chroma (H, W, 3) in which each group of ``columns`` columns has the chroma of its first column, as 4:2:2 streams sample it.

    The groups begin at the full frame's first column; ``left_px`` is the first column's number in the full frame.
    """
    if columns == 1:
        return chroma
    group = (left_px + np.arange(chroma.shape[1])) // columns
    first = np.searchsorted(group, group)
    return chroma[:, first]


def in_form(frame: Frame, form: Form, recording: RecordingSpec | None) -> Frame:
    """A raw frame as the sensor records it, if the ``form`` asks for that and the recorder is known; other frames as they are."""
    if frame.form == Form.PROCESSED or form == Form.RAW or recording is None:
        return frame
    return replace(frame, image=record(frame.image, recording), form=Form.PROCESSED)


def compressed(frame: ImageArray, quality: int, origin_px: tuple[int, int] = (0, 0)) -> ImageArray:
    """A frame after JPEG compression with halved chroma (quality 0: not compressed). The blocks are aligned with the full frame's."""
    if quality == 0:
        return frame
    left, top = (place % JPEG_BLOCK_PX for place in origin_px)
    whole = cv2.copyMakeBorder(frame, top, 0, left, 0, cv2.BORDER_REPLICATE)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, stream = cv2.imencode(".jpg", whole[..., ::-1] if frame.ndim == 3 else whole, options)
    decoded = cv2.imdecode(stream, cv2.IMREAD_UNCHANGED)
    assert decoded is not None, "OpenCV decodes what it has just encoded"
    back = decoded.astype(np.uint8, copy=False)[top:, left:]
    return np.ascontiguousarray(back[..., ::-1] if frame.ndim == 3 else back)


def record(raw: ImageArray, recording: RecordingSpec, *, origin_px: tuple[int, int] = (0, 0)) -> ImageArray:
    """A raw frame as the recorder stores it: crop, gray, median, adaptive threshold, and an area resize before or after the threshold.

    This is the preprocessing of the sensor group's capture software (``CvPreprocVideoCamera``; the UR5's recordings were resized first
    and not filtered). If a picture is resized after its threshold, and the stored size differs from the crop's, it has gray edges.

    Parameters
    ----------
    raw : (H, W, 3) or (H, W) uint8
        RGB or gray.
    recording : RecordingSpec
    origin_px : (x, y)
        Place of ``raw``'s first pixel in the camera's full frame, if only a part was rendered.

    Raises
    ------
    FrameError
        The crop does not lie within the frame.
    """
    x0, y0, x1, y1 = np.array(recording.crop_px) - [*origin_px, *origin_px]
    height, width = raw.shape[:2]
    if x0 < 0 or y0 < 0 or x1 > width or y1 > height:
        raise FrameError(f"recording.crop_px {recording.crop_px} does not fit a {width} x {height} px frame that starts at {origin_px}")
    gray = cv2.cvtColor(raw, cv2.COLOR_RGB2GRAY) if raw.ndim == 3 else raw
    seen = np.ascontiguousarray(gray[y0:y1, x0:x1]).astype(np.uint8, copy=False)
    if recording.resized == "before":
        return _black_and_white(_of_size(seen, recording), recording)
    return _of_size(_black_and_white(seen, recording), recording)


def _black_and_white(gray: ImageArray, recording: RecordingSpec) -> ImageArray:
    calm = cv2.medianBlur(gray, recording.median_px) if recording.median_px else gray
    average, block = WEIGHTS[recording.threshold_weights], recording.threshold_block_px
    return cv2.adaptiveThreshold(calm, 255, average, cv2.THRESH_BINARY, block, recording.threshold_offset).astype(np.uint8, copy=False)


def _of_size(picture: ImageArray, recording: RecordingSpec) -> ImageArray:
    size = (recording.width_px, recording.height_px)
    stored = picture if picture.shape[::-1] == size else cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return stored.astype(np.uint8, copy=False)


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
    """Colours (H, W, 3) uint8 of gray levels (H, W, 3) after a stream; for "rgb" they are only rounded."""
    if stream == "rgb":
        return np.clip(np.rint(gray), 0, 255).astype(np.uint8)
    return decoded(encoded(np.clip(gray, 0, 255), stream), stream)


def stream_of(images: list[ImageArray]) -> str:
    """The stream by which frames (H, W, 3) uint8 were sent, recognised by their colours; "rgb" if no stream explains them."""
    pixels = np.concatenate([image.reshape(-1, 3) for image in images if image.ndim == 3] or [np.zeros((0, 3), np.uint8)])
    pixels = pixels[((pixels > CLIPPED[0]) & (pixels < CLIPPED[1])).all(axis=1)]
    pixels = pixels[:: max(len(pixels) // MOST_PIXELS, 1)]
    if not len(pixels):
        return "rgb"
    shares = {stream: float(_possible(pixels, stream).mean()) for stream in STREAMS}
    best = max(shares, key=lambda stream: shares[stream])
    return best if shares[best] >= ON_STREAM else "rgb"


def _possible(pixels: ImageArray, stream: str) -> BoolArray:
    """(n,) bool: whether the stream can produce each of the colours (n, 3)."""
    near = encoded(pixels.astype(np.float32), stream)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 1, 3)
    return (decoded(near + steps, stream) == pixels).all(axis=2).any(axis=0)


def _scaled(plane: FloatArray, scale: float, centre: float, shift: float) -> FloatArray:
    """Scale and shift the rows of a plane (n, m) about row ``centre`` by cubic convolution (Keys 1981), which keeps centroids exactly."""
    place = centre + (np.arange(len(plane)) - shift - centre) / scale
    first = np.floor(place).astype(int)
    t = (place - first)[:, None].astype(np.float32)
    taps = (((2 - t) * t - 1) * t / 2, ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2, (t - 1) * t * t / 2)
    return sum(tap * plane[np.clip(first + k - 1, 0, len(plane) - 1)] for k, tap in enumerate(taps))
