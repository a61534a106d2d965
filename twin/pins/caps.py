"""What each cap looks like in a frame: level, contrast, size, shape and the sharpness of its edge.

All is measured against the cap's own half level, midway between its own plateau and the skin around it, in a patch
interpolated four times as fine, within the cap's Voronoi cell.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from scipy.spatial import cKDTree

# Interpolated pixels for each pixel, each way.
FINE = 4
# Half a side of a cap's patch, as a share of the distance to the nearest neighbour.
REACH = 0.65
# Percentile of a cell's levels outside the cap that stands for the skin: stems and neighbours are brighter.
SKIN_PERCENTILE = 20.0
# Rounds in which plateau and half level are found in turn: each depends on the other.
HALF_ROUNDS = 3
# A pixel at least this deep in the cap, relative to its deepest one, belongs to the plateau.
PLATEAU = 0.5
# Reach of the edge's profile to both sides, and width of its bins, px.
EDGE_PX, EDGE_BIN_PX = 4.0, 0.25
# Levels of the edge, as shares of the contrast, between which its width is measured.
EDGE_LOW, EDGE_HIGH = 0.1, 0.9
# Pins, a cap's own included, that bound its cell.
NEIGHBOURS = 7


@dataclass(frozen=True)
class Caps:
    """Caps of one frame, (N,) each; NaN where there is no cap to measure.

    Attributes
    ----------
    level, contrast, skin : (N,) float
        Gray levels: of the plateau, of the plateau above the skin around, and of that skin.
    diameter_px : float
        Of the disc with the area above half level.
    eccentricity : float
        Of the ellipse with the second moments of that area: 0 a circle, towards 1 a bar.
    edge_px : float
        From 10 to 90 % of the contrast, along the distance to the half-level line, mean around the cap.
        A straight edge blurred by a Gaussian: 2.563 sigma.
    """

    level: np.ndarray
    contrast: np.ndarray
    skin: np.ndarray
    diameter_px: np.ndarray
    eccentricity: np.ndarray
    edge_px: np.ndarray


MEASURES = tuple(field.name for field in fields(Caps))


def measure_caps(gray: np.ndarray, pins_px: np.ndarray) -> Caps:
    """Measure the caps at pins (N, 2) px in a gray frame (H, W) uint8; NaN pins stay NaN."""
    values = np.full((len(pins_px), len(MEASURES)), np.nan)
    seen = np.flatnonzero(np.isfinite(pins_px).all(axis=1))
    distance, nearest = cKDTree(pins_px[seen]).query(pins_px[seen], k=min(NEIGHBOURS, len(seen)))
    for row, k in enumerate(seen):
        others = pins_px[seen[nearest[row, 1:]]]
        half = int(np.ceil(REACH * distance[row, 1]))
        found = _measure(gray, pins_px[k], others, half)
        if found is not None:
            values[k] = found
    return Caps(*values.T)


def _measure(gray: np.ndarray, pin_px: np.ndarray, others: np.ndarray, half: int) -> tuple[float, ...] | None:
    """The measures, in the order of ``MEASURES``, of a cap in a patch of ``half`` a side; None where there is none."""
    x, y = np.rint(pin_px).astype(int)
    if x < half or y < half or x + half >= gray.shape[1] or y + half >= gray.shape[0]:
        return None
    patch = gray[y - half : y + half + 1, x - half : x + half + 1].astype(np.float32)
    steps = np.arange(0, 2 * half + 1e-6, 1 / FINE, dtype=np.float32)
    columns, rows = np.meshgrid(steps, steps)
    fine = cv2.remap(patch, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    corner = pin_px - [x - half, y - half]
    cell = np.ones(fine.shape, bool)
    for u, v in others - pin_px:  # nearer to the pin than to this neighbour
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
        depth = cv2.distanceTransform(cap.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        level = float(fine[cap & (depth >= PLATEAU * depth.max())].mean())
        skin = float(np.percentile(fine[cell & ~cap], SKIN_PERCENTILE))
    height = cv2.distanceTransform((~cap).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inwards_px = np.where(cap, depth - 0.5, 0.5 - height) / FINE
    share = (fine - skin) / (level - skin)
    x_c, y_c = columns[cap].astype(float), rows[cap].astype(float)
    (xx, xy), (_, yy) = np.cov(x_c, y_c)
    root = np.hypot(xx - yy, 2 * xy)
    eccentricity = np.sqrt(2 * root / (xx + yy + root))
    diameter = 2 * np.sqrt(cap.sum() / np.pi) / FINE
    return level, level - skin, skin, diameter, eccentricity, _edge_px(inwards_px[cell], share[cell])


def _edge_px(inwards_px: np.ndarray, share: np.ndarray) -> float:
    """Distance between the places where the mean profile crosses 10 and 90 %, searched outwards from the half-level line."""
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
