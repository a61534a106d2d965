"""Pins in a hexagon."""

from functools import cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from scenes.layouts.base import MOST_RINGS, RingedLayout


class Hexagon(RingedLayout):
    """Hexagons around a pin at the centre: a triangular lattice. Corners are at multiples of 60 deg, and each side has equal parts.

    Attributes
    ----------
    rings : int
        Number of rings r. There are 1 + 3 r (r + 1) pins.
    """

    order = 2
    example = "6"

    def places(self) -> NDArray[np.float64]:
        points = [np.zeros(1, complex)]
        for ring in range(1, self.rings + 1):
            side, step = np.divmod(np.arange(6 * ring), ring)
            start, end = np.exp(1j * np.pi / 3 * side), np.exp(1j * np.pi / 3 * (side + 1))
            points.append(ring * start + (end - start) * step)
        z = np.concatenate(points)
        return np.column_stack([z.real, z.imag])

    def in_words(self) -> str:
        return f"in a hexagon of {self.rings} ring{'s' * (self.rings > 1)}"

    @classmethod
    @cache
    def axial(cls) -> NDArray[np.intp]:
        """Integer coordinates (M, 2) of the lattice's places. The first axis is along x."""
        x, y = cls.largest().places().T
        r = y / (np.sqrt(3) / 2)
        return np.round(np.column_stack([x - r / 2, r])).astype(int)

    @classmethod
    def find(cls, labelled: NDArray[np.bool_], shown: NDArray[np.bool_]) -> tuple[Self, NDArray[np.intp]] | None:
        q, taken = cls.axial(), np.flatnonzero(labelled)
        best, most, rings = 0, -np.inf, 0
        for middle in taken:
            widest = int(MOST_RINGS - cls.ring_of_place()[middle]) + 1
            full, hollow = (np.bincount(_steps(q[part] - q[middle]), minlength=widest)[:widest] for part in (taken, shown & ~labelled))
            gain = np.cumsum(full - hollow)
            r = int(gain.argmax())
            if gain[r] > most:
                best, most, rings = int(middle), float(gain[r]), r
        return (cls(rings=rings), cls(rings=rings)._around(best)) if rings else None

    def at_most_labels(self, labelled: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        q, taken = self.axial(), np.flatnonzero(labelled)
        fitting = [m for m in taken.tolist() if self.ring_of_place()[m] + self.rings <= MOST_RINGS]
        if not fitting:
            return None
        return self._around(int(max(fitting, key=lambda m: int((_steps(q[taken] - q[m]) <= self.rings).sum()))))

    def _around(self, middle: int) -> NDArray[np.intp]:
        """Places (N,) of the hexagon around a middle place."""
        q = self.axial()
        number = np.zeros((2 * MOST_RINGS + 1,) * 2, int)
        number[tuple(q.T)] = np.arange(len(q))  # negative coordinates count from the end
        return number[tuple((q[: self.count] + q[middle]).T)]


def _steps(axial: NDArray[np.intp]) -> NDArray[np.intp]:
    """Distance (n,) from the origin of a triangular lattice, as a number of steps between neighbours."""
    return np.max(np.abs(np.column_stack([axial, axial.sum(axis=1)])), axis=1)
