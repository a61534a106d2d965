"""Pins in circles."""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from scenes.layouts.base import MOST_RINGS, RingedLayout

FULL_RING = 0.5
"""Least share of a ring's places in view that have a spot."""


class Rings(RingedLayout):
    """Circles around a pin at the centre, each from x towards y. Ring i has 6 i pins.

    Attributes
    ----------
    rings : int
        Number of rings r. There are 1 + 3 r (r + 1) pins.
    """

    order = 1
    seeds = 40  # rings have only one centre, which a contact displaces

    def places(self) -> NDArray[np.float64]:
        z = np.concatenate([[0j], *(ring * np.exp(2j * np.pi * np.arange(6 * ring) / (6 * ring)) for ring in range(1, self.rings + 1))])
        return np.column_stack([z.real, z.imag])

    def in_words(self) -> str:
        return f"in {self.rings} ring{'s' * (self.rings > 1)}"

    @classmethod
    def find(cls, labelled: NDArray[np.bool_], shown: NDArray[np.bool_]) -> tuple[Self, NDArray[np.intp]] | None:
        ring_of_place, rings = cls.ring_of_place(), 0
        for ring in range(1, MOST_RINGS + 1):  # from the middle outwards, as far as they are seen
            there = labelled & (ring_of_place == ring)
            if there.sum() < FULL_RING * max((shown & (ring_of_place == ring)).sum(), 1) or there.sum() < 2:
                break
            rings = ring
        return (cls(rings=rings), np.flatnonzero(ring_of_place <= rings)) if rings else None

    def at_most_labels(self, labelled: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        return np.arange(self.count) if self.rings <= MOST_RINGS else None
