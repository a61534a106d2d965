"""Connected components of a two-level picture, from the runs of bright pixels in its rows: most of a frame of pins is dark."""

import numpy as np

from twin.compiled import compiled

MOST = 65535
"""Most components that are numbered; the others count as dark. A frame of pins has some hundreds."""


@compiled()
def find_components(bright: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Components of the bright pixels of a picture (h, w) uint8, which are connected to all eight neighbours.

    Returns
    -------
    labels : (h, w) uint16
        Number of each pixel's component, from 1; 0 where it is dark. They are numbered like ``cv2.connectedComponents``: by the first of
        the picture's blocks of 2 x 2 pixels.
    boxes : (count, 5) int
        Left, top, width, height and area of each component; zeros for number 0.
    """
    height, width = bright.shape
    runs, count = _find_runs(bright)
    parent = np.arange(count)
    above, row = 0, 0  # first run of the row above that may touch, and first run of this row
    for r in range(count):
        y, first, last = runs[r, 0], runs[r, 1], runs[r, 2]
        if y != runs[row, 0]:
            above, row = row, r
        while above < row and (runs[above, 0] < y - 1 or runs[above, 2] < first):
            above += 1
        k = above
        while k < row and runs[k, 1] <= last:
            a, b = _root(parent, r), _root(parent, k)
            parent[max(a, b)] = min(a, b)
            k += 1
    block = np.full(count, -1)  # first block of the component whose first run this is
    for r in range(count):
        k, place = _root(parent, r), runs[r, 0] // 2 * width + runs[r, 1] // 2
        if block[k] < 0 or place < block[k]:
            block[k] = place
    roots = np.flatnonzero(block >= 0)
    roots = roots[np.argsort(block[roots])][:MOST]
    number = np.zeros(count, np.int64)
    for k in range(len(roots)):
        number[roots[k]] = k + 1
    labels, boxes = np.zeros((height, width), np.uint16), np.zeros((len(roots) + 1, 5), np.int64)
    for r in range(count):
        k, y, first, last = number[_root(parent, r)], runs[r, 0], runs[r, 1], runs[r, 2]
        if k == 0:
            continue
        for x in range(first, last):
            labels[y, x] = k
        left = first if boxes[k, 4] == 0 else min(boxes[k, 0], first)
        top = y if boxes[k, 4] == 0 else boxes[k, 1]
        boxes[k, 2] = max(boxes[k, 0] + boxes[k, 2], last) - left
        boxes[k, 0], boxes[k, 1], boxes[k, 3] = left, top, y + 1 - top
        boxes[k, 4] += last - first
    return labels, boxes


@compiled()
def _find_runs(bright: np.ndarray) -> tuple[np.ndarray, int]:
    """Row, first pixel, and the pixel after the last one of each run of bright pixels, and their number. Eight dark pixels are one step."""
    height, width = bright.shape
    flat = bright.ravel()
    words = flat[: len(flat) // 8 * 8].view(np.uint64)
    runs = np.empty((height * (width // 2 + 1), 3), np.int64)
    count, p = 0, 0
    while p < len(flat):
        if flat[p] == 0:
            p += 1
            while p % 8 == 0 and p // 8 < len(words) and words[p // 8] == 0:
                p += 8
        else:
            y, start = p // width, p
            end = (y + 1) * width
            while p < end and flat[p] != 0:
                p += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = y, start - y * width, p - y * width
            count += 1
    return runs, count


@compiled()
def _root(parent: np.ndarray, k: int) -> int:
    """The first run of a run's component, as far as it is known."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k
