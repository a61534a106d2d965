"""How far simulated pins are from recorded ones."""

from collections.abc import Sequence

import numpy as np


def pin_errors(simulated_px: np.ndarray, measured_px: np.ndarray) -> np.ndarray:
    """Mean over the pins of their distance, for each frame: (..., M) of (..., M, N, 2); lost pins (NaN) are left out."""
    return np.nanmean(np.linalg.norm(simulated_px - measured_px, axis=-1), axis=-1)


def ring_bias(rest_px: np.ndarray, simulated_px: np.ndarray, measured_px: np.ndarray, rings: int) -> np.ndarray:
    """Mean outward error of each ring of pins, from the innermost.

    Parameters
    ----------
    rest_px : (N, 2) float
        No contact, in the specification's pin order.
    simulated_px, measured_px : (M, N, 2) float
    rings : int

    Returns
    -------
    (rings,) float
        px; positive: the simulated pins lie too far out.
    """
    across = rest_px - rest_px[0]
    outward = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    error = np.nanmean(np.sum((simulated_px - measured_px) * outward, axis=2), axis=0)
    first = [1 + 3 * ring * (ring - 1) for ring in range(1, rings + 2)]
    return np.array([error[start:stop].mean() for start, stop in zip(first[:-1], first[1:], strict=True)])


def binned_means(values: np.ndarray, by: np.ndarray, edges: Sequence[float]) -> np.ndarray:
    """Mean of the values whose ``by`` lies in each bin (the last one closed); NaN where a bin is empty."""
    where = np.clip(np.searchsorted(edges, by, side="right") - 1, 0, len(edges) - 2)
    return np.array([values[where == k].mean() if (where == k).any() else np.nan for k in range(len(edges) - 1)])
