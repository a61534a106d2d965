"""Pins in rows and columns."""

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from scenes.layouts.base import LatticeLayout

HALF = 20
"""Largest number of columns and rows that is searched on each side of the place at which a grid starts."""
SIDE = 2 * HALF + 1


class Grid(LatticeLayout):
    """Rows and columns: row by row, each from small to large x.

    Attributes
    ----------
    columns, rows : int
        Number of columns (side by side along x) and of rows (along y), before the rotation by ``phase_deg``.
    row_distance : float
        Distance of neighbouring rows, relative to the distance of neighbouring columns; the default is a square grid.
    """

    order = 3
    lines = "rows or columns"
    example = "9x7"
    corners = 4
    gaps_deg = (60.0, 120.0)

    columns: Annotated[int, Field(ge=2, le=100)]
    rows: Annotated[int, Field(ge=2, le=100)]
    row_distance: Annotated[float, Field(ge=0.1, le=10)] = 1.0

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def places(self) -> NDArray[np.float64]:
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.column_stack([(x - (self.columns - 1) / 2).ravel(), self.row_distance * (y - (self.rows - 1) / 2).ravel()])

    def border(self) -> NDArray[np.intp]:
        number = np.arange(self.count).reshape(self.rows, self.columns)
        return np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])

    def in_words(self) -> str:
        return f"in {self.rows} rows and {self.columns} columns"

    @classmethod
    def from_text(cls, size: str) -> Self:
        columns, _, rows = size.partition("x")
        if not (columns.strip().isdecimal() and rows.strip().isdecimal()):
            raise ValueError("the numbers of columns and rows are missing or no numbers")
        return cls(columns=int(columns), rows=int(rows))

    def resize(self, by: int) -> str:
        return f"{self.columns + by}x{self.rows + by}"

    @classmethod
    def largest(cls) -> Self:
        return cls(columns=SIDE, rows=SIDE)

    @classmethod
    def start(cls) -> tuple[int, NDArray[np.intp]]:
        middle = SIDE * SIDE // 2
        return middle, middle + np.array([1, SIDE, -1, -SIDE])

    @classmethod
    def find(cls, labelled: NDArray[np.bool_], shown: NDArray[np.bool_]) -> tuple[Self, NDArray[np.intp]] | None:
        there = labelled.reshape(SIDE, SIDE)
        gain = np.where(there, 1, np.where(shown.reshape(SIDE, SIDE), -1, 0))
        sums = np.pad(gain.cumsum(axis=0), ((1, 0), (0, 0)))
        best: tuple[int, int, int, int] | None = None
        most = 0
        rows = np.flatnonzero(there.any(axis=1)).tolist()
        for k, top in enumerate(rows):
            for bottom in rows[k + 1 :]:
                line = sums[bottom + 1] - sums[top]  # the range of columns with the largest sum (Kadane's algorithm)
                run, first = 0, 0
                for column in range(SIDE):
                    if run <= 0:
                        run, first = 0, column
                    run += int(line[column])
                    if run > most and column > first:
                        best, most = (top, first, bottom - top + 1, column - first + 1), run
        return None if best is None else (cls(columns=best[3], rows=best[2]), _rectangle(*best))

    def at_most_labels(self, labelled: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        if max(self.columns, self.rows) > SIDE:
            return None
        there = np.pad(labelled.reshape(SIDE, SIDE).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        height, width = self.rows, self.columns
        held = there[height:, width:] - there[:-height, width:] - there[height:, :-width] + there[:-height, :-width]
        top, left = np.unravel_index(held.argmax(), held.shape)
        return _rectangle(int(top), int(left), height, width)

    def sides(self) -> list[NDArray[np.intp]]:
        if max(self.columns, self.rows) > SIDE - 2:
            return []
        x, y = np.arange(1, self.columns + 1), np.arange(1, self.rows + 1)
        return [x, SIDE * (self.rows + 1) + x, SIDE * y, SIDE * y + self.columns + 1]

    def own_places(self) -> NDArray[np.intp]:
        return _rectangle(1, 1, self.rows, self.columns)


def _rectangle(top: int, left: int, rows: int, columns: int) -> NDArray[np.intp]:
    """Places in the lattice, row by row."""
    return (SIDE * np.arange(top, top + rows)[:, None] + np.arange(left, left + columns)).ravel()
