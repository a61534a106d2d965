"""Blobs of a frame by square cell, in which the blobs near a place are found."""

from collections.abc import Iterator

import numpy as np

from twin.compiled import compiled

Buckets = tuple[np.ndarray, np.ndarray, float, float, int, int]
"""First blob of each cell, next blob in the same cell, x0, y0, columns, rows."""


@compiled()
def fill_buckets(px: np.ndarray, cell: float) -> Buckets:
    """Put blobs (K, 2) into square cells with the side ``cell``, px."""
    x0, y0 = px[:, 0].min(), px[:, 1].min()
    columns = int((px[:, 0].max() - x0) / cell) + 1
    rows = int((px[:, 1].max() - y0) / cell) + 1
    head = np.full(columns * rows, -1)
    following = np.full(len(px), -1)
    for k in range(len(px)):
        c = int((px[k, 1] - y0) / cell) * columns + int((px[k, 0] - x0) / cell)
        following[k] = head[c]
        head[c] = k
    return head, following, x0, y0, columns, rows


@compiled()
def blobs_near(x: float, y: float, reach: float, px: np.ndarray, buckets: Buckets, cell: float) -> Iterator[tuple[int, float]]:
    """Blobs within ``reach`` of (x, y): index and squared distance of each."""
    head, following, x0, y0, columns, rows = buckets
    for cy in range(max(int((y - reach - y0) / cell), 0), min(int((y + reach - y0) / cell), rows - 1) + 1):
        for cx in range(max(int((x - reach - x0) / cell), 0), min(int((x + reach - x0) / cell), columns - 1) + 1):
            k = head[cy * columns + cx]
            while k >= 0:
                d2 = (px[k, 0] - x) ** 2 + (px[k, 1] - y) ** 2
                if d2 < reach * reach:
                    yield k, d2
                k = following[k]


@compiled()
def nearest_free(x: float, y: float, reach: float, px: np.ndarray, taken: np.ndarray, buckets: Buckets, cell: float) -> tuple[int, float]:
    """Nearest free blob within ``reach`` of (x, y): (index or -1, squared distance)."""
    best, best_d2 = -1, reach * reach
    for k, d2 in blobs_near(x, y, reach, px, buckets, cell):
        if d2 < best_d2 and not taken[k]:
            best, best_d2 = k, d2
    return best, best_d2
