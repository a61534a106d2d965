"""Blur of a lens with a finite aperture: circles of confusion, and blurring of a picture with them."""

from functools import lru_cache

import cv2
import numpy as np

from scenes.sensor import ViewSpec
from twin.camera.projection import distort, window_tangent
from twin.compiled import compiled
from twin.types import FloatArray

LEAST_VARIANCE = 0.03
"""Variance of the smallest blur that is not interpolated from a sharp picture, px^2: that of a disc of 0.7 px."""
FINE = 16
"""Number of points along each side of a pixel at which the coverage of the pixel by a disc is evaluated."""
HALVINGS = 12
"""Number of bisection steps in the search of a disc's diameter."""


def circles_px(view: ViewSpec, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Circles of confusion of points (n, 3) in the gel.

    A ray through a point o of the pupil has the tangent ``t(o) + o / focus`` at the film, because points at the focus distance are sharp.
    Away from the axis the rays through the pupil fill an ellipse on the film. Its centre differs from the ray through the pupil's centre.

    Returns
    -------
    diameter : (n,) float
        Root mean square of the ellipse's axes, px.
    shift : (n, 2) float
        Shift from the image through the pupil's centre to the mean image over the pupil, px.
    """
    camera = view.camera
    radius = 0.5 * camera.aperture_mm
    places = radius * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[:, None]
    across = points_mm[:, :2] - places
    rho = np.linalg.norm(across, axis=-1)
    tangent = across * (window_tangent(view, rho, points_mm[:, 2]) / np.maximum(rho, 1e-12))[..., None]
    seen = distort(camera, tangent + places / camera.focus_mm) * [camera.fx_px, camera.fy_px]
    spread = np.stack([seen[1] - seen[2], seen[3] - seen[4]])
    mean_square = 0.5  # of a radius over a disc, relative to its rim: the shift grows with the square
    return np.sqrt(0.5 * np.sum(spread**2, axis=(0, 2))), mean_square * (seen[1:].mean(axis=0) - seen[0])


def defocused(image: FloatArray, circles: FloatArray) -> FloatArray:
    """A picture (H, W, C) float32 in which each pixel is blurred by its own circle of confusion, with diameters (H, W) in px.

    The result is interpolated between a few blurred pictures. The interpolation is linear in the variance of the blur, which is 1 / 16 of
    the squared diameter.
    """
    first, last = int(_level(float(circles.min()))), int(np.ceil(_level(float(circles.max()))))
    if last == 0:
        return image
    blurred = [cv2.filter2D(image, -1, disc(LEAST_VARIANCE * 2.0 ** (k - 1))) if k else image for k in range(first, last + 1)]
    return np.asarray(_interpolate_blur(np.stack([each.reshape(image.shape) for each in blurred]), circles, first))


@compiled()
def _level(diameter_px: float) -> float:
    """Fractional index of a blur among the blurred pictures. Their variances are 0, and 1, 2, 4, ... times ``LEAST_VARIANCE``."""
    blur = diameter_px**2 / 16 / LEAST_VARIANCE
    if blur < 1:
        return blur
    above = np.floor(np.log2(blur))
    return above + blur / 2**above


@compiled()
def _interpolate_blur(blurred: FloatArray, circles: FloatArray, first: int) -> FloatArray:
    """Picture (H, W, C) whose pixels have the given circles (H, W), from blurred pictures (K, H, W, C) with levels from ``first`` on."""
    levels, height, width, channels = blurred.shape
    found = np.empty((height, width, channels), np.float32)
    for row in range(height):
        for column in range(width):
            at = _level(circles[row, column]) - first
            low = min(int(at), levels - 1)
            high = min(low + 1, levels - 1)
            part = at - low
            for k in range(channels):
                found[row, column, k] = (1 - part) * blurred[low, row, column, k] + part * blurred[high, row, column, k]
    return found


@lru_cache(maxsize=32)
def disc(variance: float) -> FloatArray:
    """Kernel (k, k) of a disc with this variance, px^2, along each axis.

    The coverage of pixels by a disc has another variance than the disc, because a pixel is not a point. Therefore a disc of another size is
    used.
    """
    low, high = 0.0, 4 * np.sqrt(variance) + 1
    reach = int(np.ceil(0.5 * high))
    place = np.arange(-reach, reach + 1)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        too_wide = float(_cover(middle, reach).sum(axis=0) @ place**2) > variance
        low, high = (low, middle) if too_wide else (middle, high)
    return _cover(high, reach)


def _cover(diameter_px: float, reach: int) -> FloatArray:
    """Fraction (k, k) of a disc's area in each pixel, up to ``reach`` pixels from the pixel at its centre."""
    pixels = 2 * reach + 1
    place = (np.arange(pixels * FINE) + 0.5) / FINE - 0.5 * pixels
    inside = np.clip(0.5 + FINE * (0.5 * diameter_px - np.hypot(place[:, None], place)), 0, 1)
    cover = inside.reshape(pixels, FINE, pixels, FINE).sum(axis=(1, 3)).astype(np.float32)
    return np.asarray(cover / cover.sum())
