"""Pin-like bright spots in a frame of which nothing is known: no mask, no threshold, no size.

A cap is a maximum of the difference of two Gaussians of about its own size. This difference is compared with its usual size nearby, so
that caps in a dark corner count as much as those in the light. Spots that are much longer than wide (arcs of the housing, scratches) are
left out.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

WORKING_SIGMA_PX = (2.4, 6.0)
"""Smallest and largest sd, px, with which a frame is looked at. For others it is enlarged by a whole number, or made smaller."""
LEAST_SIDE_PX = 8
"""Narrower frames show nothing, px."""
DARK = 8.0
"""Gray level around which the logarithm of the level begins to bend. There the reflection of an LED is hardly higher than a cap."""
WIDE = 1.6
"""Sd of the wider Gaussian, relative to the narrower one: then the difference is close to the Laplacian (Marr and Hildreth 1980)."""
AROUND = 5.0
"""Sd of the Gaussian over which the usual size of the difference is taken, relative to the narrower one: one pitch or two."""
LEAST_RESPONSE = 0.7
"""Least difference at a spot, relative to its root mean square nearby."""
LEAST_LEVELS = 0.02
"""Least difference at a spot, in the logarithm of the level: less is noise."""
LEAST_ROUNDNESS = 0.2
"""Least ratio of the smaller curvature at a spot to the larger one. A foreshortened cap at the rim has 0.3, an arc less than 0.1."""
NEAREST, USUAL, FAR_BELOW = 12, 75, 0.3
"""A spot that is lower than this share (the third) of this percentile of its nearest spots is noise between caps."""
APART = 1.3
"""Spots are at least this far apart, in sds of the narrower Gaussian."""

WHITE_LEVEL = 250
"""Least gray level of a glint: an LED's reflection is saturated."""
MOST_GLINTS = 12
"""With more saturated patches than this the caps themselves are white, and none is a glint."""
GLINT_SIZE = 1.6
"""Largest glint: the area of a disc of this many sds of the narrower Gaussian in radius."""
GLINT_RIM = 0.6
"""Width of a glint's blurred rim in these sds, which is taken away with it."""


@dataclass(frozen=True)
class Bumps:
    """Bright spots of one size.

    Attributes
    ----------
    px : (K, 2) float
        Places, px of the frame.
    response : (K,) float
        Height of each spot above its surroundings, in the logarithm of the level.
    sigma_px : float
        Size that was looked for: sd of the narrower Gaussian, px of the frame.
    size_px : (int, int)
        Width and height of the frame.
    hidden : (H, W) bool, optional
        Pixels in which frames show nothing (see ``twin.pins.extent``).
    """

    px: np.ndarray
    response: np.ndarray
    sigma_px: float
    size_px: tuple[int, int]
    hidden: np.ndarray | None = None


def find_bumps(gray: np.ndarray, sigma_px: float) -> Bumps:
    """Spots of one size, ``sigma_px`` (px of the frame), in a frame (H, W) uint8."""
    low, high = WORKING_SIGMA_PX
    scale = float(np.ceil(low / sigma_px)) if sigma_px < low else min(high / sigma_px, 1.0)
    level: np.ndarray = without_glints(gray, sigma_px).astype(np.float32)
    if scale != 1:
        size = (max(round(gray.shape[1] * scale), 1), max(round(gray.shape[0] * scale), 1))
        level = cv2.resize(level, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    sigma = sigma_px * scale
    level = np.log1p(np.maximum(level, 0) / DARK)
    narrow = cv2.GaussianBlur(level, (0, 0), sigma)
    response = narrow - cv2.GaussianBlur(level, (0, 0), WIDE * sigma)
    usual = np.sqrt(cv2.GaussianBlur(response * response, (0, 0), AROUND * sigma))
    reach = int(np.ceil(APART * sigma))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    peak = (response >= cv2.dilate(response, disc)) & (response > np.maximum(LEAST_RESPONSE * usual, LEAST_LEVELS))
    if min(level.shape) < LEAST_SIDE_PX:
        peak[:] = False
    peak[[0, -1]] = peak[:, [0, -1]] = False
    rows, columns = np.nonzero(peak)
    px, round_enough = _refined(response, rows, columns)
    px = (px[round_enough] + 0.5) / scale - 0.5
    height: np.ndarray = response[rows, columns][round_enough].astype(float)
    kept = _not_far_below(px, height)
    return Bumps(px[kept], height[kept], sigma_px, (gray.shape[1], gray.shape[0]))


def without_glints(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """A frame (H, W) uint8 in which the few saturated patches of an LED's size are filled with what is around them.

    A reflection in the window stands still while a cap moves beneath it; left there, it is taken for the cap.
    """
    white = (gray >= WHITE_LEVEL).astype(np.uint8)
    if not white.any():
        return gray
    _, label, stats, _ = cv2.connectedComponentsWithStats(white)
    glints = 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] <= np.pi * (GLINT_SIZE * sigma_px) ** 2)
    if not 0 < len(glints) <= MOST_GLINTS:
        return gray
    rim = 2 * max(round(GLINT_RIM * sigma_px), 1) + 1
    cover = cv2.dilate(np.isin(label, glints).astype(np.uint8), np.ones((rim, rim), np.uint8))
    return cv2.inpaint(gray, cover, 3, cv2.INPAINT_TELEA)


def _not_far_below(px: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Which spots (K,) are not far below those around them: between caps noise makes spots too, but low ones."""
    if len(px) <= NEAREST:
        return np.ones(len(px), bool)
    around = cKDTree(px).query(px, k=NEAREST)[1]
    return height > FAR_BELOW * np.percentile(height[around], USUAL, axis=1)


def _refined(field: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (K, 2) of maxima below a pixel, by the parabola through their neighbours, and which of them (K,) are round enough."""
    here = field[rows, columns]
    left, right, up, down = field[rows, columns - 1], field[rows, columns + 1], field[rows - 1, columns], field[rows + 1, columns]
    xx, yy = left + right - 2 * here, up + down - 2 * here
    xy = 0.25 * (field[rows - 1, columns - 1] + field[rows + 1, columns + 1] - field[rows - 1, columns + 1] - field[rows + 1, columns - 1])
    half, root = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    least, most = np.minimum(-(half - root), -(half + root)), np.maximum(-(half - root), -(half + root))
    round_enough = (least > LEAST_ROUNDNESS * most) & (most > 0)
    dx = np.where(xx < 0, np.clip((left - right) / (2 * np.minimum(xx, -1e-9)), -0.5, 0.5), 0.0)
    dy = np.where(yy < 0, np.clip((up - down) / (2 * np.minimum(yy, -1e-9)), -0.5, 0.5), 0.0)
    return np.column_stack([columns + dx, rows + dy]).astype(float), round_enough
