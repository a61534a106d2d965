"""What a layout of pins is, and what one is that can be recognised in frames."""

from abc import ABC, abstractmethod
from functools import cache
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scenes.base import Section, SpecError

MOST_RINGS = 16
"""Largest number of rings that is searched. Printed TacTips have 3 to 11."""


class Layout(Section, ABC):
    """A layout of pins seen along the axis. Its keys are keys of ``[pins]``."""

    example: ClassVar[str] = ""
    """A size in the form of ``from_text``; empty if there is none."""

    @abstractmethod
    def places(self) -> NDArray[np.float64]:
        """Places (N, 2) of the pins of the complete layout, in any unit. Their order is that of the pins."""

    @abstractmethod
    def in_words(self) -> str:
        """The layout behind its number of pins, such as 'in 10 rings'."""

    @property
    def count(self) -> int:
        """Number of places N."""
        return len(self.places())

    def border(self) -> NDArray[np.intp] | None:
        """Places on the border, in order around it; None if it is to be computed from all places."""
        return None

    def ring_ends(self) -> NDArray[np.intp]:
        """Ring i has the places from ``ring_ends[i - 1]`` to ``ring_ends[i]``, the last excluded, in order around the centre (R + 1,)."""
        return np.array([0, self.count])

    @classmethod
    def from_text(cls, size: str) -> Self:
        """The layout of a size in the form of ``example``.

        Raises
        ------
        ValueError
            There is none.
        """
        raise ValueError("this layout has no size; write its keys into a specification")

    def resize(self, by: int) -> str:
        """Text for ``from_text`` of a layout that is larger by ``by`` rings, or rows and columns.

        Raises
        ------
        SpecError
            There is none.
        """
        raise SpecError("this layout has no other size; give the layout as text")


class LatticeLayout(Layout):
    """A layout that is recognised in frames: the spots of a frame are labelled by a large lattice, of which the layout is a part.

    ``order`` is its place in the search, and ``seeds`` the number of spots from which a labelling is started. ``corners`` is the number of
    nearest spots around a start, and ``gaps_deg`` the smallest and largest angle between the directions to them.
    """

    order: ClassVar[int]
    lines: ClassVar[str]
    seeds: ClassVar[int] = 12  # such a lattice may start at any pin
    corners: ClassVar[int]
    gaps_deg: ClassVar[tuple[float, float]]

    @classmethod
    @abstractmethod
    def largest(cls) -> Self:
        """The lattice: neighbours are 1 apart."""

    @classmethod
    @abstractmethod
    def start(cls) -> tuple[int, NDArray[np.intp]]:
        """A place in the lattice's middle, and the ``corners`` places around it, from x towards y."""

    @classmethod
    @abstractmethod
    def find(cls, labelled: NDArray[np.bool_], shown: NDArray[np.bool_]) -> tuple[Self, NDArray[np.intp]] | None:
        """The layout with the most labels and the fewest empty places in view, and its places (N,) in the lattice.

        Parameters
        ----------
        labelled, shown : (M,) bool
            Whether each place of the lattice has a spot, and whether it is in view.
        """

    @abstractmethod
    def at_most_labels(self, labelled: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        """Places (N,) in the lattice at which this layout holds most labels; None if it is too large."""

    @abstractmethod
    def sides(self) -> list[NDArray[np.intp]]:
        """Places of the lattice just outside, one array for each side; empty for the largest layout that is searched."""

    def own_places(self) -> NDArray[np.intp]:
        """Places (N,) in the lattice around which ``sides`` lie."""
        return np.arange(self.count)


class RingedLayout(LatticeLayout):
    """A pin at the centre, and 6 i pins on ring i."""

    lines = "rings"
    example = "10"
    corners = 6
    gaps_deg = (25.0, 100.0)

    rings: Annotated[int, Field(ge=1, le=40)]

    @property
    def count(self) -> int:
        return 1 + 3 * self.rings * (self.rings + 1)

    def border(self) -> NDArray[np.intp]:
        return np.arange(self.count - 6 * self.rings, self.count)

    def ring_ends(self) -> NDArray[np.intp]:
        return 1 + 3 * np.arange(self.rings + 1) * np.arange(1, self.rings + 2)

    @classmethod
    def from_text(cls, size: str) -> Self:
        if not size.strip().isdecimal():
            raise ValueError("the number of rings is missing or no number")
        return cls(rings=int(size))

    def resize(self, by: int) -> str:
        return str(self.rings + by)

    @classmethod
    def largest(cls) -> Self:
        return cls(rings=MOST_RINGS)

    @classmethod
    @cache
    def ring_of_place(cls) -> NDArray[np.intp]:
        """Ring (M,) of each place of the lattice."""
        rings = np.arange(1, MOST_RINGS + 1)
        return np.concatenate([[0], np.repeat(rings, 6 * rings)])

    @classmethod
    def start(cls) -> tuple[int, NDArray[np.intp]]:
        return 0, np.arange(1, 7)

    def sides(self) -> list[NDArray[np.intp]]:
        return [] if self.rings >= MOST_RINGS else [np.arange(self.count, self.count + 6 * (self.rings + 1))]
