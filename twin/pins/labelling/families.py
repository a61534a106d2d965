"""Families of pin layouts, and the labelling of a frame's spots by them. A family is a large lattice that contains a sensor's layout.

A labelling grows from a few labels outwards, for any scale, turn and distortion of the view. A local affine map, fitted to the labelled
places around the next place, predicts the position of this place in the frame. Therefore the lattice may be foreshortened or slowly curved;
only its topology must be known. All distances are relative to the local spacing. All limits were chosen, not derived.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from scenes.layouts.base import LatticeLayout
from scenes.pins import PinsSpec
from twin.compiled import compiled
from twin.geometry.pins import pin_lattice, usual_spacing
from twin.pins.finding.bumps import Bumps

NEARLY_ALL = 0.95
"""Share of the spots that a labelling must hold to end the search for a better start."""
MOST_UNEVEN = 2.0
"""Largest ratio of the distances of the nearest spots around a start from it."""
LEAST_GROWN = 12
"""Least number of spots in a labelling."""
TURNS_DEG = np.arange(0.0, 360.0, 5.0)
"""Angles, deg, by which a layout of given positions is turned when it is laid over the spots."""
LAID_SCALES = (1.0, 0.93, 1.07, 0.86, 1.15)
"""Sizes of a layout of given positions when it is laid over the spots, relative to the size of the pattern of spots."""
LAID_GATE = 0.3
"""Largest distance of a spot from a place of the layout laid over it, in spacings, at which the spot gets a first label."""
KEPT = 512
"""Number of labellings that are kept."""
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


@dataclass(frozen=True, eq=False)
class Family:
    """A lattice by which spots are labelled.

    Attributes
    ----------
    kind : type of LatticeLayout, optional
        Kind of the layouts that are parts of the lattice; None if the lattice is one layout.
    lattice : (M, 2) float
        Positions of the places. Neighbouring places are about 1 apart.
    around : (M, k) int
        Neighbours of each place, the nearest first.
    """

    kind: type[LatticeLayout] | None
    lattice: np.ndarray
    around: np.ndarray


def _family(kind: type[LatticeLayout] | None, lattice: np.ndarray) -> Family:
    around = cKDTree(lattice).query(lattice, k=min(NEIGHBOURS + 1, len(lattice)))[1][:, 1:]
    return Family(kind, np.ascontiguousarray(lattice), np.ascontiguousarray(around))


@lru_cache(maxsize=8)
def family(kind: type[LatticeLayout]) -> Family:
    """The lattice of a kind of layouts, far larger than any sensor's."""
    return _family(kind, kind.largest().places())


def families() -> list[Family]:
    """The lattices for which frames are searched, in the order of the search."""
    kinds = [kind for kind in PinsSpec.parts().values() if issubclass(kind, LatticeLayout)]
    return [family(kind) for kind in sorted(kinds, key=lambda kind: kind.order)]


@lru_cache(maxsize=8)
def family_of_positions(pins: PinsSpec) -> Family:
    """A layout of any kind as a lattice of its own."""
    places = pin_lattice(pins).places
    return _family(None, places / usual_spacing(places))


def label_spots(found: Bumps, by: Family) -> np.ndarray | None:
    """The labelling (M,) that holds most spots of a frame: the spot of each place, -1 for no spot. None if no labelling is found."""
    return None if len(found.px) < LEAST_GROWN else _label_places(found.px.tobytes(), by)


@lru_cache(maxsize=KEPT)
def _label_places(spots: bytes, by: Family) -> np.ndarray | None:
    """The labelling (M,) of spots (K, 2), float64. It is kept, because the same frames are compared with several layouts."""
    px = np.frombuffer(spots).reshape(-1, 2).copy()
    best, most = None, LEAST_GROWN - 1
    for start in _starts(px, by, by.kind) if by.kind else _lay_lattice(px, by):
        labels = grow(by.lattice, by.around, px, start)
        count = int((labels >= 0).sum())
        if count > most:
            best, most = labels, count
        if most >= NEARLY_ALL * len(px):
            break
    return best


def _starts(px: np.ndarray, by: Family, kind: type[LatticeLayout]) -> Iterator[np.ndarray]:
    """First labels (M,): a spot and its nearest spots, beginning with the one nearest to the x direction."""
    (least, most), (middle, places) = kind.gaps_deg, kind.start()
    distance, near = cKDTree(px).query(px, k=kind.corners + 1)
    away = np.linalg.norm(px - np.median(px, axis=0), axis=1)
    for spot in np.argsort(away)[: kind.seeds]:
        ring, reach = near[spot, 1:], distance[spot, 1:]
        if reach[-1] > MOST_UNEVEN * reach[0]:
            continue
        angle = np.degrees(np.arctan2(*(px[ring] - px[spot]).T[::-1])) % 360
        order = np.argsort(angle)
        gaps = np.diff(angle[order], append=angle[order[0]] + 360)
        if gaps.min() < least or gaps.max() > most:
            continue
        first = int(np.argmin(np.abs((angle[order] + 180) % 360 - 180)))
        start = np.full(len(by.lattice), -1)
        start[middle] = spot
        start[places] = np.roll(ring[order], -first)
        yield start


def _lay_lattice(px: np.ndarray, by: Family) -> Iterator[np.ndarray]:
    """First labels (M,): the lattice, laid over the spots by middle, size and turn, labels spots nearby."""
    tree = cKDTree(px)
    low, high = np.percentile(px, [2, 98], axis=0)
    inside = px[((px >= low) & (px <= high)).all(axis=1)]
    middle, size = inside.mean(axis=0), np.sqrt(np.mean(np.sum((inside - inside.mean(axis=0)) ** 2, axis=1)))
    lattice = by.lattice - by.lattice.mean(axis=0)
    lattice = lattice / np.sqrt(np.mean(np.sum(lattice**2, axis=1)))
    spacing = usual_spacing(lattice)
    laid: list[np.ndarray] = []
    for scale in LAID_SCALES:
        for turn in np.exp(1j * np.radians(TURNS_DEG)):
            at = middle + scale * size * (lattice @ np.array([[turn.real, turn.imag], [-turn.imag, turn.real]]))
            distance, spot = tree.query(at)
            start = np.where(distance < LAID_GATE * spacing * scale * size, spot, -1)
            again = np.ones(len(start), bool)
            again[np.unique(start, return_index=True)[1]] = False
            laid.append(np.where(again, -1, start))
    laid.sort(key=lambda start: -int((start >= 0).sum()))
    yield from (start for start in laid[:5] if (start >= 0).sum() >= LEAST_GROWN)


@compiled()
def _predict(place: int, lattice: np.ndarray, around: np.ndarray, spot: np.ndarray, px: np.ndarray) -> tuple[complex, float]:
    """Position x + iy of a place as its labelled neighbours predict it, and local spacing, px.

    The prediction is a weighted affine map. It is NaN if the map is not determined, mirrors the lattice, or stretches it too much.
    """
    count, total, x, y, xx, xy, yy, at, at_x, at_y = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0j, 0j, 0j
    nothing = complex(np.nan, np.nan), np.nan
    for near in around[place]:
        if spot[near] >= 0:
            dx, dy = lattice[near, 0] - lattice[place, 0], lattice[near, 1] - lattice[place, 1]
            z = complex(px[spot[near], 0], px[spot[near], 1])
            weight = 1.0 / (0.5 + dx * dx + dy * dy)
            count, total, x, y, at = count + 1, total + weight, x + weight * dx, y + weight * dy, at + weight * z
            xx, xy, yy = xx + weight * dx * dx, xy + weight * dx * dy, yy + weight * dy * dy
            at_x, at_y = at_x + weight * dx * z, at_y + weight * dy * z
    if count < 3:
        return nothing
    x, y, at = x / total, y / total, at / total
    xx, xy, yy, at_x, at_y = xx - total * x * x, xy - total * x * y, yy - total * y * y, at_x - total * x * at, at_y - total * y * at
    determinant = xx * yy - xy * xy
    if determinant < 1e-6 * total * total:
        return nothing
    east, north = (at_x * yy - at_y * xy) / determinant, (at_y * xx - at_x * xy) / determinant
    half, area = (abs(east) ** 2 + abs(north) ** 2) / 2, (east.conjugate() * north).imag
    root = np.sqrt(max(half * half - area * area, 0.0))  # squares of the map's scales are half -+ root
    if area <= 0 or half + root > MOST_STRETCH**2 * (half - root):
        return nothing
    return at - x * east - y * north, np.sqrt(max(half - root, 0.0))


@compiled()
def _predictions(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """Predicted positions and local spacings (M, 3) of all places, px."""
    out = np.empty((len(lattice), 3))
    for place in range(len(lattice)):
        at, out[place, 2] = _predict(place, lattice, around, spot, px)
        out[place, 0], out[place, 1] = at.real, at.imag
    return out


def grow(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, start: np.ndarray) -> np.ndarray:
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
    """
    spot = start.copy()
    for _ in range(ROUNDS - 1):
        _extend(lattice, around, px, spot)
        held = np.flatnonzero(spot >= 0)
        predicted = _predictions(lattice, around, px, spot)[held]
        right = np.linalg.norm(px[spot[held]] - predicted[:, :2], axis=1) <= FINAL_GATE * predicted[:, 2]
        if right.all():
            return spot
        spot[held[~right]] = -1
    _extend(lattice, around, px, spot)
    return spot


@compiled()
def _extend(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, spot: np.ndarray) -> None:
    """Add labels to a labelling ``spot`` (M,), from the labelled places outwards. Of the places that claim a spot the nearest gets it."""
    taken, claim, miss, tried = np.zeros(len(px) + 1), np.empty(len(px), np.int64), np.empty(len(px)), np.empty(len(lattice), np.int64)
    for held in spot:
        taken[held] = 1.0  # the last entry is of places without a spot
    for limit, gate in enumerate(GATES):
        tried[:], more = 0, True
        while more:
            miss[:], more = gate, False
            for place in range(len(lattice)):
                near = count = 0
                for k, other in enumerate(around[place]):
                    near, count = near + (k < NEAR and spot[other] >= 0), count + (spot[other] >= 0)
                if spot[place] >= 0 or near < 2 or count < LEAST_AROUND[limit] or count == tried[place]:
                    continue
                tried[place] = count
                at, spacing = _predict(place, lattice, around, spot, px)
                nearest, square = -1, np.inf
                for k in range(len(px)):
                    away = (px[k, 0] - at.real) ** 2 + (px[k, 1] - at.imag) ** 2
                    if away < square and not taken[k]:
                        nearest, square = k, away
                if nearest >= 0 and np.sqrt(square) < miss[nearest] * spacing:
                    miss[nearest], claim[nearest], more = np.sqrt(square) / spacing, place, True
            for k in range(len(px)):
                if miss[k] < gate:
                    spot[claim[k]], taken[k] = k, 1.0


def locate_places(lattice: np.ndarray, around: np.ndarray, px: np.ndarray, spot: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Positions (M, 2), px, of a lattice's places: of the spots, or predicted from labelled neighbours; NaN without a prediction.

    A predicted position may lie outside the frame. It then shows that the frame cuts a pin off.
    """
    out = _predictions(lattice, around, np.ascontiguousarray(px), spot)[:, :2]
    out[~((out > -np.array(size_px)) & (out < 2 * np.array(size_px))).all(axis=1)] = np.nan
    return np.where((spot >= 0)[:, None], px[spot], out)
