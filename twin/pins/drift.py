"""Labelling of blobs by coherent point drift, for contacts in which neighbouring pins move less alike than `twin.pins.matching` needs.

The layout at rest is a Gaussian mixture that drifts to the blobs (Myronenko and Song, "Point set registration: coherent point drift",
2010, with the low-rank kernel of their section 6). A Gaussian kernel keeps its motion coherent: ``beta`` is the kernel's width in
spacings, ``lambda`` the weight of coherence against fit. All pins are drawn at once, so no first pair has to be right, and a ring that is
squeezed to half its spacing beside a field stretched to twice it is one smooth motion. A labelling proves itself: each pin stands on a
blob of its own, and no triangle of the layout is turned over.
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from twin.compiled import compiled
from twin.pins.reference import Reference, turned_over

STIFFNESS = ((2.0, 2.0), (1.5, 1.0), (3.0, 3.0), (1.0, 0.5))
"""Widths beta, in spacings, and weights lambda of coherence that are tried in turn until a labelling proves itself."""
OUTLIERS = 0.02
"""Least share of the blobs that are expected to be no pins."""
ROUNDS = 120
"""Most rounds of a drift."""
SETTLED = 1e-3
"""Relative change of the variance below which a drift ends."""
LEAST_VARIANCE = 1e-4
"""Least variance of the mixture, in squared spacings."""
FARTHEST = 16.0
"""Exponent of the mixture beyond which a pin does not draw a blob."""
REACH = 0.6
"""Largest distance from a pin to its blob after the drift, in spacings."""
SPECK = 0.2
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


def drifted(reference: Reference, px: np.ndarray, area_px2: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Blob (N,) of each pin, -1 for none, and places (N, 2) to which the pins drifted; None if no stiffness proves itself.

    The first one is used that leaves no pin lost, or no blob; else the one with most pins.

    Parameters
    ----------
    reference : Reference
    px, area_px2 : (K, 2), (K,) float
        Places and areas of the blobs.
    """
    n, caps = len(reference.pins_px), np.flatnonzero(area_px2 >= SPECK * np.median(area_px2))
    if not (1 - MOST_LOST) * n <= len(caps) <= MOST_BLOBS * n:
        return None
    spacing = float(np.median(reference.spacing_px))
    rest, blobs = reference.pins_px / spacing, px[caps] / spacing
    best, most = None, (1 - MOST_LOST) * n
    for beta, stiffness in STIFFNESS:
        places = _drift(rest, blobs, reference.motions(beta), stiffness)
        found = _assigned(places, blobs)
        known = found >= 0
        if known.sum() < most or np.mean(np.sum((blobs[found] - places)[known] ** 2, axis=1)) > MOST_MISFIT**2:
            continue
        left = np.delete(blobs, found[known], axis=0)
        near = int((((left - places[:, None]) ** 2).sum(axis=2).min(axis=0) < 1).sum()) if len(left) else 0
        folded = turned_over(reference, np.where(known[:, None], blobs[found], places), known).any()
        if near <= MOST_LEFT * n and not folded:
            best, most = (np.where(known, caps[found], -1), places * spacing), known.sum() + 1
            if known.sum() == min(n, len(caps)):
                break
    return best


def _drift(rest: np.ndarray, blobs: np.ndarray, motions: np.ndarray, stiffness: float) -> np.ndarray:
    """Places (N, 2) to which pins at rest (N, 2) drift among blobs (K, 2), all in spacings, by motions (N, m) of unit weight."""
    n, count = len(rest), len(blobs)
    places, unit = rest.copy(), np.eye(motions.shape[1])
    variance = float(((blobs - rest[:, None]) ** 2).sum() / (2 * n * count))
    outliers = max(OUTLIERS, 1 - n / count)
    for _ in range(ROUNDS):
        uniform = 2 * np.pi * variance * outliers / (1 - outliers) * n / count
        mass, drawn, square = _expected(places, blobs, variance, uniform)
        inner = motions.T @ (mass[:, None] * motions) + stiffness * variance * unit
        places = rest + motions @ np.linalg.solve(inner, motions.T @ (drawn - mass[:, None] * rest))
        moved = square - 2 * (drawn * places).sum() + (mass * (places**2).sum(axis=1)).sum()
        before, variance = variance, max(float(moved / (2 * mass.sum())), LEAST_VARIANCE)
        if abs(variance - before) < SETTLED * before:
            break
    return places


@compiled()
def _expected(places: np.ndarray, blobs: np.ndarray, variance: float, uniform: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Mass (N,) of the blobs that each pin draws, their sum (N, 2), and the sum of their squared distances from the origin."""
    n = len(places)
    mass, drawn, share, square = np.zeros(n), np.zeros((n, 2)), np.zeros(n), 0.0
    for k in range(len(blobs)):
        total = uniform
        for i in range(n):
            away = ((blobs[k, 0] - places[i, 0]) ** 2 + (blobs[k, 1] - places[i, 1]) ** 2) / (2 * variance)
            share[i] = np.exp(-away) if away < FARTHEST else 0.0
            total += share[i]
        for i in range(n):
            if share[i] > 0:
                part = share[i] / total
                mass[i] += part
                drawn[i, 0] += part * blobs[k, 0]
                drawn[i, 1] += part * blobs[k, 1]
                square += part * (blobs[k, 0] ** 2 + blobs[k, 1] ** 2)
    return mass, drawn, square


def _assigned(places: np.ndarray, blobs: np.ndarray) -> np.ndarray:
    """Blob (N,) of each pin, -1 for none: as many pairs within reach as possible, the nearest of all."""
    share2 = ((blobs - places[:, None]) ** 2).sum(axis=2) / REACH**2
    pins, chosen = linear_sum_assignment(np.minimum(share2, 1.0))
    found = np.full(len(places), -1)
    held = share2[pins, chosen] < 1
    found[pins[held]] = chosen[held]
    return found
