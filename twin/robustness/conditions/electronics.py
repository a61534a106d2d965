"""What goes wrong in chip, stream and recorder."""

import cv2
import numpy as np

from twin.camera import compressed
from twin.robustness.condition import Condition, View, chosen, revised


def darker(spec, value, rng):
    return revised(spec, response={"exposure": spec.response.exposure * 2.0**-value})


def brighter(spec, value, rng):
    return revised(spec, response={"exposure": spec.response.exposure * 2.0**value})


def noisier(spec, value, rng):
    return revised(spec, response={"read_noise": float(np.hypot(spec.response.read_noise, value))}) if value else spec


def jpeg(image, value, view: View, rng):
    return compressed(image, max(100 - round(value), 1)) if value else image


def coarser(image, value, view: View, rng):
    """Fewer pixels, drawn up again to the frame's size as a pipeline that expects it would."""
    if value == 1:
        return image
    height, width = image.shape[:2]
    small = cv2.resize(image, (max(round(width / value), 8), max(round(height / value), 8)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


def rows_lost(image, value, view: View, rng):
    """Lost rows show the last one that came."""
    lost = chosen(len(image), value, rng)
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(len(image))))
    return image[last] if value else image


def hot(image, value, view: View, rng):
    if not value:
        return image
    image = image.copy()
    image[rng.random(image.shape[:2]) < value] = 255
    return image


def posterised(image, value, view: View, rng):
    """The lowest bits lost, a fractional number of them by wider steps."""
    step = 2.0**value
    return np.clip(np.floor(image / step) * step, 0, 255).astype(np.uint8) if value else image


_IMAGE = {"image_level": True}
CONDITIONS = (
    Condition("exposure-low", "exposure or gain too low", "electronics", "light lost", "stops", 9.0, spec=darker, **_IMAGE),
    Condition("exposure-high", "exposure or gain too high", "electronics", "light gained", "stops", 9.0, spec=brighter, **_IMAGE),
    Condition("noise", "sensor noise", "electronics", "sd of the light, in saturations", "", 0.4, spec=noisier, **_IMAGE),
    Condition("jpeg", "JPEG compression", "electronics", "100 less the quality", "", 99.0, frame=jpeg, **_IMAGE),
    Condition("resolution", "low resolution", "electronics", "pixels merged, each way", "px", 9.0, 1.0, frame=coarser, **_IMAGE),
    Condition("rows-dropped", "dropped rows", "electronics", "share of the rows", "", 0.9, frame=rows_lost, **_IMAGE),
    Condition("hot-pixels", "hot pixels", "electronics", "share of the pixels", "", 0.1, frame=hot, **_IMAGE),
    Condition("posterised", "posterised levels", "electronics", "bits lost", "bit", 7.5, frame=posterised, **_IMAGE),
)
