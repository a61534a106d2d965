"""Measures of caps by their distance from the disc's centre, real and rendered side by side."""

from dataclasses import dataclass

import numpy as np

# Bins of the distance from the disc's centre.
BINS = 8


@dataclass(frozen=True)
class RadialRow:
    """One measure in one bin: mean of the real and of the rendered caps, and the relative difference."""

    measure: str
    inner_px: float
    outer_px: float
    real: float
    rendered: float

    @property
    def difference(self) -> float:
        """Rendered against real, relative."""
        return self.rendered / self.real - 1


def equal_count_edges(distance_px: np.ndarray, bins: int = BINS) -> np.ndarray:
    """(bins + 1,) edges between which there are equally many of the distances."""
    return np.quantile(distance_px[np.isfinite(distance_px)], np.linspace(0, 1, bins + 1))


def bin_of(distance_px: np.ndarray, edges_px: np.ndarray) -> np.ndarray:
    """Index of each distance's bin. A distance beyond the edges belongs to the outer bins; NaN to none (-1)."""
    index = np.clip(np.searchsorted(edges_px, distance_px, side="right") - 1, 0, len(edges_px) - 2)
    return np.where(np.isfinite(distance_px), index, -1)


def radial_rows(
    measure: str, real: tuple[np.ndarray, np.ndarray], rendered: tuple[np.ndarray, np.ndarray], edges_px: np.ndarray
) -> list[RadialRow]:
    """A measure in every bin. ``real`` and ``rendered`` are distances, px, and values, (n,) each; NaN values are left out."""
    means = []
    for distance, values in (real, rendered):
        where = bin_of(distance, edges_px)
        each = [values[(where == k) & np.isfinite(values)] for k in range(len(edges_px) - 1)]
        means.append([float(v.mean()) if len(v) else np.nan for v in each])
    pairs = zip(edges_px[:-1], edges_px[1:], *means, strict=True)
    return [RadialRow(measure, float(inner), float(outer), a, b) for inner, outer, a, b in pairs]
