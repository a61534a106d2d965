"""Labelling of blobs by pins: labellings are grown over the layout at rest from several starts, and the best one is used.

A pin may move by more than the distance to its neighbour, so the nearest blob is not always the right one. But the motions of neighbours
are similar. A labelling starts from one pair of pin and blob. The local affine motion of the pairs found so far predicts the place of the
next pin, and so the labelling grows over the layout. If the first pair is wrong, it soon finds no blobs, or only blobs far from the
predictions. The start that explains most blobs is used.

One wrong labelling is nearly as smooth as the true one: each ring of pins is shifted along itself by one pin. Ring i has 6 i pins, so it
is turned by 60 / i degrees, and only the innermost rings, which turn most, are inconsistent. Therefore each labelling is unwound before
it is evaluated: its rings are shifted back by the number of pins with which the turns of all rings are most similar.

Where contacts squeeze and stretch the layout so far that the grown labelling does not prove itself, all pins drift to the blobs at once
(`twin.geometry.drift`). A labelling proves itself if no triangle of the layout is turned over, and no pin or no blob is left over.

Distances are in local spacings: the distance of a pin at rest to its nearest neighbour. All limits were chosen, not derived.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from twin.compiled import compiled
from twin.geometry.drift import drift
from twin.pins.labelling.reference import Reference, count_turned_over, median_px

RIDGE = 0.25
"""Penalty of the local gradient, which draws it towards zero. It is equivalent to this many neighbours at a distance of one spacing."""
GROW_GATES = (0.30, 0.45)
"""Largest distance from a prediction to its blob while a labelling grows: in the first pass, and in the second."""
FINAL_GATE = 0.40
"""Largest distance from a prediction to its blob in the final assignment."""
ADOPT_GATE = 0.55
"""Largest distance from the prediction of a lost pin to a free blob that it gets, if each is the other's nearest."""
ADOPT_AREA_RATIO = 2.0
"""Largest ratio of the area of a blob that is given to a lost pin to the area of the pin's neighbours, and of the second to the first."""
MOST_ADOPTED = 0.2
"""Largest share of lost pins at which lost pins are given free blobs."""
SOFT_RESIDUAL = 0.15
"""Distance of a pair from the prediction at which its weight is halved."""
AREA_LOG_WEIGHT = 0.02
"""Cost of a squared logarithm of the ratio of areas of 1, in units of a squared distance in spacings."""
MIN_AREA_RATIO = 0.2
"""Least area of a pin's blob, relative to the mean area of its neighbours. Smaller blobs are specks."""
NO_PAIR_COST = 10.0
"""Cost of a pin without a blob. It is far above the cost of any pair, so that more pairs always have a smaller cost."""
REFINE_ROUNDS = 4
"""Most rounds of predicting and assigning. They end earlier if nothing changes."""
NEARLY_ALL = 0.985
"""Share of the pins that a labelling must hold to be refined at once. One that holds at least the square of this share of the blobs, and
MIN_SETTLED of the pins, is also refined at once."""
MIN_SETTLED = 0.7
"""Least share of the pins of a labelling that is refined at once because it holds nearly all blobs."""
SETTLED = 0.94
"""Least ratio of a labelling's score to the number of pins after which no further start is tried."""
TURN_WEIGHT = 1.5
"""Weight in the score, for each pin, of the rings' mean turn (1 minus its cosine)."""
MAX_WINDING = 3
"""Largest shift of rings along themselves, in pins in each direction."""
ROUNDING = 1e-9
"""Difference of two sums of unit vectors that is only rounding."""
BROKEN_RINGS = 2
"""Number of innermost rings that are left out when the shift is found, because they are inconsistent in a shifted labelling."""
EXTENT_MARGIN = 0.02
"""Share of the points that is left out on each side of their extent. The middle of the extent is used as the place of the whole view."""
SEED_RANKS = 3
"""Number of nearest blobs that are tried for each of these pins."""
REFINED = 8
"""Number of different labellings that are refined if none reaches ``SETTLED``: those with the most pins."""
NEAR_REST = 0.35
"""Displacement of the rim, in spacings, below which the first settled labelling ends the search, also if pins are missing: one that is a
row apart is displaced by more than half a spacing."""
HARDLY_MOVED = 0.75
"""Displacement of the rim, in spacings, below which the first labelling that holds all pins and blobs and turns no triangle over ends the
search, also if its pins hardly move alike. One that is a row apart lacks a row, and leaves one over."""
DISPLACED_COST = 0.25
"""Cost of a displacement of the rim by one spacing, in rows of pins (the square root of their number), when labellings are compared."""
SAME_LABELLING = 0.5
"""Share of equal pairs below which two labellings are quite different."""
NEAR = 6
"""Number of nearest neighbours by which parts of a labelling are linked, and of pins beside a gap that decide on names across it."""
SEAM = 0.7
"""Least difference between the motions of neighbouring pins, in spacings, at which a seam may separate them. It is 1 where names are
shifted by a pin; in contacts with true names at most some 0.6, and 0.9 where the skin slips."""
FOLLOW_GATE = 0.45
"""Largest motion of a pin between consecutive frames, in spacings, with which its name is carried over: less than half a row."""
PREDICTED_WEIGHT = 0.1
"""Weight of a predicted pin in the prediction of the next one. Pins in a gap are predicted from the gap's edge inwards."""
Stiffnesses = tuple[tuple[float, float], ...]
STIFFNESS: Stiffnesses = ((2.0, 2.0), (1.5, 1.0), (3.0, 3.0), (1.0, 0.5))
"""Widths beta, in spacings, and weights lambda of coherence that are tried in turn until a labelling proves itself. Where the grown
labelling turns nothing over and loses few pins, only the first is."""
DRIFT_REACH = 0.6
"""Largest distance from a pin to its blob after the drift, in spacings."""
DRIFT_SPECK = 0.2
"""Least area of a blob that may be a pin, relative to the median."""
MOST_BLOBS = 1.5
"""Most blobs for each pin. With more, a frame shows something else."""
MOST_LOST = 0.1
"""Largest share of lost pins. What a larger hole hides, a coherent motion may pull apart or push together."""
MOST_LEFT = 0.03
"""Largest number of blobs among the pins that are none of them, as a share of the pins: every blob should be explained."""
MOST_MISFIT = 0.15
"""Largest rms distance, in spacings, from the places of the coherent motion to the blobs. Deep contacts of two recordings have
at most 0.13, a torn picture 0.18."""


class LayoutArrays(NamedTuple):
    """The reference's arrays that kernels need: rest (N, 2) px, neighbours (N, k), beside (N, k, 3), spacing (N,) px."""

    rest: np.ndarray
    neighbours: np.ndarray
    beside: np.ndarray
    spacing: np.ndarray


class FrameBlobs(NamedTuple):
    """Blobs of a frame in square cells, in which they are looked up.

    Attributes
    ----------
    px : (K, 2) float
    area : (K,) float
    order, first : (K,), (C + 1,) int
        The blobs' numbers by rows of cells, and where each cell's numbers begin.
    left, top, cell : float
        The corner of the first cell, and a cell's side, px.
    columns : int
        Cells in a row.
    """

    px: np.ndarray
    area: np.ndarray
    order: np.ndarray
    first: np.ndarray
    left: float
    top: float
    cell: float
    columns: int


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
        Number of pins paired, minus their squared distances from the predictions relative to the gate, minus the cost of the rings'
        turn. Larger is better.
    lead : float
        Difference between the scores of this and the best quite different labelling, each less the cost of its displacement from the
        places at rest; infinite if none had to be tried.
    drifted : bool
        Whether the labelling is a drifted one. Its predictions are the places to which the pins drifted.
    """

    blob: np.ndarray
    predicted_px: np.ndarray
    score: float
    lead: float = float("inf")
    drifted: bool = False


def match(reference: Reference, px: np.ndarray, area_px2: np.ndarray, *, second_look: bool = True) -> Match:
    """Label blobs by the pins of a reference.

    Parameters
    ----------
    reference : Reference
    px : (K, 2) float
        Blob centroids, px, in any order.
    area_px2 : (K,) float
        Blob areas.
    second_look : bool
        Whether the pins drift (`look_again`) if the grown labelling does not prove itself.

    Returns
    -------
    Match
        The best labelling that was found. Its score states how good it is.
    """
    found = _grow_labelling(reference, px, area_px2)
    return found if not second_look or proven(reference, px, found.blob) else look_again(reference, px, area_px2, found)


def follow(reference: Reference, before_px: np.ndarray, px: np.ndarray, area_px2: np.ndarray) -> Match | None:
    """The labelling of blobs (K, 2) with the names that the pins (N, 2) had in the frame before; None if it does not prove itself.

    Each pin has one blob near its last place, no blob is left, no triangle is turned over, and the rim is near its place at rest: these
    are the conditions under which ``match`` ends its search. A labelling that slipped by a row leaves a row of blobs.
    """
    if len(px) != len(before_px):
        return None
    blob = _carry_names(_layout(reference), before_px, _put_in_cells(reference, px, area_px2))
    if (blob < 0).any() or _rim_displacement(reference, px, blob) >= HARDLY_MOVED or not proven(reference, px, blob):
        return None
    return Match(blob, px[blob], float(len(blob)))


def find_again(reference: Reference, px: np.ndarray, area_px2: np.ndarray, before: Match, before_px: np.ndarray) -> Match:
    """A labelling ``before`` of blobs at places (M, 2) for the blobs (K, 2) that another look at the same frame shows: it grows onward."""
    layout, blobs = _layout(reference), _put_in_cells(reference, px, area_px2)
    names = _carry_names(layout, np.where(before.blob[:, None] >= 0, before_px[before.blob], np.nan), blobs)
    return replace(_refine(reference, blobs, _grow(layout, blobs, names)), lead=before.lead)


def _carry_names(layout: LayoutArrays, before_px: np.ndarray, blobs: FrameBlobs) -> np.ndarray:
    """Blob (N,) next to each pin's place (N, 2) before, NaN where it was lost; -1 for a pin that has none of its own."""
    pins, near, away2 = _pairs(before_px, FOLLOW_GATE * layout.spacing, blobs)
    found, owner = np.full(len(before_px), -1), np.full(len(blobs.px), -1)
    farthest = np.argsort(-away2)
    found[pins[farthest]] = near[farthest]  # the last, nearest one counts
    last = np.flatnonzero(found >= 0)[::-1]
    owner[found[last]] = last
    found[last[owner[found[last]] != last]] = -1
    return found


def proven(reference: Reference, px: np.ndarray, blob: np.ndarray) -> bool:
    """Whether a labelling (N,) turns no triangle over and leaves no pin lost, or no blob."""
    known = blob >= 0
    if known.sum() < min(len(blob), len(px)):
        return False
    return not known.any() or not count_turned_over(px[blob], reference.triangles, known)


def look_again(reference: Reference, px: np.ndarray, area_px2: np.ndarray, found: Match) -> Match:
    """The labelling to which the pins drift, or ``found`` if that holds as many pins without turning a triangle over."""
    before = found.blob >= 0
    folded = not before.any() or count_turned_over(px[found.blob], reference.triangles, before) > 0
    doubtful = folded or before.mean() < 1 - MOST_LOST
    labelled = _drift_labelling(reference, px, area_px2, STIFFNESS if doubtful else STIFFNESS[:1])
    if labelled is None:
        return found
    blob, places_px = labelled
    known = blob >= 0
    if before.sum() >= known.sum() and not folded:
        return found
    away2 = ((px[blob[known]] - places_px[known]) ** 2).sum(axis=1) / (FINAL_GATE * reference.spacing_px[known]) ** 2
    score, left = known.sum(), min(len(px), len(blob)) - known.sum()
    return Match(blob, places_px, float(score - away2.sum()), float(np.sqrt(len(blob)) - (len(blob) - score) - left), drifted=True)


def _drift_labelling(
    reference: Reference, px: np.ndarray, area_px2: np.ndarray, stiffnesses: Stiffnesses
) -> tuple[np.ndarray, np.ndarray] | None:
    """Blob (N,) of each pin, -1 for none, and places (N, 2) to which the pins drifted; None if no stiffness proves itself.

    The first one is used that leaves no pin lost, or no blob; else the one with most pins.

    Parameters
    ----------
    reference : Reference
    px, area_px2 : (K, 2), (K,) float
        Places and areas of the blobs.
    stiffnesses : ((beta, lambda), ...)
        Those that are tried in turn.
    """
    n, caps = len(reference.pins_px), np.flatnonzero(area_px2 >= DRIFT_SPECK * np.median(area_px2))
    if not (1 - MOST_LOST) * n <= len(caps) <= MOST_BLOBS * n:
        return None
    spacing = reference.pitch_px
    rest, blobs = reference.pins_px / spacing, px[caps] / spacing
    best, most = None, (1 - MOST_LOST) * n
    for beta, stiffness in stiffnesses:
        places = drift(rest, blobs, reference.motions(beta), stiffness)
        found = _assign_drifted(places, blobs)
        known = found >= 0
        if known.sum() < most or np.mean(np.sum((blobs[found] - places)[known] ** 2, axis=1)) > MOST_MISFIT**2:
            continue
        left = np.delete(blobs, found[known], axis=0)
        beside = int((((left - places[:, None]) ** 2).sum(axis=2).min(axis=0) < 1).sum()) if len(left) else 0
        folded = count_turned_over(blobs[found], reference.triangles, known)
        if beside <= MOST_LEFT * n and not folded:
            best, most = (np.where(known, caps[found], -1), places * spacing), known.sum() + 1
            if known.sum() == min(n, len(caps)):
                break
    return best


def _assign_drifted(places: np.ndarray, blobs: np.ndarray) -> np.ndarray:
    """Blob (N,) of each pin, -1 for none: as many pairs within reach as possible, the nearest of all."""
    from scipy.optimize import linear_sum_assignment  # takes a tenth of a second, and few frames need it

    share2 = ((blobs - places[:, None]) ** 2).sum(axis=2) / DRIFT_REACH**2
    pins, chosen = linear_sum_assignment(np.minimum(share2, 1.0))
    found = np.full(len(places), -1)
    held = share2[pins, chosen] < 1
    found[pins[held]] = chosen[held]
    return found


def _grow_labelling(reference: Reference, px: np.ndarray, area_px2: np.ndarray) -> Match:
    """The best labelling that is grown from pairs."""
    n = len(reference.pins_px)
    nothing = Match(np.full(n, -1), np.full((n, 2), np.nan), -1.0)
    if len(px) < 3:
        return nothing
    layout, blobs = _layout(reference), _put_in_cells(reference, px, area_px2)
    grown: dict[bytes, np.ndarray] = {}
    large: list[np.ndarray] = []  # a start that one of them holds would grow to the same one
    best = None
    for pin, blob in _seeds(reference, px):
        if any(labels[pin] == blob for labels in large):
            continue
        start = np.full(n, -1)
        start[pin] = blob
        labels = _grow(layout, blobs, start)
        unwound = _unwound(reference, blobs.px, labels)
        if (unwound >= 0).any() and not np.array_equal(unwound, labels):
            labels = _grow(layout, blobs, unwound)
        count = int((labels >= 0).sum())
        if count >= NEARLY_ALL * n or (count >= NEARLY_ALL**2 * len(px) and count > MIN_SETTLED * n):
            found = _refine(reference, blobs, labels)
            away = _rim_displacement(reference, px, found.blob)
            settled = found.score >= SETTLED * count and (count >= NEARLY_ALL * n or away < NEAR_REST)
            if settled or (away < HARDLY_MOVED and (found.blob >= 0).sum() == len(px) == n and proven(reference, px, found.blob)):
                best = found
                break
        grown[labels.tobytes()] = labels
        if count >= NEARLY_ALL * n:
            large.append(labels)
    if best is None:
        likely = sorted(grown.values(), key=lambda labels: -int((labels >= 0).sum()))[:REFINED]
        best = _leading(reference, px, [_refine(reference, blobs, labels) for labels in likely])
        if best.score < nothing.score:
            return nothing
    return best


def _leading(reference: Reference, px: np.ndarray, refined: list[Match]) -> Match:
    """The best of some labellings, with its lead over the best of those that are quite different from it.

    They are compared by their scores, less a cost of the rim's displacement: a contact hardly moves the rim, because it is clamped.
    """
    cost = DISPLACED_COST * np.sqrt(len(reference.pins_px))
    worth = [one.score - cost * _rim_displacement(reference, px, one.blob) for one in refined]
    first = int(np.argmax(worth))
    best, paired = refined[first], refined[first].blob >= 0
    same = SAME_LABELLING * paired.sum()
    others = [w for w, one in zip(worth, refined, strict=True) if (one.blob == best.blob)[paired].sum() < same]
    return replace(best, lead=worth[first] - max(others, default=-np.inf))


def _rim_displacement(reference: Reference, px: np.ndarray, blob: np.ndarray) -> float:
    """Displacement of the rim from its place at rest by a labelling ``blob`` (N,): median over the rim's pins, in spacings."""
    rim = reference.outmost[blob[reference.outmost] >= 0]
    if not len(rim):
        return 0.0
    away = median_px(px[blob[rim]] - reference.pins_px[rim])
    return float(np.hypot(*away) / reference.pitch_px)


def rematch(reference: Reference, px: np.ndarray, area_px2: np.ndarray, blob: np.ndarray, found: Match | None = None) -> Match:
    """Refine a labelling ``blob`` (N,) of nearly all pins for a slightly different set of blobs, in the way that ``match`` found it."""
    if found is not None and found.drifted:
        return look_again(reference, px, area_px2, replace(found, blob=np.full(len(blob), -1)))
    return _refine(reference, _put_in_cells(reference, px, area_px2), blob)


def confirm(reference: Reference, px: np.ndarray, area_px2: np.ndarray, found: Match) -> Match:
    """Name the pins that a hole or a seam separates from the others again, from the largest part of a labelling with lost pins.

    Parts are separated by lost pins, or by neighbours whose motions differ by nearly a spacing. A part across a gap keeps its names if
    its nearest pins are where the motion of the largest part predicts them; else it loses them. If the two labellings give a blob two
    names, and the new one is not better, the result has no lead.
    """
    if found.drifted:
        return found
    part, blob = _parts(reference, px, found.blob), found.blob
    main = part == np.bincount(part[part >= 0]).argmax()
    if main[blob >= 0].all():
        return found
    layout, blobs = _layout(reference), _put_in_cells(reference, px, area_px2)
    again = _refine(reference, blobs, _grow(layout, blobs, np.where(main, blob, -1)))
    across = (blob >= 0) & (again.blob < 0) & ~np.isin(blob, again.blob)
    if across.any():
        nodes_px = complete(reference, np.where(again.blob[:, None] >= 0, px[again.blob], np.nan))
        away = np.linalg.norm(px[blob] - nodes_px, axis=1) / reference.spacing_px
        gap, _ = cKDTree(reference.pins_px[again.blob >= 0]).query(reference.pins_px)
        start = again.blob.copy()
        for one in np.unique(part[across]):
            pins = np.flatnonzero(across & (part == one))
            if np.median(away[pins[np.argsort(gap[pins])[:NEAR]]]) < FINAL_GATE:
                start[pins] = blob[pins]
        again = _refine(reference, blobs, start)
    renamed = (again.blob != blob) & (again.blob >= 0) & (blob >= 0)
    return replace(again, lead=0.0 if renamed.any() and again.score <= found.score else found.lead)


def _parts(reference: Reference, px: np.ndarray, blob: np.ndarray) -> np.ndarray:
    """Part (N,) of a labelling (N,) that each pin belongs to, -1 if it is lost. Pins are linked to neighbours that move alike."""
    n, found = len(blob), blob >= 0
    plane = np.column_stack([np.ones(n), reference.pins_px])
    fit = np.linalg.lstsq(plane[found], px[blob[found]], rcond=None)[0]
    moved = (px[blob] - plane @ fit) @ np.linalg.pinv(fit[1:]) / reference.spacing_px[:, None]
    near = reference.neighbours[:, :NEAR]
    alike = np.linalg.norm(moved[near] - moved[:, None], axis=2) < SEAM
    pin, column = np.nonzero(alike & found[:, None] & found[near])
    links = coo_array((np.ones(len(pin)), (pin, near[pin, column])), shape=(n, n))
    return np.where(found, connected_components(links, directed=False)[1], -1)


def complete(reference: Reference, pins_px: np.ndarray) -> np.ndarray:
    """Pins (N, 2) in which lost pins (NaN) are at the places that their neighbours' motion predicts."""
    found = np.isfinite(pins_px[:, 0])
    if found.all():
        return pins_px
    nodes_px = np.where(found[:, None], pins_px, reference.pins_px)
    known = found.astype(float)
    while known.any() and not known.all():  # from the edge of a gap inwards
        predicted = predict_all(_layout(reference), nodes_px, known)
        new = (known == 0) & np.isfinite(predicted[:, 0])
        if not new.any():
            break
        nodes_px[new] = predicted[new]
        known[new] = PREDICTED_WEIGHT
    return nodes_px


@compiled(error_model="numpy")
def predict(i: int, layout: LayoutArrays, moved: np.ndarray, weight: np.ndarray) -> tuple[float, float, int]:
    """Displacement of pin ``i`` as predicted from its neighbours alone, and the number of neighbours that were used.

    u(x) = a + G (x - x_i) is fitted by weighted least squares to the neighbours with ``weight`` > 0. A small penalty of the gradient G
    makes the solution unique even with one neighbour.

    Parameters
    ----------
    i : int
    layout : LayoutArrays
    moved : (N, 2) float
        Current positions, px.
    weight : (N,) float
        Weight of each current position; 0 if it is unknown.

    Returns
    -------
    ux, uy : float
        Displacement, px.
    count : int
    """
    rest, neighbours, beside = layout.rest, layout.neighbours, layout.beside
    m00 = m01 = m02 = 0.0
    m11 = m22 = RIDGE
    m12 = 0.0
    bx0 = bx1 = bx2 = by0 = by1 = by2 = 0.0
    count = 0
    for k in range(neighbours.shape[1]):
        j = neighbours[i, k]
        if weight[j] <= 0:
            continue
        count += 1
        x, y, w = beside[i, k, 0], beside[i, k, 1], weight[j] * beside[i, k, 2]
        ux, uy = moved[j, 0] - rest[j, 0], moved[j, 1] - rest[j, 1]
        m00 += w
        m01 += w * x
        m02 += w * y
        m11 += w * x * x
        m12 += w * x * y
        m22 += w * y * y
        bx0 += w * ux
        bx1 += w * ux * x
        bx2 += w * ux * y
        by0 += w * uy
        by1 += w * uy * x
        by2 += w * uy * y
    if count == 0:
        return 0.0, 0.0, 0
    c00 = m11 * m22 - m12 * m12
    c01 = m02 * m12 - m01 * m22
    c02 = m01 * m12 - m02 * m11
    det = m00 * c00 + m01 * c01 + m02 * c02
    return (c00 * bx0 + c01 * bx1 + c02 * bx2) / det, (c00 * by0 + c01 * by1 + c02 * by2) / det, count


def predict_all(layout: LayoutArrays, moved: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Each pin's position (N, 2) as predicted from its neighbours; NaN if no neighbour has a weight."""
    out = np.empty_like(moved)
    _predict_each(layout, moved, weight, out)
    return out


@compiled(error_model="numpy")
def _predict_each(layout: LayoutArrays, moved: np.ndarray, weight: np.ndarray, out: np.ndarray) -> None:
    rest = layout.rest
    for i in range(len(rest)):
        ux, uy, count = predict(i, layout, moved, weight)
        out[i, 0] = rest[i, 0] + ux if count else np.nan
        out[i, 1] = rest[i, 1] + uy if count else np.nan


def _grow(layout: LayoutArrays, blobs: FrameBlobs, start: np.ndarray) -> np.ndarray:
    """Grow a labelling (N,) from ``start`` (N,), which has at least one pair. Each round labels pins next to labelled ones."""
    blob, count = start.copy(), len(blobs.px)
    moved, weight, taken = blobs.px[blob], (blob >= 0).astype(float), np.zeros(count, bool)
    taken[blob[blob >= 0]] = True
    _grow_onward(layout, blobs, blob, moved, weight, taken, np.empty((2, count), int), np.empty((2, count)), np.empty(len(blob), int))
    return blob


@compiled(error_model="numpy")
def _grow_onward(
    layout: LayoutArrays,
    blobs: FrameBlobs,
    blob: np.ndarray,
    moved: np.ndarray,
    weight: np.ndarray,
    taken: np.ndarray,
    numbers: np.ndarray,
    squares: np.ndarray,
    tried: np.ndarray,
) -> None:
    """Grow a labelling (N,), with the positions (N, 2) and weights (N,) of its pairs and the blobs (K,) ``taken`` by them.

    ``numbers`` and ``squares`` (2, K) are for work, and so is ``tried`` (N,): number of labelled neighbours when a pin was last tried.
    """
    rest, neighbours, spacing, near = layout.rest, layout.neighbours, layout.spacing, min(6, layout.neighbours.shape[1])
    claim, found, claim_cost, away2 = numbers[0], numbers[1], squares[0], squares[1]
    labelled = 0
    for i in range(len(blob)):
        labelled += blob[i] >= 0
    for level in range(len(GROW_GATES)):
        for i in range(len(blob)):
            tried[i] = -1
        growing = True
        while growing:
            growing = False
            for k in range(len(claim)):
                claim[k] = -1
            for i in range(len(blob)):
                touching = False
                for k in range(near):
                    touching = touching or blob[neighbours[i, k]] >= 0
                if blob[i] >= 0 or not touching:
                    continue
                ux, uy, count = predict(i, layout, moved, weight)
                if count == tried[i] or count < min(3 - level, labelled):
                    continue
                tried[i] = count
                x, y = rest[i, 0] + ux, rest[i, 1] + uy
                best, best_d2 = -1, np.inf
                for at in range(find_near(x, y, GROW_GATES[level] * spacing[i], blobs, found, away2)):
                    if away2[at] < best_d2 and not taken[found[at]]:
                        best, best_d2 = found[at], away2[at]
                cost = best_d2 / (spacing[i] * spacing[i])
                if best >= 0 and (claim[best] < 0 or cost < claim_cost[best]):
                    claim[best], claim_cost[best] = i, cost
            for k in range(len(claim)):
                i = claim[k]
                if i >= 0:
                    blob[i], weight[i], taken[k] = k, 1.0, True
                    moved[i, 0], moved[i, 1] = blobs.px[k, 0], blobs.px[k, 1]
                    labelled += 1
                    growing = True


@compiled(error_model="numpy")
def _turn_rings(
    rest: np.ndarray, slots: np.ndarray, ring_ends: np.ndarray, px: np.ndarray, blob: np.ndarray, least: int, turns: np.ndarray
) -> None:
    """Turn of each ring as a unit vector, 0 if unknown, after its labels are shifted back by ``least`` or more pins: (W, R, 2).

    Ring i's pins are ``slots[ring_ends[i]:ring_ends[i + 1]]``, in order around the layout, -1 where one is missing.
    """
    for w in range(len(turns)):
        for ring in range(len(ring_ends) - 1):
            first, size = ring_ends[ring], ring_ends[ring + 1] - ring_ends[ring]
            count, ax, ay, bx, by, along, across = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(size):
                pin, source = slots[first + k], slots[first + (k - least - w) % size]
                j = blob[source] if pin >= 0 and source >= 0 else -1
                if j >= 0:
                    count += 1
                    ax, ay, bx, by = ax + rest[pin, 0], ay + rest[pin, 1], bx + px[j, 0], by + px[j, 1]
                    along += rest[pin, 0] * px[j, 0] + rest[pin, 1] * px[j, 1]
                    across += rest[pin, 0] * px[j, 1] - rest[pin, 1] * px[j, 0]
            if count > 2:
                along, across = along - (ax * bx + ay * by) / count, across - (ax * by - ay * bx) / count
                length = np.sqrt(along * along + across * across)
                if length > 0:
                    turns[w, ring, 0], turns[w, ring, 1] = along / length, across / length


def _ring_turns(reference: Reference, px: np.ndarray, blob: np.ndarray, most: int) -> np.ndarray:
    """Turns (2 most + 1, R) of the rings as unit complex numbers, 0 if unknown, after their labels are shifted by up to ``most`` pins."""
    turns = np.zeros((2 * most + 1, len(reference.ring_ends) - 1, 2))
    _turn_rings(reference.pins_px, reference.slots, reference.ring_ends, px, blob, -most, turns)
    return turns.view(complex)[..., 0]


def _unwound(reference: Reference, px: np.ndarray, blob: np.ndarray) -> np.ndarray:
    """A labelling (N,) whose rings are shifted back by the number of pins with which they turn most alike.

    If anything is shifted, the innermost rings lose their labels. One ring alone is like itself after any shift, so its labels stay.
    """
    alike = np.abs(_ring_turns(reference, px, blob, MAX_WINDING)[:, BROKEN_RINGS:].sum(axis=1))
    if alike[MAX_WINDING] > alike.max() - ROUNDING:
        return blob
    out = np.full(len(blob), -1)
    for ring in np.split(reference.slots, reference.ring_ends[1:-1])[BROKEN_RINGS:]:
        source = np.roll(ring, alike.argmax() - MAX_WINDING)
        both = (ring >= 0) & (source >= 0)
        out[ring[both]] = blob[source[both]]
    return out


def _trust(layout: LayoutArrays, px: np.ndarray, blob: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 2) of the pairs, and their weights (N,), which decrease with the distance from the place predicted by neighbours."""
    moved, weight = px[blob], (blob >= 0).astype(float)
    away2 = ((predict_all(layout, moved, weight) - moved) ** 2).sum(axis=1)
    return moved, np.fmax(weight / (1 + away2 / (SOFT_RESIDUAL * layout.spacing) ** 2), 0.0)  # 0 without a prediction


def _candidates(layout: LayoutArrays, blobs: FrameBlobs, predicted: np.ndarray, blob: np.ndarray) -> tuple[np.ndarray, ...]:
    """Possible pairs within the gate: pins, blobs and costs (p,)."""
    pins, near, away2 = _pairs(predicted, FINAL_GATE * layout.spacing, blobs)
    known, each = (blob >= 0).astype(float), np.ones(layout.neighbours.shape[1])
    around = (known * blobs.area[blob]).take(layout.neighbours) @ each / np.maximum(known.take(layout.neighbours) @ each, 1)
    area, expected = blobs.area[near], around[pins]
    whole = area >= MIN_AREA_RATIO * expected
    if not whole.all():
        pins, near, away2, area, expected = (one[whole] for one in (pins, near, away2, area, expected))
    return pins, near, away2 / layout.spacing[pins] ** 2 + AREA_LOG_WEIGHT * np.log(area / expected) ** 2


def _pairs(places: np.ndarray, reach: np.ndarray, blobs: FrameBlobs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (N, 2) and blobs nearer to them than their ``reach`` (N,): numbers of both, and squared distances (p,)."""
    room = 2 * len(places)
    while True:
        pins, near, away2 = np.empty(room, int), np.empty(room, int), np.empty(room)
        count = _pair_near(places, reach, blobs, pins, near, away2)
        if count <= room:
            return pins[:count], near[:count], away2[:count]
        room = count


@compiled(error_model="numpy")
def _pair_near(places: np.ndarray, reach: np.ndarray, blobs: FrameBlobs, pins: np.ndarray, near: np.ndarray, away2: np.ndarray) -> int:
    """As `_pairs`, into arrays; returns the number of pairs. Those that are too many for the arrays are only counted."""
    count = 0
    for i in range(len(places)):
        before = count
        count += find_near(places[i, 0], places[i, 1], reach[i], blobs, near[before:], away2[before:])
        for at in range(before, min(count, len(pins))):
            pins[at] = i
    return count


def _assign(n: int, blob_count: int, pins: np.ndarray, blobs: np.ndarray, costs: np.ndarray) -> np.ndarray:
    """One-to-one assignment (N,) of possible pairs (p,): as many pairs as possible, with the least cost."""
    blob = np.full(n, -1)
    open_pair = (np.bincount(pins, minlength=n)[pins] > 1) | (np.bincount(blobs, minlength=blob_count)[blobs] > 1)
    blob[pins[~open_pair]] = blobs[~open_pair]
    if not open_pair.any():
        return blob
    from scipy.optimize import linear_sum_assignment  # takes a tenth of a second, and few frames need it

    row_pin, row = np.unique(pins[open_pair], return_inverse=True)
    column_blob, column = np.unique(blobs[open_pair], return_inverse=True)
    table = np.full((len(row_pin), len(column_blob)), NO_PAIR_COST)
    table[row, column] = costs[open_pair]
    for r, c in zip(*linear_sum_assignment(table), strict=True):
        if table[r, c] < NO_PAIR_COST:
            blob[row_pin[r]] = column_blob[c]
    return blob


def _refine(reference: Reference, blobs: FrameBlobs, blob: np.ndarray) -> Match:
    """Re-assign every pin to the blobs near where its neighbours predict it, until nothing changes."""
    layout, px = _layout(reference), blobs.px
    for _ in range(REFINE_ROUNDS):
        predicted = predict_all(layout, *_trust(layout, px, blob))
        before = blob
        blob = _assign(len(blob), len(px), *_candidates(layout, blobs, predicted, blob))
        if np.array_equal(blob, before):
            break
    blob = _adopt(layout, px, blobs.area, blob, predicted)
    found = blob >= 0
    residual2 = ((px[blob[found]] - predicted[found]) ** 2).sum(axis=1) / (FINAL_GATE * layout.spacing[found]) ** 2
    turns = _ring_turns(reference, px, blob, 0)[0]
    turned = 1.0 - turns.real.sum() / max(np.count_nonzero(turns), 1)
    return Match(blob, predicted, float(found.sum() - residual2.sum() - TURN_WEIGHT * len(blob) * turned))


def _adopt(layout: LayoutArrays, px: np.ndarray, area: np.ndarray, blob: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Give lost pins free blobs of a cap's size slightly outside the gate. Predictions at the rim are extrapolated and less precise."""
    neighbours, spacing = layout.neighbours, layout.spacing
    lost = np.flatnonzero((blob < 0) & np.isfinite(predicted[:, 0]))
    if not 0 < len(lost) <= MOST_ADOPTED * len(blob):
        return blob
    free = np.setdiff1d(np.arange(len(px)), blob)
    if not len(free):
        return blob
    distance = np.linalg.norm(px[free] - predicted[lost][:, None], axis=2) / spacing[lost][:, None]
    around = np.where(blob[neighbours[lost]] >= 0, area[blob[neighbours[lost]]], np.nan)
    known = np.isfinite(around).any(axis=1)
    expected = np.full(len(lost), np.nan)
    expected[known] = np.nanmedian(around[known], axis=1)
    ratio = area[free] / expected[:, None]
    distance[~((ratio > 1 / ADOPT_AREA_RATIO) & (ratio < ADOPT_AREA_RATIO))] = np.inf
    blob = blob.copy()
    for row, column in zip(*np.nonzero(distance < ADOPT_GATE), strict=True):
        if distance[row, column] == distance[row].min() == distance[:, column].min():
            blob[lost[row]] = free[column]
    return blob


def _middle(px: np.ndarray) -> np.ndarray:
    """Middle (2,) of the extent of points (K, 2), without the outermost few."""
    ordered = np.sort(px, axis=0)
    margin = int(EXTENT_MARGIN * len(px))
    return (ordered[margin] + ordered[-1 - margin]) / 2


def _seeds(reference: Reference, px: np.ndarray) -> Iterator[tuple[int, int]]:
    """Pairs to start from: some pins of the reference, with their 1st, 2nd, 3rd nearest blobs."""
    offsets = [_middle(px) - _middle(reference.pins_px)]
    seen: set[tuple[int, int]] = set()
    for rank in range(SEED_RANKS):
        for place in range(3):
            if place == len(offsets):
                offsets += [np.zeros(2), median_px(px) - median_px(reference.pins_px)]
            for pin in reference.starts:
                distance2 = ((px - (reference.pins_px[pin] + offsets[place])) ** 2).sum(axis=1)
                pair = pin, int(np.argpartition(distance2, rank)[rank])
                if pair not in seen:
                    seen.add(pair)
                    yield pair


def _layout(reference: Reference) -> LayoutArrays:
    return LayoutArrays(reference.pins_px, reference.neighbours, reference.beside, reference.spacing_px)


def _put_in_cells(reference: Reference, px: np.ndarray, area_px2: np.ndarray) -> FrameBlobs:
    px, cell = np.ascontiguousarray(px), reference.pitch_px
    left, top = float(px[:, 0].min()), float(px[:, 1].min())
    columns, rows = ((px[:, 0] - left) / cell).astype(int), ((px[:, 1] - top) / cell).astype(int)
    width = int(columns.max()) + 1
    cells = rows * width + columns
    first = np.bincount(cells + 1, minlength=(int(rows.max()) + 1) * width + 1).cumsum()
    return FrameBlobs(px, area_px2, cells.argsort(), first, left, top, cell, width)


@compiled(error_model="numpy")
def find_near(x: float, y: float, reach: float, blobs: FrameBlobs, found: np.ndarray, away2: np.ndarray) -> int:
    """Put blobs nearer than ``reach`` to (x, y), and their squared distances, into arrays; returns their number.

    Those that are too many for the arrays are only counted. None is near to NaN.
    """
    columns, cell, count = blobs.columns, blobs.cell, 0
    if not np.isfinite(x + y):
        return count
    low, high = max(int((x - reach - blobs.left) / cell), 0), min(int((x + reach - blobs.left) / cell), columns - 1)
    last = min(int((y + reach - blobs.top) / cell), (len(blobs.first) - 1) // columns - 1)
    for row in range(max(int((y - reach - blobs.top) / cell), 0), last + 1 if low <= high else 0):
        for at in range(blobs.first[row * columns + low], blobs.first[row * columns + high + 1]):
            k = blobs.order[at]
            d2 = (blobs.px[k, 0] - x) ** 2 + (blobs.px[k, 1] - y) ** 2
            if d2 < reach * reach:
                if count < len(found):
                    found[count], away2[count] = k, d2
                count += 1
    return count
