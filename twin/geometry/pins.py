"""Positions of a sensor's pins at rest, in the specification's pin order."""

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from scenes.pins import PinsSpec
from scenes.sensor import GeometrySpec
from twin.geometry.shapes import shape_of
from twin.types import FloatArray, IntArray

LEAST_BORDER = 3
"""Smallest number of pins on a border. If fewer pins of a layout's regular border are present, the border is computed from the places of
all pins."""
LONGEST_LINK = 1.8
"""Largest length of a side of a computed border, relative to the usual distance of neighbouring pins. The diagonal of a square grid is
1.41."""

SAME_PLACE = 0.05
"""Largest distance of two places that count as one when a layout is turned onto itself, relative to the usual spacing."""


@dataclass(frozen=True)
class PinRest:
    """Pins at rest, in the sensor frame.

    Attributes
    ----------
    base_mm : (N, 3) float
        Foot of each pin, on the inside of the skin.
    axis : (N, 3) float
        Unit vector from the foot to the cap (inwards, towards the camera).
    caps_mm : (N, 3) float
        Centre of the cap's solid (mid-height), ``base + (length + cap_height / 2) axis``.
    """

    base_mm: FloatArray
    axis: FloatArray
    caps_mm: FloatArray


@dataclass(frozen=True)
class Lattice:
    """A flat layout of pins, with its border and its rings.

    Attributes
    ----------
    places : (N, 2) float
        Positions of the pins. The outermost pin is at distance 1 from the centre.
    outmost : (m,) int
        Pins on the layout's border, in order around it.
    slots : (S,) int
        Pin at each place of the complete layout, -1 where it is missing: ring after ring, and in order around the centre within each ring.
        A layout without rings is one ring.
    ring_ends : (R + 1,) int
        Ring i has the slots from ``ring_ends[i - 1]`` to ``ring_ends[i]``, the last one excluded. A pin at the centre belongs to no ring.
    """

    places: FloatArray
    outmost: IntArray
    slots: IntArray
    ring_ends: IntArray


@lru_cache(maxsize=32)
def pin_lattice(pins: PinsSpec) -> Lattice:
    """The layout of a specification's pins, without its rotation. Missing pins are omitted."""
    shape = pins.shape
    places, border = shape.places(), shape.border()
    there = np.setdiff1d(np.arange(len(places)), pins.missing)
    number = np.full(len(places), -1)
    number[there] = np.arange(len(there))
    places = places[there] / np.linalg.norm(places[there], axis=1).max()
    outmost = border_of(places) if border is None else number[border][number[border] >= 0]
    if len(outmost) < LEAST_BORDER:
        outmost = border_of(places)
    return Lattice(places, outmost, number, shape.ring_ends())


@lru_cache(maxsize=32)
def namings(pins: PinsSpec) -> tuple[IntArray, ...]:
    """Orders (N,) of the pins for all turns that map the layout onto itself, then for all turns of its mirror image; the identity is first.

    A pin whose place is taken by a missing pin is -1.
    """
    places = pin_lattice(pins).places
    z, near = places @ [1, 1j], SAME_PLACE * usual_spacing(places)
    outer = z[np.abs(np.abs(z) - np.abs(z).max()) < near]
    found: list[IntArray] = []
    for whole in (z, z.conj()):
        start = outer if whole is z else outer.conj()
        turns = np.angle(outer[:, None] / start).round(4).ravel()
        for turn in sorted(set(turns.tolist()), key=lambda turn: (abs(turn), -turn)):
            turned = whole * np.exp(1j * turn)
            distance, order = cKDTree(np.column_stack([turned.real, turned.imag])).query(places)
            order = np.where(distance < near, order, -1)
            if (order < 0).sum() <= len(pins.missing) and not any(np.array_equal(order, other) for other in found):
                found.append(order)
    return tuple(found)


def usual_spacing(places: FloatArray) -> float:
    """Median distance of places (N, 2) or (N, 3) from their nearest neighbours. Places that are NaN are ignored."""
    known = places[np.isfinite(places).all(axis=1)]
    return float(np.median(cKDTree(known).query(known, k=2)[0][:, 1]))


def border_of(places: FloatArray) -> IntArray:
    """Indices (m,) of the outermost places among places (N, 2), in order around them: the border of their Delaunay triangulation.

    Triangles at the border are removed if their outer side is longer than ``LONGEST_LINK`` times the usual distance of neighbours, and if
    the border remains one loop.
    """
    triangles = Delaunay(places).simplices
    longest = LONGEST_LINK * usual_spacing(places)
    kept = {tuple(sorted(t)) for t in triangles.tolist()}
    while True:
        uses: Counter[tuple[int, ...]] = Counter(side for t in kept for side in combinations(t, 2))
        on_border = {corner for side, n in uses.items() if n == 1 for corner in side}
        loose = []
        for triangle in kept:
            side = tuple(corner for corner in triangle if corner in on_border)
            if len(side) == 2 and uses[side] == 1:
                loose.append((float(np.linalg.norm(places[side[0]] - places[side[1]])), triangle))
        length, triangle = max(loose, default=(0.0, ()))
        if length <= longest:
            break
        kept.remove(triangle)
    following: dict[int, list[int]] = {}
    for (one, other), n in uses.items():
        if n == 1:
            following.setdefault(one, []).append(other)
            following.setdefault(other, []).append(one)
    loop = [min(following)]
    while len(loop) < len(following):
        loop.append(next(there for there in following[loop[-1]] if there not in loop[-2:]))
    return np.array(loop)


def across_axis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (N, 3) perpendicular to axes (N, 3): along the projection of the sensor's x, and a quarter turn towards y."""
    u = np.array([1.0, 0.0, 0.0]) - axis[:, :1] * axis
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(u, axis)


def around_axis(axis: FloatArray, turn: FloatArray) -> FloatArray:
    """Unit vectors (N, k, 3) perpendicular to axes (N, 3) at azimuths (k,), which start at the sensor's x (as ``across_axis``)."""
    u, v = across_axis(axis)
    return np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * v[:, None]


def rest_pins(geometry: GeometrySpec) -> PinRest:
    """Pins of a sensor at rest: the layout, mapped to the inside of its skin by the skin's shape and ``PinsSpec.spacing``."""
    pins = geometry.pins
    base, outward = shape_of(geometry.skin).pins(pin_lattice(pins).places, pins)
    return PinRest(base, -outward, base - (pins.length_mm + pins.cap_height_mm / 2) * outward)
