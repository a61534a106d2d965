"""The still picture of many frames, and fits of modelled light to its gray levels.

The still picture is the median of the frames. It shows what does not change with the contact.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from scipy.optimize import approx_fprime, least_squares

from scenes.sensor import ResponseSpec, SensorSpec
from twin.camera.projection import pixel_rays
from twin.evaluation.pictures.aligned import SATURATED
from twin.frames.forms import gray_levels

ROBUST_LEVELS = 16.0
"""Residual, in gray levels, above which a pixel has a smaller weight (scale of the soft-L1 loss)."""
SLOPE_STEP = 0.01
"""Step of the numerical derivatives, as a share of a parameter's range. It is large, because models have small jumps at pixel borders."""
BOUND_MARGIN = 0.01
"""Least distance of the fit's start from its bounds, as a share of the range."""
SUBPIXELS = 2
"""Number of places inside a pixel, in each direction, over which a model with small details is averaged."""
Residual = Callable[[np.ndarray], np.ndarray]
"""Function from values (p,) to their misfit (n,) in gray levels."""


@dataclass(frozen=True)
class Still:
    """Median of the frames, and the direction of each pixel's ray.

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

    The ray of a pixel is computed in the gel. The product of refractive index and sine is the same in all layers (Snell's law), which
    gives the tangent in air.
    """
    image = np.median(images, axis=0).astype(np.float32)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    _, direction = pixel_rays(spec.view, np.stack([x, y], axis=-1))
    sine = spec.gel.refractive_index * direction[..., :2]
    tangents = sine / np.sqrt(np.maximum(1 - np.sum(sine**2, axis=-1, keepdims=True), 1e-12))
    return Still(image, gray_levels(image), tangents)


def sample_field(field: np.ndarray, at_px: np.ndarray) -> np.ndarray:
    """Bilinear values of a field (H, W[, k]) at pixels (..., 2); 0 outside the field."""
    x, y = (at_px[..., k].reshape(len(at_px), -1).astype(np.float32) for k in (0, 1))
    found = cv2.remap(field.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return found.reshape(at_px.shape[:-1] + field.shape[2:]).astype(float)


def level_misfit(light: np.ndarray, real: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Difference of modelled light from a picture, in gray levels.

    A saturated pixel is only a lower limit: it has a misfit if the modelled light is too small, and none if it is too large.

    Parameters
    ----------
    light : (..., 3) or (..., 1) float
        Linear light in the renderer's unit. White balance applies to three channels only.
    real : same shape as ``light``
        Gray levels.
    """
    gain = response.exposure * (np.array(response.white_balance) if np.shape(light)[-1] == 3 else 1.0)
    shown = response.black_level + (255 - response.black_level) * np.maximum(gain * light, 1e-9) ** (1 / response.gamma)
    return np.where(real < SATURATED, shown - real, np.minimum(shown - SATURATED, 0))


def fit_bounded(residual: Residual, start: np.ndarray, low: np.ndarray, high: np.ndarray, *, most_steps: int = 40) -> np.ndarray:
    """Values (p,) between ``low`` and ``high`` with the least soft-L1 misfit.

    The fit uses the share of each range (0 at ``low``, 1 at ``high``), so that all parameters have the same scale.
    """
    span = high - low

    def at(share: np.ndarray) -> np.ndarray:
        return residual(low + share * span)

    slopes = partial(approx_fprime, f=at, epsilon=SLOPE_STEP)
    first = np.clip((start - low) / span, BOUND_MARGIN, 1 - BOUND_MARGIN)
    fit = least_squares(at, first, slopes, (0, 1), loss="soft_l1", f_scale=ROBUST_LEVELS, max_nfev=most_steps, xtol=1e-4, ftol=1e-5)
    return low + fit.x * span


def subpixel_offsets() -> np.ndarray:
    """(SUBPIXELS, SUBPIXELS, 2) px: evenly spread places in a pixel, relative to its centre."""
    fine = (np.arange(SUBPIXELS) - (SUBPIXELS - 1) / 2) / SUBPIXELS
    return np.stack(np.meshgrid(fine, fine), axis=-1)
