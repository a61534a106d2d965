"""Families of pin layouts, and the labelling of a frame's spots by them. A family is a large lattice that contains a sensor's layout."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from scenes.layouts.base import LatticeLayout
from scenes.pins import PinsSpec
from twin.geometry.pins import pin_lattice, usual_spacing
from twin.pins.finding.bumps import Bumps
from twin.pins.labelling.growth import NEIGHBOURS, grow

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
    for start, cell in _starts(px, by, by.kind) if by.kind else _lay_lattice(px, by):
        labels = grow(by.lattice, by.around, px, start, cell)
        count = int((labels >= 0).sum())
        if count > most:
            best, most = labels, count
        if most >= NEARLY_ALL * len(px):
            break
    return best


def _starts(px: np.ndarray, by: Family, kind: type[LatticeLayout]) -> Iterator[tuple[np.ndarray, float]]:
    """First labels (M,) and the spots' distance, px: a spot and its nearest spots, beginning with the one nearest to the x direction."""
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
        yield start, float(np.median(reach))


def _lay_lattice(px: np.ndarray, by: Family) -> Iterator[tuple[np.ndarray, float]]:
    """First labels (M,) and the spacing, px: the lattice, laid over the spots by middle, size and turn, labels spots nearby."""
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
