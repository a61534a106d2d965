"""Degradations of the camera's chip, the stream and the recorder, and wrong settings: the camera's window, the pipeline's threshold."""

import cv2
import numpy as np

from scenes.sensor import ResponseSpec
from twin.camera.capture import compressed
from twin.evaluation.degradation.condition import OnSection, PictureView, choose_share, in_family
from twin.pins import DetectorSpec


def darker(response: ResponseSpec, value: float, rng: np.random.Generator) -> ResponseSpec:
    """Less exposure."""
    return response.alter(exposure=response.exposure * 2.0**-value)


def brighter(response: ResponseSpec, value: float, rng: np.random.Generator) -> ResponseSpec:
    """More exposure."""
    return response.alter(exposure=response.exposure * 2.0**value)


def noisier(response: ResponseSpec, value: float, rng: np.random.Generator) -> ResponseSpec:
    """More read and shot noise."""
    return response.alter(read_noise=float(np.hypot(response.read_noise, value)))


def jpeg(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Stronger JPEG compression."""
    return compressed(image, max(100 - round(value), 1))


def coarser(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A lower resolution. The picture is enlarged to the frame's size again, because the pipeline expects that size."""
    height, width = image.shape[:2]
    small = cv2.resize(image, (max(round(width / value), 8), max(round(height / value), 8)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def rows_lost(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Lost rows: each shows the last row that arrived before it."""
    lost = choose_share(len(image), value, rng)
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(image))))
    return image[last]


def hot(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Pixels that are stuck at white."""
    image = image.copy()
    image[rng.random(image.shape[:2]) < value] = 255
    return image


def posterised(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Loss of the lowest bits. With a fraction of a bit the steps between levels are wider by that power of two."""
    step = 2.0**value
    return np.clip(np.floor(image / step) * step, 0, 255).astype(np.uint8)


def offset_px(value: float, view: PictureView) -> tuple[int, int]:
    """Displacement (x, y) in whole px by a share of the disc's radius."""
    by = value * view.radius_px
    return round(0.8 * by), round(-0.6 * by)


def wrong_crop(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """The camera's window is at another place: the picture is displaced, and black outside of the original window."""
    dx, dy = offset_px(value, view)
    return cv2.warpAffine(image, np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]]), image.shape[1::-1], flags=cv2.INTER_NEAREST)


def displaced(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Places in a wrongly cropped picture."""
    return px + np.array(offset_px(value, view))


def too_strict(detector: DetectorSpec, value: float) -> DetectorSpec:
    """A threshold that misses pins."""
    return detector.stricter(value)


def too_lax(detector: DetectorSpec, value: float) -> DetectorSpec:
    """A threshold that takes other things for pins."""
    return detector.stricter(-value)


_electronics, _settings = in_family("electronics", image_level=True), in_family("settings", image_level=True)
CONDITIONS = (
    _electronics("exposure-low", "exposure or gain too low", "light lost", "stops", 9.0, spec=OnSection("response", darker)),
    _electronics("exposure-high", "exposure or gain too high", "light gained", "stops", 9.0, spec=OnSection("response", brighter)),
    _electronics("noise", "sensor noise", "sd of the light, in saturations", "", 0.4, spec=OnSection("response", noisier)),
    _electronics("jpeg", "JPEG compression", "100 less the quality", "", 99.0, frame=jpeg),
    _electronics("resolution", "low resolution", "pixels merged, each way", "px", 9.0, 1.0, frame=coarser),
    _electronics("rows-dropped", "dropped rows", "share of the rows", "", 0.9, frame=rows_lost),
    _electronics("hot-pixels", "hot pixels", "share of the pixels", "", 0.1, frame=hot),
    _electronics("posterised", "posterised levels", "bits lost", "bit", 7.5, frame=posterised),
    _settings("wrong-crop", "wrong crop", "displacement, of the disc's radius", "", 0.9, frame=wrong_crop, moves=displaced),
    _settings("threshold-strict", "threshold too strict", "gray levels", "", 120.0, setting=too_strict),
    _settings("threshold-lax", "threshold too lax", "gray levels", "", 60.0, setting=too_lax),
)
