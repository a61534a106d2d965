"""Wrong settings: the camera's window, the pipeline's threshold."""

import numpy as np

from twin.evaluation.degradation.condition import PictureView, in_family
from twin.pins import DetectorSpec


def offset_px(value: float, view: PictureView) -> tuple[int, int]:
    """Displacement (x, y) in whole px by a share of the disc's radius."""
    by = value * view.radius_px
    return round(0.8 * by), round(-0.6 * by)


def wrong_crop(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """The camera's window is at another place: the picture is displaced, and black outside of the original window."""
    dx, dy = offset_px(value, view)
    if not (dx or dy):
        return image
    height, width = image.shape[:2]
    out = np.zeros_like(image)
    out[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)] = image[
        max(-dy, 0) : height + min(-dy, 0), max(-dx, 0) : width + min(-dx, 0)
    ]
    return out


def displaced(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Places in a wrongly cropped picture."""
    return px + np.array(offset_px(value, view))


def too_strict(detector: DetectorSpec, value: float) -> DetectorSpec:
    """A threshold that misses pins."""
    return detector.stricter(value)


def too_lax(detector: DetectorSpec, value: float) -> DetectorSpec:
    """A threshold that takes other things for pins."""
    return detector.stricter(-value)


_condition = in_family("settings", image_level=True)
CONDITIONS = (
    _condition("wrong-crop", "wrong crop", "displacement, of the disc's radius", "", 0.9, frame=wrong_crop, moves=displaced),
    _condition("threshold-strict", "threshold too strict", "gray levels", "", 120.0, setting=too_strict),
    _condition("threshold-lax", "threshold too lax", "gray levels", "", 60.0, setting=too_lax),
)
