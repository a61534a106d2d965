"""Detection of pin-like bright spots in a frame without a known mask, threshold or cap size.

A cap is a local maximum of the difference of two Gaussian-filtered images whose widths are similar to the cap's size. This difference is
compared with its root mean square nearby, so that caps in a dark corner have the same weight as caps in the light. Spots that are much
longer than wide (arcs of the housing, scratches) are left out.
"""

import hashlib
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

WORKING_SIGMA_PX = (2.4, 6.0)
"""Smallest and largest standard deviation of the narrower Gaussian, px. For smaller spots the frame is enlarged by a whole number, for
larger spots it is reduced."""
LEAST_SIDE_PX = 8
"""Least width and height of a frame, px. In smaller frames no spot is found."""
DARK = 8.0
"""Gray level at which the scale changes from linear to logarithmic: the filters use log(1 + level / DARK). On this scale the reflection of
an LED is hardly higher than a cap."""
WIDE = 1.6
"""Ratio of the standard deviations of the wider and the narrower Gaussian. With this ratio the difference is close to the Laplacian (Marr
and Hildreth 1980)."""
AROUND = 5.0
"""Standard deviation of the Gaussian that averages the squared difference nearby, in standard deviations of the narrower Gaussian. It is
one or two spacings."""
LEAST_RESPONSE = 0.7
"""Least difference at a spot, relative to its root mean square nearby."""
LEAST_LEVELS = 0.02
"""Least difference at a spot, in the logarithm of the level. Smaller differences are noise."""
LEAST_ROUNDNESS = 0.2
"""Least ratio of the smaller curvature at a spot to the larger one. A foreshortened cap at the rim has a ratio of 0.3, an arc less than
0.1."""
NEAREST, USUAL, FAR_BELOW = 12, 75, 0.3
"""Number of nearest spots that a spot is compared with, percentile of their heights, and least share of this percentile. A lower spot is
noise between caps."""
APART = 1.3
"""Least distance between two spots, in standard deviations of the narrower Gaussian."""

WHITE_LEVEL = 250
"""Least gray level of a glint. The reflection of an LED is saturated."""
MOST_GLINTS = 12
"""Largest number of glints. If more patches are saturated, the caps themselves are white, and no patch counts as a glint."""
GLINT_SIZE = 1.6
"""Radius of a disc with the area of the largest glint, in standard deviations of the narrower Gaussian."""
GLINT_RIM = 0.6
"""Width of a glint's blurred rim, in standard deviations of the narrower Gaussian. The rim is removed together with the glint."""
KEPT = 128
"""Number of results that are kept."""


@dataclass(frozen=True)
class Bumps:
    """Bright spots of one size.

    Attributes
    ----------
    px : (K, 2) float
        Positions, px of the frame.
    response : (K,) float
        Height of each spot above its surroundings, in the logarithm of the level.
    sigma_px : float
        Size of the spots: standard deviation of the narrower Gaussian, px of the frame.
    size_px : (int, int)
        Width and height of the frame.
    hidden : (H, W) bool, optional
        Pixels that a mask or fill hides (see ``twin.pins.labelling.extent``).
    """

    px: np.ndarray
    response: np.ndarray
    sigma_px: float
    size_px: tuple[int, int]
    hidden: np.ndarray | None = None


def find_bumps(gray: np.ndarray, sigma_px: float) -> Bumps:
    """Find the spots of one size, ``sigma_px`` (px of the frame), in a frame (H, W) uint8."""
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
    px, round_enough = _refine_maxima(response, rows, columns)
    px = (px[round_enough] + 0.5) / scale - 0.5
    height: np.ndarray = response[rows, columns][round_enough].astype(float)
    kept = _not_far_below(px, height)
    return Bumps(px[kept], height[kept], sigma_px, (gray.shape[1], gray.shape[0]))


_recent: OrderedDict[tuple[bytes, tuple[int, ...], float], Bumps] = OrderedDict()


def recent_bumps(gray: np.ndarray, sigma_px: float) -> Bumps:
    """As ``find_bumps``; the last results are kept, because the same frames are compared with several layouts."""
    key = hashlib.blake2b(np.ascontiguousarray(gray).data).digest(), gray.shape, sigma_px
    found = _recent.pop(key, None) or find_bumps(gray, sigma_px)
    _recent[key] = found
    while len(_recent) > KEPT:
        _recent.popitem(last=False)
    return found


def without_glints(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """The frame (H, W) uint8 without glints: saturated patches of an LED's size are filled from their surroundings.

    The reflection of an LED in the window does not move while a cap moves behind it. If it stayed in the frame, it would be taken for the
    cap.
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
    """(K,) bool: whether each spot is high enough compared with its nearest spots. Noise between caps also makes spots, but low ones."""
    if len(px) <= NEAREST:
        return np.ones(len(px), bool)
    around = cKDTree(px).query(px, k=NEAREST)[1]
    return height > FAR_BELOW * np.percentile(height[around], USUAL, axis=1)


def _refine_maxima(field: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sub-pixel positions (K, 2) of maxima, by a parabola through the neighbours, and whether each maximum (K,) is round enough."""
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
