"""Degradations of the whole picture: a stream that lost its place, and a camera that was mounted otherwise."""

import cv2
import numpy as np

from twin.evaluation.degradation.condition import PictureView, in_family
from twin.evaluation.degradation.conditions.placement import mapped, warped

FARTHEST_PX = 64.0
"""Most severe displacement of rows, px."""


def rolled(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture that begins at the wrong column; what leaves at the right comes back at the left."""
    return np.roll(image, round(value), axis=1)


def rolled_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a rolled picture."""
    return px + [round(value), 0]


def torn(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture whose lower half is rolled."""
    middle = len(image) // 2
    return np.concatenate([image[:middle], rolled(image[middle:], value, view, rng)])


def torn_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a torn picture."""
    return px + np.where(px[:, 1:] >= int(view.size_px[1]) // 2, [round(value), 0.0], 0.0)


def turned(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture that is turned about its middle."""
    return warped(image, _turn(value, image.shape))


def turned_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a turned picture."""
    return mapped(px, _turn(value, view.size_px[::-1]))


def _turn(degrees: float, shape: tuple[int, ...]) -> np.ndarray:
    return cv2.getRotationMatrix2D(((shape[1] - 1) / 2, (shape[0] - 1) / 2), -degrees, 1.0)


def mirrored(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture with left and right exchanged."""
    return np.ascontiguousarray(image[:, ::-1])


def mirrored_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a mirrored picture."""
    return np.column_stack([view.size_px[0] - 1 - px[:, 0], px[:, 1]])


_condition = in_family("picture", image_level=True)
CONDITIONS = (
    _condition("picture-rolled", "rolled picture", "columns", "px", FARTHEST_PX, frame=rolled, moves=rolled_points),
    _condition("picture-torn", "torn picture", "columns of the lower half", "px", FARTHEST_PX, frame=torn, moves=torn_points),
    _condition("picture-turned", "turned picture", "angle", "deg", 180.0, frame=turned, moves=turned_points),
    _condition("picture-mirrored", "mirrored picture", "mirrored", "", 1.0, frame=mirrored, moves=mirrored_points),
)
