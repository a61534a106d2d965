"""Tricubic B-splines on a regular grid: value, slope and second derivative in one pass.

The code loops over tuples and plain numbers, because slices of arrays would take more time than the sums.
"""

from typing import TypeAlias

import numpy as np

from twin.compiled import compiled
from twin.types import FloatArray

Four: TypeAlias = tuple[float, float, float, float]

_SUMS = {"contract", "reassoc"}
"""Permissions for the compiler: to reorder sums and to fuse products. They nearly halve the time. NaN stays NaN."""


@compiled(error_model="numpy", fastmath=_SUMS)
def _cell(at: float, count: int) -> tuple[int, float]:
    """The node below ``at`` (in nodes), limited so that it has one neighbour before it and two after it, and ``at``'s distance from it."""
    cell = min(max(int(np.floor(at)), 1), count - 3)
    return cell, at - cell


@compiled(error_model="numpy", fastmath=_SUMS)
def _weights(t: float) -> Four:
    """Weights of four nodes at the place ``t`` (0 to 1) between the second and the third."""
    s = 1 - t
    return s**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * s**2 + 3 * s**3) / 6, t**3 / 6


@compiled(error_model="numpy", fastmath=_SUMS)
def _slopes(t: float) -> Four:
    s = 1 - t
    return -(s**2) / 2, (3 * t - 4) * t / 2, (4 - 3 * s) * s / 2, t**2 / 2


@compiled(error_model="numpy", fastmath=_SUMS)
def _bends(t: float) -> Four:
    return 1 - t, 3 * t - 2, 1 - 3 * t, t


@compiled(error_model="numpy", fastmath=_SUMS)
def _line(weights: Four, values: FloatArray, i: int, j: int, k: int) -> float:
    """Weighted sum over four nodes along the last axis."""
    return (
        weights[0] * values[i, j, k]
        + weights[1] * values[i, j, k + 1]
        + weights[2] * values[i, j, k + 2]
        + weights[3] * values[i, j, k + 3]
    )


@compiled(error_model="numpy", fastmath=_SUMS)
def _step_in(point: float, low: float, spacing: float, count: int) -> tuple[float, float]:
    """A coordinate in units of nodes, limited to the grid, and its distance outside of the grid in mm."""
    inside = min(max(point, low + 2 * spacing), low + (count - 3) * spacing)
    return (inside - low) / spacing, point - inside


@compiled(error_model="numpy", fastmath=_SUMS)
def _place(
    points: FloatArray, k: int, corner: FloatArray, spacing: float, counts: tuple[int, ...]
) -> tuple[tuple[int, float], tuple[int, float], tuple[int, float], tuple[float, float, float]]:
    """The cells of point k along the three axes, and its distances outside of the grid along these axes, mm."""
    x, away_x = _step_in(points[k, 0], corner[0], spacing, counts[0])
    y, away_y = _step_in(points[k, 1], corner[1], spacing, counts[1])
    z, away_z = _step_in(points[k, 2], corner[2], spacing, counts[2])
    return _cell(x, counts[0]), _cell(y, counts[1]), _cell(z, counts[2]), (away_x, away_y, away_z)


@compiled(error_model="numpy", fastmath=_SUMS)
def spline_value(coefficients: FloatArray, corner: FloatArray, spacing: float, points: FloatArray) -> FloatArray:
    """Values (k,) at points (k, 3). Outside the grid the distance to the grid is added."""
    value = np.empty(len(points))
    counts = coefficients.shape
    for k in range(len(points)):
        (i, tx), (j, ty), (m, tz), (away_x, away_y, away_z) = _place(points, k, corner, spacing, counts)
        wx, wy, wz = _weights(tx), _weights(ty), _weights(tz)
        f = np.sqrt(away_x * away_x + away_y * away_y + away_z * away_z)
        for a in range(4):
            for b in range(4):
                f += wx[a] * wy[b] * _line(wz, coefficients, i - 1 + a, j - 1 + b, m - 1)
        value[k] = f
    return value


@compiled(error_model="numpy", fastmath=_SUMS)
def spline_probe(
    coefficients: FloatArray, corner: FloatArray, spacing: float, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values (k,), slopes (k, 3) and second derivatives (k, 3, 3) at points (k, 3). Outside the grid the distance to it is added."""
    value, slope, hessian = np.empty(len(points)), np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    counts, per_mm = coefficients.shape, 1 / spacing
    for k in range(len(points)):
        (i, tx), (j, ty), (m, tz), (away_x, away_y, away_z) = _place(points, k, corner, spacing, counts)
        wx, sx, bx = _weights(tx), _slopes(tx), _bends(tx)
        wy, sy, by = _weights(ty), _slopes(ty), _bends(ty)
        wz, sz, bz = _weights(tz), _slopes(tz), _bends(tz)
        f = fx = fy = fz = fxx = fxy = fxz = fyy = fyz = fzz = 0.0
        for a in range(4):
            g = gy = gz = gyy = gyz = gzz = 0.0  # summed over y and z
            for b in range(4):
                h = _line(wz, coefficients, i - 1 + a, j - 1 + b, m - 1)
                hz = _line(sz, coefficients, i - 1 + a, j - 1 + b, m - 1)
                hzz = _line(bz, coefficients, i - 1 + a, j - 1 + b, m - 1)
                g, gz, gzz = g + wy[b] * h, gz + wy[b] * hz, gzz + wy[b] * hzz
                gy, gyz, gyy = gy + sy[b] * h, gyz + sy[b] * hz, gyy + by[b] * h
            f, fy, fz = f + wx[a] * g, fy + wx[a] * gy, fz + wx[a] * gz
            fyy, fyz, fzz = fyy + wx[a] * gyy, fyz + wx[a] * gyz, fzz + wx[a] * gzz
            fx, fxy, fxz, fxx = fx + sx[a] * g, fxy + sx[a] * gy, fxz + sx[a] * gz, fxx + bx[a] * g
        value[k] = f
        slope[k, 0], slope[k, 1], slope[k, 2] = fx * per_mm, fy * per_mm, fz * per_mm
        square = per_mm * per_mm
        hessian[k, 0, 0], hessian[k, 1, 1], hessian[k, 2, 2] = fxx * square, fyy * square, fzz * square
        hessian[k, 0, 1] = hessian[k, 1, 0] = fxy * square
        hessian[k, 0, 2] = hessian[k, 2, 0] = fxz * square
        hessian[k, 1, 2] = hessian[k, 2, 1] = fyz * square
        if away_x != 0 or away_y != 0 or away_z != 0:
            value[k] += _add_gap(slope[k], hessian[k], (away_x, away_y, away_z))
    return value, slope, hessian


@compiled(error_model="numpy", fastmath=_SUMS)
def _add_gap(slope: FloatArray, hessian: FloatArray, away: tuple[float, float, float]) -> float:
    """Change slope and Hessian of a point outside the grid, by ``away`` along each axis, in place; returns the distance to the grid.

    Outside the grid the spline is constant along these axes, and the distance to the grid is added to it.
    """
    gap = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2)
    for i in range(3):
        if away[i] != 0:
            slope[i] = away[i] / gap
        for j in range(3):
            if away[i] != 0 and away[j] != 0:
                hessian[i, j] = ((i == j) - away[i] * away[j] / gap**2) / gap
            elif away[i] != 0 or away[j] != 0:
                hessian[i, j] = 0.0
    return gap
