"""Bright blobs inside the circular mask of a frame: threshold, erosion, connected components, sub-pixel centroids."""

from dataclasses import dataclass

import cv2
import numpy as np

from scenes.sensor import BlobSpec
from twin.compiled import compiled
from twin.frames.forms import levels_at
from twin.pins.finding.bumps import find_bumps

MOST_COMPONENTS = 65535
"""Most components that are numbered; the others count as dark. A frame of pins has some hundreds."""
GROWTH_PX = 4
"""Largest distance, px, by which a component is grown beyond its bounding box."""
SPECK_LEVELS = 48
"""Difference of a pixel from the median of its 3 x 3 neighbourhood, gray levels, above which it counts as a hot or dead pixel."""
SPECK_USUAL = 0.8
"""Quantile of all differences from the median that is a frame's usual difference. In noisy frames the limit of ``SPECK_LEVELS`` is
raised according to it."""
SPECK_RATIO = 4.0
"""Least ratio of the difference of a hot or dead pixel to the usual difference."""
MOST_ABOVE = 98
"""Percentile of the levels above the local mean to which brighter levels (glare, LEDs) are reduced before Otsu's method."""
RING_PX = 2
"""Width of the ring around a component, from which the level of the skin is measured, px."""
NOISE_SIGMA_PX = 0.7
"""Standard deviation of the smoothing before an adaptive threshold, px. It halves white noise and keeps the edge of a 6 px cap."""
LEAST_FILL = 0.25
"""Least share of its bounding box that a cap fills. Arcs of the housing fill a smaller share."""


@dataclass(frozen=True)
class Mask:
    """A disc in a frame, and the window of the frame that contains it.

    Attributes
    ----------
    window : (slice, slice)
        Rows and columns of the frame.
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
    inside = (np.arange(columns.start, columns.stop) - x) ** 2 + ((np.arange(rows.start, rows.stop) - y) ** 2)[:, None] <= radius_px**2
    return Mask((rows, columns), np.array([columns.start, rows.start], float), (255 * inside).astype(np.uint8))


@dataclass(frozen=True)
class Blobs:
    """Connected bright components in one frame.

    Attributes
    ----------
    px : (K, 2) float
        Centroids, px of the frame.
    area_px2 : (K,) float
        Number of pixels of each component after the threshold and before erosion.
    elongation : (K,) float
        Ratio of the larger to the smaller variance along the component's axes (1 for a disc).
    label : (K,) int
        Each blob's value in ``labels``.
    label_area_px2 : (L,) float
        Area of every component, including rejected ones.
    label_box : (L, 4) int
        Every component's left, top, width, height in the window, before it is grown.
    labels : (h, w) uint16
        Components, grown over the pixels that belong to them, in the mask's window.
    gray : (h, w) uint8
        The window's gray levels.
    corner_px : (2,) float
        (x, y) of the window's first pixel in the frame.
    """

    px: np.ndarray
    area_px2: np.ndarray
    elongation: np.ndarray
    label: np.ndarray
    label_area_px2: np.ndarray
    label_box: np.ndarray
    labels: np.ndarray
    gray: np.ndarray
    corner_px: np.ndarray

    def pixels(self, label: int) -> tuple[np.ndarray, np.ndarray]:
        """Centres (p, 2), px of the frame, and gray levels (p,) of the pixels of a component."""
        left, top, width, height = self.label_box[label]
        left, top, right, bottom = max(left - GROWTH_PX, 0), max(top - GROWTH_PX, 0), left + width + GROWTH_PX, top + height + GROWTH_PX
        rows, columns = np.nonzero(self.labels[top:bottom, left:right] == label)
        rows, columns = rows + top, columns + left
        return np.stack([columns, rows], axis=1) + self.corner_px, self.gray[rows, columns]


def despeckle(gray: np.ndarray) -> np.ndarray:
    """Gray levels (h, w) uint8 in which hot and dead pixels are replaced by the median of their neighbourhood. Noisy pixels are kept."""
    median = cv2.medianBlur(gray, 3)
    away = cv2.absdiff(gray, median)
    usual = int(np.searchsorted(np.cumsum(cv2.calcHist([away], [0], None, [256], [0, 256])), SPECK_USUAL * gray.size))
    _, odd = cv2.threshold(away, float(max(SPECK_LEVELS, SPECK_RATIO * usual)), 255, cv2.THRESH_BINARY)
    return cv2.copyTo(median, odd, gray.copy())


def threshold(gray: np.ndarray, disc: np.ndarray, blob: BlobSpec) -> np.ndarray:
    """(h, w) uint8 of 0 and 255: bright pixels inside the disc."""
    if not blob.threshold_block_px:
        _, binary = cv2.threshold(gray, blob.threshold, 255, cv2.THRESH_BINARY)
        return cv2.bitwise_and(binary, disc)
    smooth = _smooth_window(gray, disc)
    binary = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, blob.threshold_block_px | 1, blob.threshold)
    return cv2.bitwise_and(binary, disc)


def own_threshold(gray: np.ndarray, disc: np.ndarray, blob: BlobSpec) -> float:
    """The adaptive threshold that separates a frame's bright and dark pixels best (Otsu 1979, of the level above the local mean)."""
    smooth = _smooth_window(gray, disc)
    block = blob.threshold_block_px | 1
    above = cv2.subtract(smooth, cv2.blur(smooth, (block, block), borderType=cv2.BORDER_REPLICATE))[disc > 0]
    level, _ = cv2.threshold(np.minimum(above, np.percentile(above, MOST_ABOVE)).astype(np.uint8), 0, 255, cv2.THRESH_OTSU)
    return -max(level, 1.0)


def _smooth_window(gray: np.ndarray, disc: np.ndarray) -> np.ndarray:
    """A window (h, w) prepared for an adaptive threshold: smoothed, and uniform outside the disc.

    Pixels outside the disc (housing and LEDs) are set to the median inside it. Otherwise they would raise the local mean near the rim.
    """
    histogram = cv2.calcHist([gray], [0], disc, [256], [0, 256]).ravel()
    median = int(np.searchsorted(np.cumsum(histogram), histogram.sum() / 2))
    smooth = cv2.GaussianBlur(gray, (3, 3), NOISE_SIGMA_PX)
    smooth[disc == 0] = min(median, 255)
    return smooth


@compiled()
def _measure_components(
    gray: np.ndarray, grown: np.ndarray, ringed: np.ndarray, bright: np.ndarray, boxes: np.ndarray, reach: int, measures: np.ndarray
) -> None:
    """Bright pixels, weight, elongation and weighted centre (count, 5) of each component, from zeros.

    A pixel's weight is its level above the mean of the ring around its component; negative weights are left out. A component's pixels in
    ``grown`` lie within ``reach`` of its box. Its ring is where ``ringed`` has it and ``grown`` has nothing, ``RING_PX`` farther.
    """
    height, width = gray.shape
    for k in range(1, len(boxes)):
        left, right = boxes[k, 0] - reach, boxes[k, 0] + boxes[k, 2] + reach
        top, bottom = boxes[k, 1] - reach, boxes[k, 1] + boxes[k, 3] + reach
        total, around = 0, 0
        for y in range(max(top - RING_PX, 0), min(bottom + RING_PX, height)):
            for x in range(max(left - RING_PX, 0), min(right + RING_PX, width)):
                if ringed[y, x] == k and grown[y, x] == 0:
                    total += gray[y, x]
                    around += 1
        level, size, m = total / max(around, 1), 0, 0.0
        mx = my = mxx = mxy = myy = 0.0
        for y in range(max(top, 0), min(bottom, height)):
            for x in range(max(left, 0), min(right, width)):
                if grown[y, x] == k:
                    size += bright[y, x] > 0
                    weight = gray[y, x] - level
                    if weight > 0:
                        m += weight
                        mx += weight * x
                        my += weight * y
                        mxx += weight * x * x
                        mxy += weight * x * y
                        myy += weight * y * y
        measures[k, 0] = size
        if m > 0:
            cx, cy = mx / m, my / m
            xx, xy, yy = mxx / m - cx * cx, mxy / m - cx * cy, myy / m - cy * cy
            root = np.hypot(xx - yy, 2 * xy)
            measures[k, 1], measures[k, 2] = m, (xx + yy + root) / max(xx + yy - root, 1e-3)
            measures[k, 3], measures[k, 4] = cx, cy


def find_blobs(gray: np.ndarray, mask: Mask, blob: BlobSpec, *, max_area_px2: float) -> Blobs:
    """Blobs of the window ``gray`` (h, w) uint8 between ``blob.min_area_px2`` and ``max_area_px2``.

    Components are those of the eroded bright image. Each is grown back over the erosion and one pixel more. The weight of a pixel in the
    centroid is its level above the mean of the ring around the component. In a two-level image all bright pixels have the same weight.
    """
    bright = threshold(gray, mask.disc, blob)
    eroded = bright
    if blob.erosion_px > 1:
        eroded = cv2.erode(bright, np.ones((blob.erosion_px, blob.erosion_px), np.uint8))
    most = ((eroded.shape[0] + 1) // 2) * ((eroded.shape[1] + 1) // 2)  # one in each 2 x 2 pixels
    numbers = cv2.CV_16U if most < MOST_COMPONENTS else cv2.CV_32S  # 16 bits are faster, but OpenCV refuses to run out of them
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(eroded, connectivity=8, ltype=numbers)
    if numbers == cv2.CV_32S:
        labels = np.where(labels > MOST_COMPONENTS, 0, labels).astype(np.uint16)
        boxes = boxes[: MOST_COMPONENTS + 1]
    grow = 2 * blob.erosion_px + 1
    grown = cv2.copyTo(labels, eroded, cv2.dilate(labels, np.ones((grow, grow), np.uint8)))
    ringed = cv2.dilate(labels, np.ones((grow + 2 * RING_PX, grow + 2 * RING_PX), np.uint8))
    measures = np.zeros((len(boxes), 5))
    _measure_components(gray, grown, ringed, bright, boxes, blob.erosion_px, measures)
    area, weight, elongation = measures[:, :3].T
    whole = boxes[:, 4] >= LEAST_FILL * boxes[:, 2] * boxes[:, 3]
    keep = np.flatnonzero((area >= blob.min_area_px2) & (area <= max_area_px2) & (weight > 0) & whole)
    return Blobs(measures[keep, 3:] + mask.corner_px, area[keep], elongation[keep], keep, area, boxes[:, :4], grown, gray, mask.corner_px)


def find_spots(gray: np.ndarray, mask: Mask, blob: BlobSpec) -> Blobs:
    """Bright spots of the size ``blob.spot_sigma_px`` in a mask's window (h, w) uint8. All count as of one area."""
    spots = find_bumps(gray, blob.spot_sigma_px)
    px = spots.px[levels_at(mask.disc, spots.px) > 0]
    area = np.full(len(px), 2 * np.pi * blob.spot_sigma_px**2)
    nothing = np.zeros(gray.shape, np.uint16)
    label = np.zeros(len(px), int)
    return Blobs(px + mask.corner_px, area, np.ones(len(px)), label, np.zeros(1), np.zeros((1, 4), int), nothing, gray, mask.corner_px)
