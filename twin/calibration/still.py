"""The still picture: what stays in place while contacts come and go, as the median of many frames."""

from dataclasses import dataclass

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.projection import pixel_rays
from twin.recordings.forms import gray_levels


@dataclass(frozen=True)
class Still:
    """Median of the frames, and the direction in which each pixel looks.

    Attributes
    ----------
    image : (H, W, 3) float32
        Gray levels, RGB (three equal channels for gray frames).
    gray : (H, W) float32
        Gray levels.
    tangents : (H, W, 2) float
        x and y of each pixel's ray for one unit along the sensor's z, in the air behind the window.
    """

    image: np.ndarray
    gray: np.ndarray
    tangents: np.ndarray


def median_still(spec: SensorSpec, images: np.ndarray) -> Still:
    """The still picture of frames (M, H, W, 3) uint8 from the camera of ``spec``.

    The ray of a pixel is known in the gel. Index of refraction times sine stays the same at every face of the window
    (Snell), which gives the tangent in air.
    """
    image = np.median(images, axis=0).astype(np.float32)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    _, direction = pixel_rays(spec.view, np.stack([x, y], axis=-1))
    sine = spec.gel.refractive_index * direction[..., :2]
    tangents = sine / np.sqrt(np.maximum(1 - np.sum(sine**2, axis=-1, keepdims=True), 1e-12))
    return Still(image, gray_levels(image), tangents)


def sampled(field: np.ndarray, at_px: np.ndarray) -> np.ndarray:
    """Bilinear values of a field (H, W[, k]) at pixels (..., 2); 0 outside the field."""
    x, y = (at_px[..., k].reshape(len(at_px), -1).astype(np.float32) for k in (0, 1))
    found = cv2.remap(field.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return found.reshape(at_px.shape[:-1] + field.shape[2:]).astype(float)
