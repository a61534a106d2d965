"""Search for a layout of pins in a frame, given only the layout's rings and their spacing."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenes.sensor import GeometrySpec
from twin.geometry.pins import rest_pins
from twin.pins.matching import Match, match
from twin.pins.reference import Reference, make_reference

# Adaptive thresholds that are tried: gray levels above the local mean, and side of the block over which that mean is taken, as a share
# of the frame's smaller side.
OFFSETS, BLOCKS = (3.0, 6.0, 12.0, 20.0, 32.0), (1 / 40, 1 / 20, 1 / 10)
# Least area of a blob, px^2; least share of its bounding box that a blob fills; largest ratio of that box's sides.
LEAST_AREA_PX2, LEAST_FILL, MOST_ASPECT = 4.0, 0.4, 3.0
# Distance, in median distances of nearest neighbours, below which two blobs belong to the same cluster.
LINK = 1.7
# Largest ratio of a blob's area to the median area, and of the median area to a blob's.
AREA_RATIO = 3.5
# Least number of blobs of a layout, as a share of the pins.
ENOUGH = 0.5
# Number of sets of blobs that are tried. Those whose number is nearest to the number of pins come first.
CANDIDATES = 3
# Turns that are tried. A turn by 60 deg does not change a layout.
TURNS_DEG = (0.0, -6.0, 6.0, -12.0, 12.0, -18.0, 18.0, -24.0, 24.0, 30.0)
# Sizes of the layout that are tried, relative to the smallest circle around the blobs.
SCALES = (1.0, 0.96, 1.05)
# Limits of the score divided by the number of pins: below the first no other size is tried, above the second no other size or turn,
# above the third no other set of blobs.
HOPELESS, FITTED, SETTLED = 0.4, 0.93, 0.95
# Blobs at the very rim may be glints. A second search leaves out blobs whose distance from the middle exceeds this quantile of all
# distances by this ratio.
RIM_QUANTILE, RIM_RATIO = 0.95, 1.08


@dataclass(frozen=True)
class Sighting:
    """A layout seen in one frame.

    Attributes
    ----------
    pins_px : (N, 2) float
        Places of the pins in the specification's order, NaN if lost.
        predicted_px : (N, 2) float
            Place of every pin as predicted from its neighbours.
    area_px2 : float
        Median area of the blobs.
    contrast : float
        Median level of the blobs minus that of their surroundings, gray levels.
    score : float
        Score of the matching.
    """

    pins_px: np.ndarray
    predicted_px: np.ndarray
    area_px2: float
    contrast: float
    score: float


def flat_layout(geometry: GeometrySpec) -> np.ndarray:
    """Pins (N, 2) of the layout in a plane, with the outermost at distance 1. The result is independent of camera and dome radius."""
    axis = rest_pins(geometry).axis
    polar = np.arccos(np.clip(np.abs(axis[:, 2]), -1, 1))
    rho = np.linalg.norm(axis[:, :2], axis=1, keepdims=True)
    outward = -axis[:, :2] / np.maximum(rho, 1e-12)
    return outward * (polar / polar.max())[:, None]


def see_layout(gray: np.ndarray, flat: np.ndarray, rings: int, *, binary: bool) -> Sighting | None:
    """Find the layout in a gray frame at any place and of any size; None if nothing resembles it.

    Parameters
    ----------
    gray : (H, W) uint8
    flat : (N, 2) float
        The layout as ``flat_layout`` gives it.
    rings : int
    binary : bool
        Whether the frame is thresholded.
    """
    best = None
    for px, area, contrast in _candidates(gray, len(flat), binary)[:CANDIDATES]:
        for k in _outermost_first(px):
            seen = _fit(flat, rings, px[k], area[k], contrast)
            if seen is not None and (best is None or seen.score > best.score):
                best = seen
        if best is not None and best.score > SETTLED * len(flat):
            break
    return best


def _candidates(gray: np.ndarray, count: int, binary: bool) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Clusters of blobs of similar area: places (K, 2), areas (K,), contrast. They are sorted by how near K is to the number of pins."""
    found = []
    for bright in _bright(gray, binary):
        _, labels, stats, centroids = cv2.connectedComponentsWithStats(bright, connectivity=8)
        width, height, area = stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT], stats[1:, cv2.CC_STAT_AREA].astype(float)
        compact = (area >= LEAST_AREA_PX2) & (area >= LEAST_FILL * width * height)
        compact &= (np.maximum(width, height) <= MOST_ASPECT * np.minimum(width, height)) & (area < gray.size / count / 2)
        if compact.sum() < ENOUGH * count:
            continue
        px, area = centroids[1:][compact], area[compact]
        cluster = _largest_cluster(px, area)
        if len(cluster) < ENOUGH * count:
            continue
        inside = bright > 0
        near = cv2.dilate(bright, np.ones((7, 7), np.uint8)) > 0
        contrast = float(np.median(gray[inside]) - np.median(gray[near & ~inside]))
        found.append((px[cluster], area[cluster], contrast))
    return sorted(found, key=lambda entry: abs(len(entry[0]) - count))


def _bright(gray: np.ndarray, binary: bool) -> Iterator[np.ndarray]:
    """Thresholded frames (H, W) uint8 of 0 and 255; only one if the frame is already thresholded."""
    if binary:
        yield cv2.threshold(gray, 127, 255, cv2.THRESH_BINARY)[1]
        return
    smooth = cv2.GaussianBlur(gray, (3, 3), 0.7)
    for share in BLOCKS:
        block = int(share * min(gray.shape)) | 1
        for offset in OFFSETS:
            yield cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, max(block, 5), -offset)


def _largest_cluster(px: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Indices of the blobs in the largest connected cluster that have a similar area."""
    chosen = np.arange(len(px))
    for _ in range(2):  # the second round uses the area and the spacing of the first round's cluster
        tree = cKDTree(px[chosen])
        distance, _ = tree.query(px[chosen], k=min(2, len(chosen)))
        if distance.ndim < 2:
            return chosen[:0]
        pairs = tree.query_pairs(LINK * np.median(distance[:, 1]), output_type="ndarray")
        links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(chosen),) * 2)
        label = connected_components(links, directed=False)[1]
        chosen = chosen[label == np.bincount(label).argmax()]
        like = np.abs(np.log(area[chosen] / np.median(area[chosen]))) < np.log(AREA_RATIO)
        chosen = chosen[like]
        if len(chosen) < 3:
            break
    return chosen


def _outermost_first(px: np.ndarray) -> Iterator[np.ndarray]:
    """Masks (K,): all blobs, then all blobs except those at the very rim, which may be glints."""
    everything = np.ones(len(px), bool)
    yield everything
    away = np.linalg.norm(px - np.median(px, axis=0), axis=1)
    yield away < RIM_RATIO * np.quantile(away, RIM_QUANTILE)


def _fit(flat: np.ndarray, rings: int, px: np.ndarray, area: np.ndarray, contrast: float) -> Sighting | None:
    """Fit size and turn of the layout to blobs, and match it to them; None if too few blobs fit."""
    if len(px) < ENOUGH * len(flat):
        return None
    (x, y), radius = cv2.minEnclosingCircle(px.astype(np.float32))
    best: Match | None = None
    for scale in SCALES:
        if best is not None and best.score < HOPELESS * len(flat):
            return None
        for turn in np.exp(1j * np.radians(TURNS_DEG)):
            turning = np.array([[turn.real, turn.imag], [-turn.imag, turn.real]])
            reference = make_reference([x, y] + scale * radius * flat @ turning, rings)
            found = match(reference, px, area)
            if best is None or found.score > best.score:
                best = found
            if best.score > FITTED * len(flat):
                return _sighting(best, px, area, contrast)
    return _sighting(best, px, area, contrast) if best is not None and best.score > ENOUGH * len(flat) else None


def _sighting(found: Match, px: np.ndarray, area: np.ndarray, contrast: float) -> Sighting:
    """The sighting that follows from a labelling of blobs."""
    paired = found.blob >= 0
    pins_px = np.full((len(found.blob), 2), np.nan)
    pins_px[paired] = px[found.blob[paired]]
    return Sighting(pins_px, found.predicted_px, float(np.median(area[found.blob[paired]])), contrast, found.score)


def rest_of(sightings: list[Sighting], rings: int) -> Reference:
    """The layout at rest: the median of each pin's places in all sightings. If a pin was not seen, its predicted place is used."""
    seen = np.stack([np.where(np.isfinite(s.pins_px), s.pins_px, s.predicted_px) for s in sightings])
    return make_reference(np.nanmedian(seen, axis=0), rings)
