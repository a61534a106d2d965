"""Coherent point drift: a Gaussian mixture of points drifts to other points, and its motion is kept smooth.

Myronenko and Song, "Point set registration: coherent point drift", 2010, with the low-rank kernel of their section 6. A Gaussian kernel
keeps the motion coherent: its width is called beta there, and the weight of coherence against fit lambda. All points are drawn at once, so
no first pair has to be right, and a ring that is squeezed to half its spacing beside a field stretched to twice it is one smooth motion.
"""

import numpy as np
from scipy.spatial.distance import cdist

MOST_MOTIONS, LEAST_MOTION = 60, 1e-6
"""Largest number of coherent motions, and least eigenvalue of one relative to the largest."""
OUTLIERS = 0.02
"""Least share of the other points that are expected to belong to no point."""
ROUNDS = 120
"""Most rounds of a drift."""
SETTLED = 1e-2
"""Relative change of the variance below which a drift ends."""
LEAST_VARIANCE = 1e-4
"""Least variance of the mixture, in squared spacings."""
FARTHEST = 16.0
"""Exponent of the mixture beyond which a point does not draw another."""


def coherent_motions(points: np.ndarray, width: float) -> np.ndarray:
    """Coherent motions (N, m) of points (N, 2): eigenvectors of a Gaussian kernel of this width, times the roots of their eigenvalues."""
    size, modes = np.linalg.eigh(np.exp(-((points[:, None] - points) ** 2).sum(axis=2) / (2 * width**2)))
    kept = np.flatnonzero(size > LEAST_MOTION * size[-1])[-MOST_MOTIONS:]
    return np.ascontiguousarray(modes[:, kept] * np.sqrt(size[kept]))


def drift(points: np.ndarray, others: np.ndarray, motions: np.ndarray, stiffness: float) -> np.ndarray:
    """Places (N, 2) to which points (N, 2) drift among others (K, 2), all in spacings, by their coherent motions (N, m)."""
    n, count = len(points), len(others)
    places, unit = points.copy(), np.eye(motions.shape[1])
    variance = float(((others - points[:, None]) ** 2).sum() / (2 * n * count))
    outliers = max(OUTLIERS, 1 - n / count)
    for _ in range(ROUNDS):
        uniform = 2 * np.pi * variance * outliers / (1 - outliers) * n / count
        away = cdist(others, places, "sqeuclidean") / (2 * variance)
        share = np.where(away < FARTHEST, np.exp(-away), 0)
        share /= uniform + share.sum(axis=1, keepdims=True)
        mass, drawn, square = share.sum(axis=0), share.T @ others, share.sum(axis=1) @ (others**2).sum(axis=1)
        inner = motions.T @ (mass[:, None] * motions) + stiffness * variance * unit
        places = points + motions @ np.linalg.solve(inner, motions.T @ (drawn - mass[:, None] * points))
        moved = square - 2 * (drawn * places).sum() + (mass * (places**2).sum(axis=1)).sum()
        before, variance = variance, max(float(moved / (2 * mass.sum())), LEAST_VARIANCE)
        if abs(variance - before) < SETTLED * before:
            break
    return places
