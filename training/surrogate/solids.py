"""Distance and outward normal of the solids of a contact at the nodes: those of ``twin.objects``, and closed ones of robot scenes.

A closed solid has its origin at its centre. A swept box (Minkowski sum of a box and a ball) is a box with rounded edges, a capsule or a
ball. The distance of an ellipsoid follows from its nearest point x, with x_i = a_i^2 p_i / (t + a_i^2) and sum (x_i / a_i)^2 = 1; Newton's
method finds t (Eberly, Distance from a Point to an Ellipse, 2013).
"""

from dataclasses import dataclass

import numpy as np

from twin.compiled import compiled
from twin.objects.analytic import CompiledSolid, solid
from twin.types import FloatArray

SWEPT, DRUM, OVAL = 10, 11, 12
"""Codes of the kinds, beside those of ``twin.objects.analytic``."""
ROUNDS, ENOUGH = 40, 1e-12
"""Most steps of Newton's method, and the relative change at which it ends."""


@dataclass(frozen=True)
class SweptBox(CompiledSolid):
    """A box of half sizes x, y, z, mm, and all points within ``radius_mm`` of it."""

    x: float
    y: float
    z: float
    radius_mm: float

    kind = SWEPT


@dataclass(frozen=True)
class Drum(CompiledSolid):
    """A cylinder along z of ``core_mm`` radius and ``half_mm`` half length, and all points within ``radius_mm`` of it."""

    core_mm: float
    half_mm: float
    radius_mm: float

    kind = DRUM


@dataclass(frozen=True)
class Ellipsoid(CompiledSolid):
    """An ellipsoid of semi-axes x, y, z, mm."""

    x: float
    y: float
    z: float

    kind = OVAL


@compiled(error_model="numpy")
def distance_to(point: FloatArray, kind: int, sizes: FloatArray, normal: FloatArray) -> float:
    """Distance of a point (3,) from a closed solid, mm; writes the outward normal (3,)."""
    if kind == OVAL:
        return _to_ellipsoid(point, sizes, normal)
    out, deepest, nearest = 0.0, -np.inf, 0
    if kind == SWEPT:
        for axis in range(3):
            off = abs(point[axis]) - sizes[axis]
            normal[axis] = np.copysign(max(off, 0.0), point[axis])
            out += max(off, 0.0) ** 2
            if off > deepest:
                deepest, nearest = off, axis
        if out == 0.0:
            normal[:] = 0.0
            normal[nearest] = np.copysign(1.0, point[nearest])
            return deepest - sizes[3]
        out = np.sqrt(out)
        normal /= out
        return out - sizes[3]
    around = np.sqrt(point[0] ** 2 + point[1] ** 2)
    side, end = around - sizes[0], abs(point[2]) - sizes[1]
    out = np.sqrt(max(side, 0.0) ** 2 + max(end, 0.0) ** 2)
    across, along = (max(side, 0.0) / out, max(end, 0.0) / out) if out > 0 else (1.0, 0.0) if side > end else (0.0, 1.0)
    for axis in range(2):
        normal[axis] = across * (point[axis] / around if around > 0 else 1.0 - axis)
    normal[2] = np.copysign(along, point[2])
    return (out if out > 0 else max(side, end)) - sizes[2]


@compiled(error_model="numpy")
def _to_ellipsoid(point: FloatArray, sizes: FloatArray, normal: FloatArray) -> float:
    least = min(sizes[0], sizes[1], sizes[2]) ** 2
    t = -least * (1 - 1e-9)
    for axis in range(3):
        t = max(t, sizes[axis] * abs(point[axis]) - sizes[axis] ** 2)
    for _ in range(ROUNDS):
        value, slope = -1.0, 0.0
        for axis in range(3):
            share = sizes[axis] * point[axis] / (t + sizes[axis] ** 2)
            value += share**2
            slope -= 2 * share**2 / (t + sizes[axis] ** 2)
        if slope == 0.0 or abs(value) < ENOUGH:
            break
        t -= value / slope
    length, away = 0.0, 0.0
    for axis in range(3):
        x = sizes[axis] ** 2 * point[axis] / (t + sizes[axis] ** 2)
        normal[axis] = x / sizes[axis] ** 2
        length += normal[axis] ** 2
        away += (point[axis] - x) ** 2
    normal /= np.sqrt(length) if length > 0 else 1.0
    return np.copysign(np.sqrt(away), t)


@compiled(error_model="numpy")
def distances_to(points: FloatArray, kind: int, sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (k,), mm, and outward normals (k, 3) of points (k, 3)."""
    if kind < SWEPT:
        found, normal, _ = solid(points, kind, sizes)
        return found, normal
    found, normal = np.empty(len(points)), np.empty((len(points), 3))
    for k in range(len(points)):
        found[k] = distance_to(points[k], kind, sizes, normal[k])
    return found, normal
