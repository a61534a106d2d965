"""The motion model: displacement is locally affine over a pin's neighbours."""

import numpy as np
from numba import njit

# Pull of the local gradient towards zero, as strong as this many neighbours at one spacing.
RIDGE = 0.25


@njit(cache=True)
def predict(
    i: int, rest: np.ndarray, neighbours: np.ndarray, spacing: np.ndarray, moved: np.ndarray, weight: np.ndarray
) -> tuple[float, float, int]:
    """Displacement of pin ``i`` from that of its neighbours alone, and how many neighbours counted.

    Weighted least squares of u(x) = a + G (x - x_i) over the neighbours with ``weight`` > 0. The gradient
    G is lightly pulled to zero, so that one neighbour is enough.

    Parameters
    ----------
    i : int
    rest : (N, 2) float
    neighbours : (N, k) int
    spacing : (N,) float
    moved : (N, 2) float
        Current positions, px.
    weight : (N,) float
        Trust in each current position, 0 where there is none.

    Returns
    -------
    ux, uy : float
        Displacement, px.
    count : int
    """
    s2 = spacing[i] * spacing[i]
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
        x = (rest[j, 0] - rest[i, 0]) / spacing[i]
        y = (rest[j, 1] - rest[i, 1]) / spacing[i]
        w = weight[j] / (0.5 + (x * x + y * y))
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
    if count == 0 or s2 == 0:
        return 0.0, 0.0, 0
    c00 = m11 * m22 - m12 * m12
    c01 = m02 * m12 - m01 * m22
    c02 = m01 * m12 - m02 * m11
    det = m00 * c00 + m01 * c01 + m02 * c02
    return (c00 * bx0 + c01 * bx1 + c02 * bx2) / det, (c00 * by0 + c01 * by1 + c02 * by2) / det, count


@njit(cache=True)
def predict_all(rest: np.ndarray, neighbours: np.ndarray, spacing: np.ndarray, moved: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Each pin's position (N, 2) as its neighbours predict it; NaN where no neighbour counts."""
    out = np.empty_like(rest)
    for i in range(len(rest)):
        ux, uy, count = predict(i, rest, neighbours, spacing, moved, weight)
        out[i, 0] = rest[i, 0] + ux if count else np.nan
        out[i, 1] = rest[i, 1] + uy if count else np.nan
    return out
