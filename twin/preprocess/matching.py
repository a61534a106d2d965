"""Which blob is which pin: grow a consistent labelling over the rest layout from a seed, keep the best of several.

The displacement of a pin may exceed the pitch, so the nearest blob proves nothing. But neighbours
move alike: from one right pair the next pin's place is predicted by the local affine motion of those already
paired, and the labelling grows over the layout. Growth from a wrong seed runs out of blobs or into large
residuals; the seed that explains most blobs wins.

One wrong labelling is nearly as smooth as the true one: every ring of pins turned on by one pin, a vortex with a still rim
when the view itself is turned by some degrees. Only its centre gives it away: ring i of 6 i pins is turned by 60/i degrees,
and the innermost rings fall apart. So every growth is unwound to where its rings turn most alike before it is judged.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import linear_sum_assignment

from twin.preprocess.motion import predict, predict_all
from twin.preprocess.reference import Reference

GROW_GATES = (0.30, 0.45)  # prediction to blob, in local spacings, while growing: strict first
FINAL_GATE = 0.40  # prediction to blob, in local spacings, in the final assignment
ADOPT_GATE = 0.7  # the same for a lost pin and a free blob that are each other's nearest ...
ADOPT_AREA_RATIO = 2.0  # ... if the blob's area is within this ratio of its neighbours'
SOFT_RESIDUAL = 0.15  # residual, in local spacings, at which a pair's weight is halved
AREA_LOG_WEIGHT = 0.02  # cost of a log-area ratio of 1 against a squared residual in spacings
MIN_AREA_RATIO = 0.2  # a blob smaller than this part of its neighbours' mean area is a speck, not a pin
NEARLY_ALL = 0.985  # of the pins (or nearly so of the blobs, and this part of the pins) labelled by one growth ...
MIN_SETTLED = 0.7
SETTLED = 0.94  # ... at a score of this part of their number: no further seed is tried
TURN_WEIGHT = 1.5  # of the rings' mean turn (1 - its cosine) in the score, per pin
MAX_WINDING = 3  # by so many pins either way may a growth's rings be turned on ...
BROKEN_RINGS = 2  # ... but for the innermost, which don't hold together then
EXTENT_MARGIN = 0.02  # of the points on each side; the rest's middle tells how far the whole view is displaced
RIM_SEEDS = 12
REFINED = 4  # growths that are refined when none settles


class Layout(NamedTuple):
    """The reference's arrays that matching needs: rest (N, 2) px, neighbours (N, k), spacing (N,) px, ring_ends (R + 1,).

    Ring i's pins are ``ring_ends[i - 1]`` to ``ring_ends[i]``, in order around the layout.
    """

    rest: np.ndarray
    neighbours: np.ndarray
    spacing: np.ndarray
    ring_ends: np.ndarray


@dataclass(frozen=True)
class Match:
    """A labelling of the blobs.

    Attributes
    ----------
    blob : (N,) int
        Blob of each pin, -1 for none.
    predicted_px : (N, 2) float
        Each pin's place as its neighbours' motion predicts it.
    score : float
        Pins paired, less their squared residuals relative to the gate, less what the rings turn.
    """

    blob: np.ndarray
    predicted_px: np.ndarray
    score: float


@njit(cache=True)
def _buckets(px, cell):
    """Blobs by square cell: (first blob of each cell, next blob in the same cell, x0, y0, columns, rows)."""
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


@njit(cache=True)
def _nearest(x, y, reach, px, taken, buckets, cell):
    """Nearest free blob within ``reach`` of (x, y): (index or -1, squared distance)."""
    head, following, x0, y0, columns, rows = buckets
    best, best_d2 = -1, reach * reach
    for cy in range(max(int((y - reach - y0) / cell), 0), min(int((y + reach - y0) / cell), rows - 1) + 1):
        for cx in range(max(int((x - reach - x0) / cell), 0), min(int((x + reach - x0) / cell), columns - 1) + 1):
            k = head[cy * columns + cx]
            while k >= 0:
                if not taken[k]:
                    d2 = (px[k, 0] - x) ** 2 + (px[k, 1] - y) ** 2
                    if d2 < best_d2:
                        best, best_d2 = k, d2
                k = following[k]
    return best, best_d2


@njit(cache=True)
def _grow(rest, neighbours, spacing, px, start, buckets, cell):
    """Grow a labelling (N,), from ``start`` (N,) with at least one pair, round by round over the pins next to labelled ones."""
    n = len(rest)
    blob = start.copy()
    moved = np.zeros((n, 2))
    weight = np.zeros(n)
    taken = np.zeros(len(px), np.bool_)
    near = min(6, neighbours.shape[1])
    labelled = 0
    for i in range(n):
        if blob[i] >= 0:
            moved[i] = px[blob[i]]
            weight[i] = 1.0
            taken[blob[i]] = True
            labelled += 1
    claim = np.full(len(px), -1)
    claim_cost = np.zeros(len(px))
    tried = np.full(n, -1)  # neighbours that had spoken when a pin was last tried
    for level in range(len(GROW_GATES)):
        tried[:] = -1
        least = 3 if level == 0 else 2
        growing = True
        while growing:
            growing = False
            claim[:] = -1
            for i in range(n):
                if blob[i] >= 0:
                    continue
                touching = 0
                for k in range(near):
                    touching += blob[neighbours[i, k]] >= 0
                if touching == 0:
                    continue
                ux, uy, count = predict(i, rest, neighbours, spacing, moved, weight)
                if count == tried[i] or count < min(least, labelled):
                    continue
                tried[i] = count
                x, y = rest[i, 0] + ux, rest[i, 1] + uy
                k, d2 = _nearest(x, y, GROW_GATES[level] * spacing[i], px, taken, buckets, cell)
                if k >= 0:
                    cost = d2 / (spacing[i] * spacing[i])
                    if claim[k] < 0 or cost < claim_cost[k]:
                        claim[k] = i
                        claim_cost[k] = cost
            for k in range(len(px)):
                i = claim[k]
                if i >= 0:
                    blob[i] = k
                    moved[i] = px[k]
                    weight[i] = 1.0
                    taken[k] = True
                    labelled += 1
                    growing = True
    return blob


@njit(cache=True)
def _ring_turns(rest, px, blob, ring_ends, winding):
    """Turn of each ring (R,) as a unit complex number (0: unknown), its labels first put back by ``winding`` pins; number known."""
    turns = np.zeros(len(ring_ends) - 1, np.complex128)
    known = 0
    for ring in range(len(turns)):
        first, size = ring_ends[ring], ring_ends[ring + 1] - ring_ends[ring]
        count = 0
        at, to, product = 0j, 0j, 0j
        for k in range(size):
            j = blob[first + (k - winding) % size]
            if j >= 0:
                a = complex(rest[first + k, 0], rest[first + k, 1])
                b = complex(px[j, 0], px[j, 1])
                at += a
                to += b
                product += a.conjugate() * b
                count += 1
        if count > 2:
            turn = product - at.conjugate() * to / count
            if abs(turn) > 0:
                turns[ring] = turn / abs(turn)
                known += 1
    return turns, known


@njit(cache=True)
def _unwound(rest, px, blob, ring_ends):
    """A labelling (N,) with each ring's labels put back by as many pins as makes the rings turn most alike, less what breaks by it."""
    best, most_alike = 0, abs(_ring_turns(rest, px, blob, ring_ends, 0)[0][BROKEN_RINGS:].sum())
    for winding in range(-MAX_WINDING, MAX_WINDING + 1):
        alike = abs(_ring_turns(rest, px, blob, ring_ends, winding)[0][BROKEN_RINGS:].sum())
        if alike > most_alike:
            best, most_alike = winding, alike
    if best == 0:
        return blob
    out = np.full_like(blob, -1)
    for ring in range(BROKEN_RINGS, len(ring_ends) - 1):
        first, size = ring_ends[ring], ring_ends[ring + 1] - ring_ends[ring]
        for k in range(size):
            out[first + k] = blob[first + (k - best) % size]
    return out


@njit(cache=True)
def _trust(rest, neighbours, spacing, px, blob):
    """Weights (N,) of the pairs by their residual to the neighbours' motion; positions (N, 2)."""
    n = len(rest)
    moved, weight = np.zeros((n, 2)), np.zeros(n)
    for i in range(n):
        if blob[i] >= 0:
            moved[i] = px[blob[i]]
            weight[i] = 1.0
    predicted = predict_all(rest, neighbours, spacing, moved, weight)
    for i in range(n):
        if weight[i] > 0:
            r2 = (predicted[i, 0] - moved[i, 0]) ** 2 + (predicted[i, 1] - moved[i, 1]) ** 2
            weight[i] = 1.0 / (1.0 + r2 / (SOFT_RESIDUAL * spacing[i]) ** 2)
            if not np.isfinite(weight[i]):
                weight[i] = 0.0
    return moved, weight


@njit(cache=True)
def _candidates(predicted, neighbours, spacing, px, area, blob, buckets, cell):
    """Gated pairs: arrays of pin, blob, cost; and whether some pin or blob is in more than one."""
    n = len(predicted)
    pins, blobs, costs = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)], [0.0 for _ in range(0)]
    head, following, x0, y0, columns, rows = buckets
    uses = np.zeros(len(px), np.int64)
    contested = False
    for i in range(n):
        x, y = predicted[i, 0], predicted[i, 1]
        if not np.isfinite(x + y):
            continue
        total, count = 0.0, 0
        for k in range(neighbours.shape[1]):
            j = blob[neighbours[i, k]]
            if j >= 0:
                total += area[j]
                count += 1
        expected = total / max(count, 1)
        reach = FINAL_GATE * spacing[i]
        mine = 0
        for cy in range(max(int((y - reach - y0) / cell), 0), min(int((y + reach - y0) / cell), rows - 1) + 1):
            for cx in range(max(int((x - reach - x0) / cell), 0), min(int((x + reach - x0) / cell), columns - 1) + 1):
                k = head[cy * columns + cx]
                while k >= 0:
                    d2 = (px[k, 0] - x) ** 2 + (px[k, 1] - y) ** 2
                    if d2 < reach * reach and area[k] >= MIN_AREA_RATIO * expected:
                        pins.append(i)
                        blobs.append(k)
                        costs.append(d2 / (spacing[i] * spacing[i]) + AREA_LOG_WEIGHT * np.log(area[k] / expected) ** 2)
                        mine += 1
                        uses[k] += 1
                        contested = contested or mine > 1 or uses[k] > 1
                    k = following[k]
    return pins, blobs, costs, contested


def _assign(n: int, blob_count: int, pins: list, blobs: list, costs: list, contested: bool) -> np.ndarray:
    """One-to-one assignment (N,) over the gated pairs: most pairs, then least cost."""
    blob = np.full(n, -1)
    pins, blobs, costs = np.array(pins, int), np.array(blobs, int), np.array(costs, float)
    if not contested:
        blob[pins] = blobs
        return blob
    open_pair = (np.bincount(pins, minlength=n)[pins] > 1) | (np.bincount(blobs, minlength=blob_count)[blobs] > 1)
    blob[pins[~open_pair]] = blobs[~open_pair]
    row_pin, row = np.unique(pins[open_pair], return_inverse=True)
    column_blob, column = np.unique(blobs[open_pair], return_inverse=True)
    table = np.full((len(row_pin), len(column_blob)), 10.0)  # far above any gated cost: pairing more pins always pays
    table[row, column] = costs[open_pair]
    for r, c in zip(*linear_sum_assignment(table), strict=True):
        if table[r, c] < 10.0:
            blob[row_pin[r]] = column_blob[c]
    return blob


def _refine(layout: Layout, px: np.ndarray, area: np.ndarray, blob: np.ndarray, buckets: tuple, cell: float) -> Match:
    """Re-assign every pin to the blobs near where its neighbours predict it, until nothing changes."""
    rest, neighbours, spacing, ring_ends = layout
    for _ in range(4):
        moved, weight = _trust(rest, neighbours, spacing, px, blob)
        predicted = predict_all(rest, neighbours, spacing, moved, weight)
        before = blob
        blob = _assign(len(rest), len(px), *_candidates(predicted, neighbours, spacing, px, area, blob, buckets, cell))
        if np.array_equal(blob, before):
            break
    blob = _adopt(layout, px, area, blob, predicted)
    found = blob >= 0
    residual2 = ((px[blob[found]] - predicted[found]) ** 2).sum(axis=1) / (FINAL_GATE * spacing[found]) ** 2
    turns, count = _ring_turns(rest, px, blob, ring_ends, 0)
    turned = 1.0 - turns.real.sum() / max(count, 1)
    return Match(blob, predicted, float(found.sum() - residual2.sum() - TURN_WEIGHT * len(rest) * turned))


def _adopt(layout: Layout, px: np.ndarray, area: np.ndarray, blob: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Give lost pins the free blobs of a cap's size a little outside the gate: at the rim the prediction is an extrapolation."""
    neighbours, spacing = layout.neighbours, layout.spacing
    lost = np.flatnonzero((blob < 0) & np.isfinite(predicted[:, 0]))
    free = np.setdiff1d(np.arange(len(px)), blob)
    if not len(lost) or not len(free) or len(lost) > 0.2 * len(blob):
        return blob
    distance = np.linalg.norm(px[free] - predicted[lost][:, None], axis=2) / spacing[lost][:, None]
    around = np.where(blob[neighbours[lost]] >= 0, area[blob[neighbours[lost]]], np.nan)
    spoken = np.isfinite(around).any(axis=1)
    expected = np.full(len(lost), np.nan)
    expected[spoken] = np.nanmedian(around[spoken], axis=1)
    ratio = area[free] / expected[:, None]
    distance[~((ratio > 1 / ADOPT_AREA_RATIO) & (ratio < ADOPT_AREA_RATIO))] = np.inf
    blob = blob.copy()
    for row, column in zip(*np.nonzero(distance < ADOPT_GATE), strict=True):
        if distance[row, column] == distance[row].min() == distance[:, column].min():
            blob[lost[row]] = free[column]
    return blob


def _middle(px: np.ndarray) -> np.ndarray:
    """Middle (2,) of the extent of points (K, 2), but for the outermost few."""
    ordered = np.sort(px, axis=0)
    margin = int(EXTENT_MARGIN * len(px))
    return (ordered[margin] + ordered[-1 - margin]) / 2


def _seeds(reference: Reference, px: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs to start from: pins around the rim, where motion is least, then inside, with their 1st, 2nd, 3rd nearest blobs."""
    rim, inside = reference.outmost, len(reference.pins_px) - len(reference.outmost)
    pins = np.concatenate([rim[np.linspace(0, len(rim), RIM_SEEDS, endpoint=False).astype(int)], [*range(0, inside, max(inside // 6, 1))]])
    extent = _middle(px) - _middle(reference.pins_px)
    median = np.median(px, axis=0) - np.median(reference.pins_px, axis=0)
    seen = set()
    for rank in range(3):
        for offset in (extent, np.zeros(2), median):
            for pin in pins.tolist():
                distance2 = ((px - (reference.pins_px[pin] + offset)) ** 2).sum(axis=1)
                pair = pin, int(np.argpartition(distance2, rank)[rank])
                if pair not in seen:
                    seen.add(pair)
                    yield pair


def _regrown(layout: Layout, px: np.ndarray, area: np.ndarray, found: Match, buckets: tuple, cell: float) -> Match:
    """Forget the labels around the lost pins and grow them anew from the others."""
    rest, neighbours = layout.rest, layout.neighbours
    for reach in (6, neighbours.shape[1]):
        doubtful = np.zeros(len(rest), bool)
        lost = found.blob < 0
        doubtful[neighbours[lost, :reach].ravel()] = True
        start = np.where(doubtful, -1, found.blob)
        if (start >= 0).sum() < 0.5 * len(rest):
            break
        again = _refine(layout, px, area, _grow(*layout[:3], px, start, buckets, cell), buckets, cell)
        if again.score > found.score:
            found = again
        if (found.blob >= 0).all():
            break
    return found


def _layout(reference: Reference) -> Layout:
    n, rings = len(reference.pins_px), len(reference.outmost) // 6
    ring = np.arange(rings + 1)
    ring_ends = n - 3 * (rings * (rings + 1) - ring * (ring + 1))
    return Layout(reference.pins_px, reference.neighbours, reference.spacing_px, ring_ends)


def match(reference: Reference, px: np.ndarray, area_px2: np.ndarray) -> Match:
    """Label blobs by the pins of a reference.

    Parameters
    ----------
    reference : Reference
    px : (K, 2) float
        Blob centroids, px, in any order.
    area_px2 : (K,) float
        Blob areas.

    Returns
    -------
    Match
        The best labelling found; it may be poor: see its score.
    """
    n = len(reference.pins_px)
    nothing = Match(np.full(n, -1), np.full((n, 2), np.nan), -1.0)
    if len(px) < 3:
        return nothing
    px = np.ascontiguousarray(px)
    layout = _layout(reference)
    cell = float(np.median(reference.spacing_px))
    buckets = _buckets(px, cell)
    grown = []
    for pin, blob in _seeds(reference, px):
        start = np.full(n, -1)
        start[pin] = blob
        labels = _grow(*layout[:3], px, start, buckets, cell)
        unwound = _unwound(layout.rest, px, labels, layout.ring_ends)
        if (unwound >= 0).any() and not np.array_equal(unwound, labels):
            labels = _grow(*layout[:3], px, unwound, buckets, cell)
        count = int((labels >= 0).sum())
        if count >= NEARLY_ALL * n or (count >= NEARLY_ALL**2 * len(px) and count > MIN_SETTLED * n):
            found = _refine(layout, px, area_px2, labels, buckets, cell)
            if found.score >= SETTLED * count:
                grown = [(found.score, labels, found)]
                break
        grown.append((count, labels, None))
    grown.sort(key=lambda entry: -entry[0])
    best = nothing
    for _, labels, found in grown[:REFINED]:
        found = found or _refine(layout, px, area_px2, labels, buckets, cell)
        best = max(best, found, key=lambda entry: entry.score)
    lost = int((best.blob < 0).sum())
    if 0 < lost < 0.3 * n and len(px) > n - lost:
        best = _regrown(layout, px, area_px2, best, buckets, cell)
    return best


def rematch(reference: Reference, px: np.ndarray, area_px2: np.ndarray, blob: np.ndarray) -> Match:
    """Settle a labelling ``blob`` (N,) of nearly all pins on a slightly different set of blobs, as ``match`` would."""
    px = np.ascontiguousarray(px)
    cell = float(np.median(reference.spacing_px))
    layout = _layout(reference)
    return _refine(layout, px, area_px2, blob, _buckets(px, cell), cell)
