"""Which ray each place of the film sees, as a table: exact for any distortion, and cheap to look up."""

import numpy as np

from scenes.sensor import CameraSpec
from twin.projection import undistort

FIELD_MARGIN = 0.97  # of the fold's radius: past it the table goes on straight, where a distortion model means nothing
WIDEST_FIELD = 6.0  # ideal normalised radius (80 deg off the axis): a pinhole image ends somewhere


def valid_radius(camera: CameraSpec) -> float:
    """Ideal normalised radius up to which the radial distortion grows without folding back (inf: everywhere)."""
    radius = np.linspace(0, WIDEST_FIELD, 6001)
    slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
    folded = np.flatnonzero(slope <= 0.05)
    return float(radius[folded[0]]) if len(folded) else float("inf")


def ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> np.ndarray:
    """Ideal normalised coordinates (H + 1, W + 1, 2) at the corners of a window's pixels.

    ``window_px`` = (x0, y0, x1, y1), end exclusive; corner (j, i) is at pixel (x0 + i - 0.5, y0 + j - 0.5).
    Beyond the distortion's valid field coordinates continue linearly outwards.
    """
    x0, y0, x1, y1 = window_px
    x, y = np.meshgrid(np.arange(x0, x1 + 1) - 0.5, np.arange(y0, y1 + 1) - 0.5)
    seen = np.stack([(x - camera.cx_px) / camera.fx_px, (y - camera.cy_px) / camera.fy_px], axis=-1)
    radius = np.linspace(0, min(FIELD_MARGIN * valid_radius(camera), WIDEST_FIELD), 6001)
    distorted = radius * (1 + camera.k1 * radius**2 + camera.k2 * radius**4)
    seen_radius = np.linalg.norm(seen, axis=-1, keepdims=True)
    beyond = np.maximum(1.0, seen_radius / distorted[-1])
    inside = seen / beyond
    guess = inside * np.interp(seen_radius / beyond, distorted, radius) / np.maximum(seen_radius / beyond, 1e-12)
    return beyond * undistort(camera, inside, guess=guess)
