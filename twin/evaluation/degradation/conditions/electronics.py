"""Degradations of the camera's chip, the stream and the recorder."""

import cv2
import numpy as np

from scenes.sensor import ResponseSpec
from twin.camera.capture import compressed
from twin.evaluation.degradation.condition import OnSection, PictureView, choose_share, in_family


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


_condition = in_family("electronics", image_level=True)
CONDITIONS = (
    _condition("exposure-low", "exposure or gain too low", "light lost", "stops", 9.0, spec=OnSection("response", darker)),
    _condition("exposure-high", "exposure or gain too high", "light gained", "stops", 9.0, spec=OnSection("response", brighter)),
    _condition("noise", "sensor noise", "sd of the light, in saturations", "", 0.4, spec=OnSection("response", noisier)),
    _condition("jpeg", "JPEG compression", "100 less the quality", "", 99.0, frame=jpeg),
    _condition("resolution", "low resolution", "pixels merged, each way", "px", 9.0, 1.0, frame=coarser),
    _condition("rows-dropped", "dropped rows", "share of the rows", "", 0.9, frame=rows_lost),
    _condition("hot-pixels", "hot pixels", "share of the pixels", "", 0.1, frame=hot),
    _condition("posterised", "posterised levels", "bits lost", "bit", 7.5, frame=posterised),
)
