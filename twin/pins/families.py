"""Families of layouts, each as one large lattice of which a sensor's layout is a part, and how a frame's spots are labelled by it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from scenes.pins import PinsSpec
from twin.geometry.pins import pin_lattice, usual_spacing
from twin.pins.bumps import Bumps
from twin.pins.growth import NEIGHBOURS, grow

MOST_RINGS = 16
"""Rings that are looked for; printed TacTips have 3 to 11."""
HALF_GRID = 20
"""Columns and rows that are looked for on each side of the place from which a grid is grown."""
SEEDS = {"rings": 40, "hexagon": 12, "grid": 12}
"""Spots from which labellings start, those nearest to the middle first. Rings have one middle, which contact displaces; a hexagon and a
grid may start anywhere."""
NEARLY_ALL = 0.95
"""No further start is tried after a labelling that holds this share of the spots."""
RING_GAPS_DEG, GRID_GAPS_DEG = (25.0, 100.0), (60.0, 120.0)
"""Smallest and largest angle between neighbouring directions to the nearest six, and four, spots around a start."""
MOST_UNEVEN = 2.0
"""Largest ratio of the distances of these spots."""
LEAST_GROWN = 12
"""A labelling of fewer spots than this is none."""
TURNS_DEG = np.arange(0.0, 360.0, 5.0)
"""Turns in which a layout of given positions is laid over the spots."""
LAID_SCALES = (1.0, 0.93, 1.07, 0.86, 1.15)
"""Sizes in which it is laid over them, relative to that of the spots."""
LAID_GATE = 0.3
"""Largest distance of a spot from a place laid over it, in spacings, for a first label."""


@dataclass(frozen=True)
class Family:
    """A lattice to label spots by.

    Attributes
    ----------
    name : {"rings", "hexagon", "grid", "positions"}
    lattice : (M, 2) float
        Neighbouring places are about 1 apart.
    around : (M, k) int
        Places around each place, the nearest first.
    ring : (M,) int
        Ring of each place; 0 for all where there are no rings.
    """

    name: str
    lattice: np.ndarray
    around: np.ndarray
    ring: np.ndarray


def _family(name: str, lattice: np.ndarray, ring: np.ndarray) -> Family:
    around = cKDTree(lattice).query(lattice, k=min(NEIGHBOURS + 1, len(lattice)))[1][:, 1:]
    return Family(name, np.ascontiguousarray(lattice), np.ascontiguousarray(around), ring)


@lru_cache(maxsize=8)
def family(name: str) -> Family:
    """The lattice of ``rings``, ``hexagon`` (a triangular lattice) or ``grid``, far larger than any sensor's."""
    if name == "grid":
        y, x = np.mgrid[-HALF_GRID : HALF_GRID + 1, -HALF_GRID : HALF_GRID + 1]
        return _family(name, np.column_stack([x.ravel(), y.ravel()]).astype(float), np.zeros(x.size, int))
    pins = PinsSpec(layout="rings" if name == "rings" else "hexagon", rings=MOST_RINGS)
    ring = np.concatenate([[0], np.repeat(np.arange(1, MOST_RINGS + 1), 6 * np.arange(1, MOST_RINGS + 1))])
    return _family(name, MOST_RINGS * pin_lattice(pins).places, ring)


@lru_cache(maxsize=8)
def family_of_positions(pins: PinsSpec) -> Family:
    """A layout itself as a lattice, whatever its kind."""
    places = pin_lattice(pins).places
    spacing = usual_spacing(places)
    return _family("positions", places / spacing, np.zeros(len(places), int))


def label_spots(found: Bumps, by: Family) -> np.ndarray | None:
    """The labelling (M,) of a frame's spots that holds most of them: the spot of each place, -1 for none; None if there is none."""
    if len(found.px) < LEAST_GROWN:
        return None
    best, most = None, LEAST_GROWN - 1
    for start, cell in _laid(found, by) if by.name == "positions" else _starts(found, by):
        labels = grow(by.lattice, by.around, found.px, start, cell)
        count = int((labels >= 0).sum())
        if count > most:
            best, most = labels, count
        if most >= NEARLY_ALL * len(found.px):
            break
    return best


def _starts(found: Bumps, by: Family) -> Iterator[tuple[np.ndarray, float]]:
    """First labels (M,): a spot and those around it, the first of them in the direction nearest to x; and their distance, px."""
    px, corners = found.px, 4 if by.name == "grid" else 6
    least, most = GRID_GAPS_DEG if by.name == "grid" else RING_GAPS_DEG
    middle = len(by.lattice) // 2 if by.name == "grid" else 0
    side = 2 * HALF_GRID + 1
    places = middle + np.array([1, side, -1, -side]) if by.name == "grid" else np.arange(1, 7)
    distance, near = cKDTree(px).query(px, k=corners + 1)
    away = np.linalg.norm(px - np.median(px, axis=0), axis=1)
    for spot in np.argsort(away)[: SEEDS[by.name]]:
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
        yield start, float(np.median(reach))


def _laid(found: Bumps, by: Family) -> Iterator[tuple[np.ndarray, float]]:
    """First labels (M,) where the lattice, laid over the spots by middle, size and turn, meets them."""
    px = found.px
    tree = cKDTree(px)
    low, high = np.percentile(px, [2, 98], axis=0)
    inside = px[((px >= low) & (px <= high)).all(axis=1)]
    middle, size = inside.mean(axis=0), np.sqrt(np.mean(np.sum((inside - inside.mean(axis=0)) ** 2, axis=1)))
    lattice = by.lattice - by.lattice.mean(axis=0)
    lattice = lattice / np.sqrt(np.mean(np.sum(lattice**2, axis=1)))
    spacing = usual_spacing(lattice)
    laid: list[tuple[int, np.ndarray, float]] = []
    for scale in LAID_SCALES:
        for turn in np.exp(1j * np.radians(TURNS_DEG)):
            at = middle + scale * size * (lattice @ np.array([[turn.real, turn.imag], [-turn.imag, turn.real]]))
            reach = spacing * scale * size
            distance, spot = tree.query(at)
            start = np.where(distance < LAID_GATE * reach, spot, -1)
            _, first = np.unique(start, return_index=True)
            once = np.zeros(len(start), bool)
            once[first] = True
            start = np.where(once, start, -1)
            laid.append((int((start >= 0).sum()), start, reach))
    laid.sort(key=lambda entry: -entry[0])
    for count, start, reach in laid[:5]:
        if count >= LEAST_GROWN:
            yield start, reach
