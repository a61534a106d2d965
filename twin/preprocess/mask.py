"""The circular mask: only the disc with the pins is looked at."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Mask:
    """A disc in a frame, and the window of the frame that holds it.

    Attributes
    ----------
    window : (slice, slice)
        Rows and columns of the frame that are looked at.
    corner_px : (2,) float
        (x, y) of the window's first pixel.
    disc : (h, w) uint8
        255 inside the disc, 0 outside, over the window.
    """

    window: tuple[slice, slice]
    corner_px: np.ndarray
    disc: np.ndarray


def circular_mask(size_px: tuple[int, int], center_px: tuple[float, float], radius_px: float) -> Mask:
    """Mask of the pixels whose centre is within ``radius_px`` of ``center_px`` in a (width, height) frame."""
    width, height = size_px
    x, y = center_px
    columns = slice(int(np.clip(np.ceil(x - radius_px), 0, width - 1)), int(np.clip(np.floor(x + radius_px) + 1, 1, width)))
    rows = slice(int(np.clip(np.ceil(y - radius_px), 0, height - 1)), int(np.clip(np.floor(y + radius_px) + 1, 1, height)))
    grid_y, grid_x = np.mgrid[rows, columns]
    inside = (grid_x - x) ** 2 + (grid_y - y) ** 2 <= radius_px**2
    return Mask((rows, columns), np.array([columns.start, rows.start], float), (255 * inside).astype(np.uint8))
