"""Pins at given positions."""

from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from scenes.base import SpecError
from scenes.files import read_regular
from scenes.layouts import MOST_PINS
from scenes.layouts.base import Layout

LARGEST_PLACES = 1_000_000
"""Largest size, in bytes, of a file of pins' positions. ``MOST_PINS`` positions in full precision need less."""

_Place = Annotated[float, Field(ge=-1e9, le=1e9)]
"""A coordinate of a pin, in any unit. The bounds are large enough for nanometres."""

LEAST_WIDTH = 0.01
"""Tolerance for positions on a line: largest distance from the line, relative to its length."""


class Positions(Layout):
    """Any other layout, by the place of each pin.

    Attributes
    ----------
    positions : (N, 2) float
        x and y of each pin from the axis, seen along the axis, in any unit. The layout is scaled so that the outermost pin is at
        ``max_polar_deg``.
    """

    example = "FILE.csv"

    positions: Annotated[tuple[tuple[_Place, _Place], ...], Field(max_length=MOST_PINS)]

    @property
    def count(self) -> int:
        return len(self.positions)

    def places(self) -> NDArray[np.float64]:
        return np.array(self.positions, float)

    def in_words(self) -> str:
        return "at given positions"

    @classmethod
    def from_text(cls, size: str) -> Self:
        return cls(positions=_places_in(Path(size)))

    def resize(self, by: int) -> str:
        raise SpecError("a layout of given positions has no rings; correct its CSV file")

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        if len(set(self.positions)) < len(self.positions):
            raise ValueError("positions has two pins at one place")
        away = self.places() - self.positions[0] if self.positions else np.zeros((1, 2))
        far = away[(away**2).sum(axis=1).argmax()]
        if (np.abs(away @ [far[1], -far[0]]) <= LEAST_WIDTH * (far @ far)).all():
            raise ValueError("positions lie on one line; give a layout that covers an area")
        return self


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _places_in(path: Path) -> tuple[tuple[float, float], ...]:
    """x and y in each line of a CSV file. Lines that begin with # are passed over, and so is a header before the first pin."""
    try:
        lines = read_regular(path, LARGEST_PLACES).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        how = error.strerror if isinstance(error, OSError) else "no UTF-8 text"
        raise SpecError(f"{path}: can't be read ({how}); give a CSV file with x,y of one pin in each line") from error
    places: list[tuple[float, float]] = []
    header = False
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
        if not line.strip() or line.startswith("#"):
            continue
        try:
            x, y = map(float, cells)
        except ValueError:
            if places or header or any(_is_number(cell) for cell in cells):
                raise SpecError(f"{path}, line {number}: expected two numbers, x,y, got {line[:40]!r}") from None
            header = True
            continue
        places.append((x, y))
    return tuple(places)
