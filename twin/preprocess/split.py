"""Caps that touch and merged into one component: one disc each, where the pixels allow."""

import numpy as np

from twin.preprocess.blobs import Blobs
from twin.preprocess.matching import FINAL_GATE
from twin.preprocess.reference import Reference

REACH_PX = 2  # how far from a pin's predicted place a component may lie to be claimed
MIN_AREA_SHARE = 0.65  # of the areas expected of all claimants: less is one cap, not several
MIN_SEPARATION = 0.6  # of two parts, in cap diameters
ROUNDS = 12


def _label_at(blobs: Blobs, x: float, y: float) -> int:
    """Label of the component at a place in the frame, or of the nearest within reach; 0 for none."""
    column, row = np.round(np.array([x, y]) - blobs.corner_px).astype(int)
    height, width = blobs.labels.shape
    if not (0 <= column < width and 0 <= row < height):
        return 0
    top, left = max(row - REACH_PX, 0), max(column - REACH_PX, 0)
    patch = blobs.labels[top : row + REACH_PX + 1, left : column + REACH_PX + 1]
    rows, columns = np.nonzero(patch)
    if not len(rows):
        return 0
    nearest = np.argmin((rows + top - row) ** 2 + (columns + left - column) ** 2)
    return int(patch[rows[nearest], columns[nearest]])


def _parts(blobs: Blobs, label: int, seeds_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted k-means of a component's pixels from seeds: centres (n, 2) px of the frame, shares of the weight (n,)."""
    rows, columns = np.nonzero(blobs.labels == label)
    level = blobs.gray[rows, columns].astype(float)
    weight = np.maximum(level - level.min(), 0) if np.ptp(level) else np.ones_like(level)
    pixels = np.stack([columns, rows], axis=1) + blobs.corner_px
    centers = seeds_px + (np.average(pixels, axis=0, weights=weight) - seeds_px.mean(axis=0))
    share = np.zeros(len(centers))
    for _ in range(ROUNDS):
        owner = ((pixels[:, None] - centers) ** 2).sum(axis=2).argmin(axis=1)
        share = np.bincount(owner, weight, len(centers))
        if (share <= 0).any():
            return centers, share / weight.sum()
        moved = np.stack([np.bincount(owner, weight * pixels[:, axis], len(centers)) / share for axis in (0, 1)], axis=1)
        if np.abs(moved - centers).max() < 1e-3:
            break
        centers = moved
    return centers, share / weight.sum()


def split_merged(reference: Reference, blobs: Blobs, blob: np.ndarray, predicted_px: np.ndarray) -> tuple[np.ndarray, set]:
    """Pins (N, 2) px, with components that several pins claim split among them.

    A component is claimed by the pin it was matched to and by lost pins predicted on it. Where it is large enough for
    all and falls into as many parts near the predictions, each pin gets its own part; otherwise a component too large for one cap
    is given to nobody.

    Parameters
    ----------
    blob : (N,) int
        Blob of each pin, -1 for none.
    predicted_px : (N, 2) float

    Returns
    -------
    pins_px : (N, 2) float
        NaN where a pin has none.
    used : set of int
        Labels of components that were split.
    """
    found = blob >= 0
    pins_px = np.full((len(blob), 2), np.nan)
    pins_px[found] = blobs.px[blob[found]]
    used: set[int] = set()
    claims: dict[int, list[int]] = {}
    for pin in np.flatnonzero(~found & np.isfinite(predicted_px).all(axis=1)):
        label = _label_at(blobs, *predicted_px[pin])
        if label:
            claims.setdefault(label, []).append(int(pin))
    if not claims:
        return pins_px, used
    owner = {int(blobs.label[blob[pin]]): int(pin) for pin in np.flatnonzero(found)}
    area = np.full(len(blob), np.nan)
    area[found] = blobs.area_px2[blob[found]]
    for label, pins in claims.items():
        if label in owner:
            pins.append(owner[label])
        if len(pins) < 2:
            continue
        expected = np.array([np.nanmedian(area[reference.neighbours[p]]) if found[reference.neighbours[p]].any() else np.inf for p in pins])
        if blobs.label_area_px2[label] < MIN_AREA_SHARE * expected.sum():
            continue
        centers, share = _parts(blobs, label, predicted_px[pins])
        apart = np.linalg.norm(centers[:, None] - centers, axis=2) + 1e9 * np.eye(len(pins))
        diameter = 2 * np.sqrt(expected.mean() / np.pi)
        off = np.linalg.norm(centers - predicted_px[pins], axis=1) / reference.spacing_px[pins]
        good = apart.min() > MIN_SEPARATION * diameter and off.max() < FINAL_GATE and share.min() > 0.5 / len(pins)
        pins_px[pins] = centers if good else np.nan
        used.add(label)
    return pins_px, used
