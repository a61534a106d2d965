"""Which way each place of the film looks, as a table: exact for any distortion, and cheap to look up."""

from functools import lru_cache

import numpy as np

from scenes.sensor import CameraSpec
from twin.projection import distort, undistort
from twin.types import FloatArray

FIELD_MARGIN = 0.97
"""Share of the fold's radius up to which the distortion model is used. Beyond it the model means nothing: the table goes on linearly."""
WIDEST_FIELD = 6.0
"""Largest tangent of a perspective camera (80 deg off its axis)."""
WIDEST_FISHEYE = 57.0
"""Largest tangent of a fisheye camera (89 deg off its axis)."""


def valid_radius(camera: CameraSpec) -> float:
    """Tangent up to which the radial distortion grows without folding back (inf: everywhere)."""
    fisheye = camera.projection == "fisheye"
    radius = np.linspace(0, np.pi / 2 if fisheye else WIDEST_FIELD, 6001)
    slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
    folded = np.flatnonzero(slope <= 0.05)
    if not len(folded):
        return float("inf")
    return float(np.tan(radius[folded[0]]) if fisheye else radius[folded[0]])


def ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    """Unit directions (H + 1, W + 1, 3) in the camera frame, in air, at the corners of a window's pixels.

    ``window_px`` = (x0, y0, x1, y1), end exclusive; corner (j, i) is at pixel (x0 + i - 0.5, y0 + j - 0.5).
    Beyond the distortion's valid field the tangents continue linearly outwards. The array is shared: it can't be written to.
    """
    return _ray_table(camera, tuple(window_px))


@lru_cache(maxsize=4)
def _ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    x0, y0, x1, y1 = window_px
    x, y = np.meshgrid(np.arange(x0, x1 + 1) - 0.5, np.arange(y0, y1 + 1) - 0.5)
    seen = np.stack([(x - camera.cx_px) / camera.fx_px, (y - camera.cy_px) / camera.fy_px], axis=-1)
    widest = WIDEST_FISHEYE if camera.projection == "fisheye" else WIDEST_FIELD
    edge = min(FIELD_MARGIN * valid_radius(camera), widest)
    tangent = np.tan(np.linspace(0, np.arctan(edge), 6001))
    image = distort(camera.model_copy(update={"p1": 0.0, "p2": 0.0}), np.stack([tangent, np.zeros_like(tangent)], axis=-1))[:, 0]
    seen_radius = np.linalg.norm(seen, axis=-1, keepdims=True)
    beyond = np.maximum(1.0, seen_radius / image[-1])
    inside = seen / beyond
    guess = inside * np.interp(seen_radius / beyond, image, tangent) / np.maximum(seen_radius / beyond, 1e-12)
    ideal = beyond * undistort(camera, inside, guess=guess)
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rays.flags.writeable = False
    return rays


def subpixel_rays(corners: FloatArray, across: int) -> FloatArray:
    """Directions (n, across^2, 3) of a regular grid of places within n pixels, not normalised; ``corners`` (2, 2, n, 3) by row, column."""
    offset = (np.arange(across) + 0.5) / across
    s, t = (g.ravel()[:, None] for g in np.meshgrid(offset, offset))
    first, second = ((1 - s) * row[0, :, None] + s * row[1, :, None] for row in corners)
    return (1 - t) * first + t * second
