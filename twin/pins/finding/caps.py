"""Measurement of each cap in a frame: level, contrast, size, shape and sharpness of its edge.

A cap's outline is where the gray level is half way between the cap's plateau and the skin around it (its half level). It is measured in
a patch interpolated four times as fine, within the cap's Voronoi cell.
"""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scenes.sensor import Polarity
from twin.frames.forms import pin_levels

# Number of interpolated pixels for one pixel, in each direction.
FINE = 4
# Half of the side of a cap's patch, as a share of the distance to the nearest neighbour.
REACH = 0.65
# Percentile of a cell's levels outside the cap that is taken as the skin's level, because stems and neighbours are brighter.
SKIN_PERCENTILE = 20.0
# Rounds of finding plateau and half level alternately, because each depends on the other.
HALF_ROUNDS = 3
# Least depth of a pixel of the plateau inside the cap's outline, relative to the deepest pixel.
PLATEAU = 0.5
# Length of the edge's profile on each side of the outline, and width of its bins, px.
EDGE_PX, EDGE_BIN_PX = 4.0, 0.25
# Levels of the edge, as shares of the contrast, between which its width is measured.
EDGE_LOW, EDGE_HIGH = 0.1, 0.9
# Number of pins, including the cap's own, from which its cell is computed.
NEIGHBOURS = 7


@dataclass(frozen=True)
class Caps:
    """Caps of one frame, (N,) each; NaN where there is no cap to measure.

    Attributes
    ----------
    level, contrast, skin : (N,) float
        Gray levels: of the plateau, the difference between the plateau and the skin around it, and of that skin. The contrast of a dark cap
        is positive, too.
    diameter_px : float
        Diameter of the disc whose area is that above half level.
    eccentricity : float
        Eccentricity of the ellipse with the second moments of that area: 0 for a circle, near 1 for a bar.
    edge_px : float
        Distance in which the mean profile across the outline falls from 90 to 10 % of the contrast. For a straight edge blurred by a
        Gaussian it is 2.563 sigma.
    """

    level: np.ndarray
    contrast: np.ndarray
    skin: np.ndarray
    diameter_px: np.ndarray
    eccentricity: np.ndarray
    edge_px: np.ndarray


MEASURES = tuple(field.name for field in fields(Caps))


def measure_caps(gray: np.ndarray, pins_px: np.ndarray, *, polarity: Polarity = "bright") -> Caps:
    """Measure the bright or dark caps at pins (N, 2) px in a gray frame (H, W) uint8; NaN pins stay NaN."""
    gray = pin_levels(gray, polarity)
    values = np.full((len(pins_px), len(MEASURES)), np.nan)
    seen = np.flatnonzero(np.isfinite(pins_px).all(axis=1))
    distance, nearest = cKDTree(pins_px[seen]).query(pins_px[seen], k=min(NEIGHBOURS, len(seen)))
    for row, k in enumerate(seen):
        others = pins_px[seen[nearest[row, 1:]]]
        half = int(np.ceil(REACH * distance[row, 1]))
        found = _measure(gray, pins_px[k], others, half)
        if found is not None:
            values[k] = found
    caps = Caps(*values.T)
    return caps if polarity == "bright" else replace(caps, level=255 - caps.level, skin=255 - caps.skin)


def _measure(gray: np.ndarray, pin_px: np.ndarray, others: np.ndarray, half: int) -> tuple[float, ...] | None:
    """The measures of a cap in the order of ``MEASURES``, in a patch with the side ``2 half``; None if there is no cap."""
    x, y = np.rint(pin_px).astype(int)
    if x < half or y < half or x + half >= gray.shape[1] or y + half >= gray.shape[0]:
        return None
    patch = gray[y - half : y + half + 1, x - half : x + half + 1].astype(np.float32)
    steps = np.arange(0, 2 * half + 1e-6, 1 / FINE, dtype=np.float32)
    columns, rows = np.meshgrid(steps, steps)
    fine = cv2.remap(patch, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    corner = pin_px - [x - half, y - half]
    cell = np.ones(fine.shape, bool)
    for u, v in others - pin_px:  # keep pixels that are nearer to the pin than to this neighbour
        cell &= (columns - corner[0]) * u + (rows - corner[1]) * v < (u * u + v * v) / 2
    row, column = np.rint(corner[::-1] * FINE).astype(int).tolist()
    middle = row, column
    skin, level = np.percentile(fine[cell], SKIN_PERCENTILE), fine[middle]
    for _ in range(HALF_ROUNDS):
        above = ((fine > (skin + level) / 2) & cell).astype(np.uint8)
        labels = cv2.connectedComponents(above, connectivity=4)[1]
        if labels[middle] == 0:
            return None
        cap = labels == labels[middle]
        depth = inner_distance(cap)
        level = float(fine[cap & (depth >= PLATEAU * depth.max())].mean())
        skin = float(np.percentile(fine[cell & ~cap], SKIN_PERCENTILE))
    height = inner_distance(~cap)
    inwards_px = np.where(cap, depth - 0.5, 0.5 - height) / FINE
    share = (fine - skin) / (level - skin)
    x_c, y_c = columns[cap].astype(float), rows[cap].astype(float)
    (xx, xy), (_, yy) = np.cov(x_c, y_c)
    root = np.hypot(xx - yy, 2 * xy)
    eccentricity = np.sqrt(2 * root / (xx + yy + root))
    diameter = 2 * np.sqrt(cap.sum() / np.pi) / FINE
    return level, level - skin, skin, diameter, eccentricity, _edge_px(inwards_px[cell], share[cell])


def inner_distance(inside: np.ndarray) -> np.ndarray:
    """Distance (H, W) float32 of the pixels of a mask from its nearest other pixel, which is the root of an integer.

    OpenCV's last bit depends on where the memory lies. Without its rounding, pixels at half of the largest depth would be in the plateau
    in one run, and not in the next.
    """
    return np.sqrt(np.rint(np.square(cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))))


def _edge_px(inwards_px: np.ndarray, share: np.ndarray) -> float:
    """Distance between the places where the mean profile crosses 10 and 90 %; both are searched from the half-level line."""
    bins = np.rint(inwards_px / EDGE_BIN_PX).astype(int)
    reach = int(EDGE_PX / EDGE_BIN_PX)
    near = np.abs(bins) <= reach
    count = np.bincount(bins[near] + reach, minlength=2 * reach + 1)
    total = np.bincount(bins[near] + reach, share[near], minlength=2 * reach + 1)
    used = np.flatnonzero(count)
    at, profile = (used - reach) * EDGE_BIN_PX, total[used] / count[used]
    start = int(np.searchsorted(at, 0.0))
    up = np.flatnonzero(profile[start:] >= EDGE_HIGH)
    down = np.flatnonzero(profile[:start] <= EDGE_LOW)
    if not len(up) or not len(down) or up[0] + start == 0:
        return np.nan
    high, low = start + up[0], down[-1]
    upper = np.interp(EDGE_HIGH, profile[high - 1 : high + 1], at[high - 1 : high + 1])
    lower = np.interp(EDGE_LOW, profile[low : low + 2], at[low : low + 2])
    return float(upper - lower)
