"""Labelling of bright spots by the places of a lattice, from a few labels outwards, for any scale, turn and distortion of the view.

A local affine map, fitted to the labelled places around the next place, predicts the position of this place in the frame. Therefore the
lattice may be foreshortened or slowly curved; only its topology must be known. All distances are relative to the local spacing. All limits
were chosen, not derived.
"""

import numpy as np

from twin.compiled import compiled
from twin.pins.labelling.buckets import fill_buckets, nearest_free

NEIGHBOURS = 18
"""Number of neighbours that predict the position of a place: two rings of a triangular lattice."""
NEAR = 8
"""A place is tried when at least two of this many nearest places are labelled."""
GATES = (0.25, 0.38)
"""Largest distance from a prediction to its spot, in local spacings, during growth: first the strict limit, then the wide one."""
LEAST_AROUND = (4, 3)
"""Least number of labelled neighbours for a prediction, with each limit of ``GATES``."""
FINAL_GATE = 0.42
"""Largest distance of a spot from the prediction by all its labelled neighbours, in local spacings. A label beyond it is removed."""
MOST_STRETCH = 3.0
"""Largest ratio of the local map's scales in two directions. Around a cap at the rim of a dome the ratio is 2."""
ROUNDS = 3
"""Number of rounds. Each round grows the labelling and then removes the labels that contradict their neighbours; the last only grows."""


@compiled()
def predict_place(i: int, lattice: np.ndarray, around: np.ndarray, spot: np.ndarray, px: np.ndarray) -> tuple[float, float, float, int]:
    """Predict the position of place ``i`` from its labelled neighbours: x, y, local spacing (px), and the number of these neighbours.

    The prediction is a weighted affine map. The number is 0 if the map is not determined, mirrors the lattice, or stretches it too much.
    """
    m = np.zeros((3, 3))
    bx, by = np.zeros(3), np.zeros(3)
    v = np.ones(3)
    count = 0
    for k in range(around.shape[1]):
        j = around[i, k]
        if spot[j] < 0:
            continue
        count += 1
        v[1], v[2] = lattice[j, 0] - lattice[i, 0], lattice[j, 1] - lattice[i, 1]
        w = 1.0 / (0.5 + v[1] * v[1] + v[2] * v[2])
        for a in range(3):
            bx[a] += w * v[a] * px[spot[j], 0]
            by[a] += w * v[a] * px[spot[j], 1]
            for b in range(3):
                m[a, b] += w * v[a] * v[b]
    if count < 3:
        return 0.0, 0.0, 0.0, 0
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    c01 = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    c02 = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    if abs(det) < 1e-6 * m[0, 0] ** 3:
        return 0.0, 0.0, 0.0, 0
    c11, c12 = m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0], m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]
    c22 = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
    fx, fy = np.empty(3), np.empty(3)
    for to, of in ((fx, bx), (fy, by)):  # cofactors invert the symmetric matrix m, because LAPACK is slower for such a small matrix
        to[0] = (c00 * of[0] + c01 * of[1] + c02 * of[2]) / det
        to[1] = (c01 * of[0] + c11 * of[1] + c12 * of[2]) / det
        to[2] = (c02 * of[0] + c12 * of[1] + c22 * of[2]) / det
    area = fx[1] * fy[2] - fx[2] * fy[1]
    size2 = fx[1] ** 2 + fx[2] ** 2 + fy[1] ** 2 + fy[2] ** 2
    if area <= 0:
        return 0.0, 0.0, 0.0, 0
    root = np.sqrt(max(size2 * size2 / 4 - area * area, 0.0))
    if size2 / 2 + root > MOST_STRETCH**2 * max(size2 / 2 - root, 1e-12):
        return 0.0, 0.0, 0.0, 0
    return fx[0], fy[0], np.sqrt(max(size2 / 2 - root, 0.0)), count


@compiled()
def grow(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, start: np.ndarray, cell: float) -> np.ndarray:
    """Grow a labelling: the spot (M,) of each place of a lattice, -1 for no spot.

    Parameters
    ----------
    lattice : (M, 2) float
        Positions of the places. Neighbouring places are about 1 apart.
    around : (M, k) int
        Neighbours of each place, the nearest first.
    px : (K, 2) float
        The spots.
    start : (M,) int
        First labels, at least three, not on a line.
    cell : float
        Side of the square cells in which spots are looked up, px: about their spacing.
    """
    n = len(lattice)
    spot = start.copy()
    taken = np.zeros(len(px), np.bool_)
    for i in range(n):
        if spot[i] >= 0:
            taken[spot[i]] = True
    buckets = fill_buckets(px, cell)
    claim, claimed = np.full(len(px), -1), np.zeros(len(px))
    near = min(NEAR, around.shape[1])
    for round_ in range(ROUNDS):
        for level in range(len(GATES)):
            tried = np.zeros(n, np.int64)
            growing = True
            while growing:
                growing = False
                claim[:] = -1
                for i in range(n):
                    if spot[i] >= 0:
                        continue
                    touching = 0
                    for k in range(near):
                        touching += spot[around[i, k]] >= 0
                    if touching < 2:
                        continue
                    labelled = 0
                    for k in range(around.shape[1]):
                        labelled += spot[around[i, k]] >= 0
                    if labelled < LEAST_AROUND[level] or labelled == tried[i]:
                        continue
                    tried[i] = labelled
                    x, y, spacing, count = predict_place(i, lattice, around, spot, px)
                    if count == 0:
                        continue
                    k, d2 = nearest_free(x, y, GATES[level] * spacing, px, taken, buckets, cell)
                    if k >= 0:
                        miss = d2 / spacing**2
                        if claim[k] < 0 or miss < claimed[k]:
                            claim[k], claimed[k] = i, miss
                for k in range(len(px)):
                    if claim[k] >= 0:
                        spot[claim[k]], taken[k] = k, True
                        growing = True
        if round_ == ROUNDS - 1:
            break
        kept = spot.copy()
        for i in range(n):
            if spot[i] >= 0:
                x, y, spacing, count = predict_place(i, lattice, around, spot, px)
                if count == 0 or (px[spot[i], 0] - x) ** 2 + (px[spot[i], 1] - y) ** 2 > (FINAL_GATE * spacing) ** 2:
                    kept[i] = -1
        if np.array_equal(kept, spot):
            break
        for i in range(n):
            if spot[i] >= 0 and kept[i] < 0:
                taken[spot[i]] = False
        spot = kept
    return spot


@compiled()
def locate_places(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, spot: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Positions (M, 2), px, of a lattice's places: of the spots, or predicted from labelled neighbours; NaN without a prediction.

    A predicted position may lie outside the frame. It then shows that the frame cuts a pin off.
    """
    out = np.full((len(lattice), 2), np.nan)
    for i in range(len(lattice)):
        if spot[i] >= 0:
            out[i, 0], out[i, 1] = px[spot[i], 0], px[spot[i], 1]
        else:
            x, y, _, count = predict_place(i, lattice, around, spot, px)
            if count > 0 and -size_px[0] < x < 2 * size_px[0] and -size_px[1] < y < 2 * size_px[1]:
                out[i, 0], out[i, 1] = x, y
    return out
