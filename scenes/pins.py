"""The pins of a TacTip: their layout as data, and their size."""

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from scenes.base import Positive, Section, SpecError
from scenes.files import read_regular

MOST_PINS = 5000
"""Largest number of pins. The finest printed sensors have about 3000."""

LARGEST_PLACES = 1_000_000
"""Largest size, in bytes, of a file of pins' positions. ``MOST_PINS`` positions in full precision need less."""

_Place = Annotated[float, Field(ge=-1e9, le=1e9)]
"""A coordinate of a pin, in any unit. The bounds are large enough for nanometres."""

LEAST_WIDTH = 0.01
"""Tolerance for positions on a line: largest distance from the line, relative to its length."""

Layout = Literal["rings", "hexagon", "grid", "positions"]
_OWN_KEYS: dict[Layout, tuple[str, ...]] = {
    "rings": ("rings",),
    "hexagon": ("rings",),
    "grid": ("columns", "rows", "row_distance"),
    "positions": ("positions",),
}
"""Keys of each layout. All are required, except ``row_distance``, which has a default."""


class PinsSpec(Section):
    """Pins on the skin's inside, normal to it.

    Attributes
    ----------
    layout : {"rings", "hexagon", "grid", "positions"}
        "rings" and "hexagon" have a pin at the centre and 6 i pins on ring i, which is a circle or a hexagon. "grid" has rows and columns.
        "positions" is any other layout, given by the position of each pin.
    rings : int
        For ``rings`` and ``hexagon``: number of rings r. There are 1 + 3 r (r + 1) pins.
    columns, rows : int
        For ``grid``: number of columns (side by side along x) and of rows (along y), before the rotation by ``phase_deg``.
    row_distance : float
        For ``grid``: distance of neighbouring rows, relative to the distance of neighbouring columns.
    positions : (N, 2) float
        For ``positions``: x and y of each pin from the axis, seen along the axis, in any unit. The layout is scaled so that the outermost
        pin is at ``max_polar_deg``.
    missing : tuple of int
        Missing pins of the layout, by their index in the complete layout, from 0. The other pins keep their order.
    spacing : {"polar", "plan"}
        Quantity that is proportional to the distance from the centre of the layout: the polar angle ("polar"), or its sine ("plan"). With
        "plan" the layout keeps its shape seen along the axis.
    max_polar_deg : float
        On a cap: polar angle of the outermost pins (the corner pins of a hexagon or grid).
    reach_mm : float, optional
        Distance of the outermost pins' feet from the axis. It is required on a flat pad. On a cap it replaces ``max_polar_deg``.
    phase_deg : float
        Rotation of the layout from x towards y. At 0 the first pin of each ring is on x.
    length_mm, diameter_mm : float
        Length and diameter of the stem. The defaults of the stem and of the cap are those of a printed TacTip with 331 pins.
    cap_diameter_mm, cap_height_mm : float
        Diameter and height of the white cap at the pin's end.
    """

    layout: Layout = "rings"
    rings: Annotated[int, Field(ge=1, le=40)] | None = None
    columns: Annotated[int, Field(ge=2, le=100)] | None = None
    rows: Annotated[int, Field(ge=2, le=100)] | None = None
    row_distance: Annotated[float, Field(ge=0.1, le=10)] = 1.0
    positions: Annotated[tuple[tuple[_Place, _Place], ...], Field(max_length=MOST_PINS)] = ()
    missing: tuple[Annotated[int, Field(ge=0)], ...] = ()
    spacing: Literal["polar", "plan"] = "polar"
    max_polar_deg: Annotated[float, Field(gt=0, lt=90)] = 64.0
    reach_mm: Positive | None = None
    phase_deg: float = 0.0
    length_mm: Positive = 1.1
    diameter_mm: Positive = 0.8
    cap_diameter_mm: Positive = 1.18
    cap_height_mm: Positive = 0.1

    @property
    def complete_count(self) -> int:
        """Number of pins of the layout before any is missing."""
        if self.layout == "grid":
            return (self.columns or 0) * (self.rows or 0)
        if self.layout == "positions":
            return len(self.positions)
        rings = self.rings or 0
        return 1 + 3 * rings * (rings + 1)

    @property
    def count(self) -> int:
        """Number of pins N."""
        return self.complete_count - len(self.missing)

    def largest_polar_rad(self, radius_mm: float) -> float | None:
        """Polar angle of the outermost pins on the inside of a cap of this radius; None if ``reach_mm`` is larger than the radius."""
        if self.reach_mm is None:
            return math.radians(self.max_polar_deg)
        return math.asin(self.reach_mm / radius_mm) if self.reach_mm < radius_mm else None

    def in_words(self) -> str:
        """The layout in words, such as '331 pins in 10 rings'."""
        shape = {
            "rings": f"in {self.rings} rings",
            "hexagon": f"in a hexagon of {self.rings} rings",
            "grid": f"in {self.rows} rows and {self.columns} columns",
            "positions": "at given positions",
        }[self.layout]
        return f"{self.count} pins {shape}" + (f", {len(self.missing)} missing" if self.missing else "")

    @model_validator(mode="after")
    def _check_layout(self) -> Self:
        own = _OWN_KEYS[self.layout]
        for key in own:
            if not getattr(self, key):
                raise ValueError(f"layout = '{self.layout}' needs {key}")
        for layout, keys in _OWN_KEYS.items():
            for key in keys:
                if key not in own and getattr(self, key) != PinsSpec.model_fields[key].default:
                    raise ValueError(f"{key} belongs to layout = '{layout}', not to '{self.layout}'")
        if len(set(self.missing)) < len(self.missing):
            raise ValueError("missing names a pin twice")
        if self.missing and max(self.missing) >= self.complete_count:
            raise ValueError(f"missing names pin {max(self.missing)}, but the pins of this layout are 0 to {self.complete_count - 1}")
        if 2 * len(self.missing) >= self.complete_count:
            raise ValueError(f"missing names {len(self.missing)} of {self.complete_count} pins; at least half must be there")
        if not 3 <= self.count <= MOST_PINS:
            raise ValueError(f"a layout has 3 to {MOST_PINS} pins, this one has {self.count}")
        if self.layout == "positions" and len(set(self.positions)) < len(self.positions):
            raise ValueError("positions has two pins at one place")
        if self.layout == "positions" and self._on_a_line():
            raise ValueError("positions lie on one line; give a layout that covers an area")
        return self

    def _on_a_line(self) -> bool:
        (x0, y0), *others = self.positions
        far_x, far_y = max(((x - x0, y - y0) for x, y in others), key=lambda d: d[0] ** 2 + d[1] ** 2)
        length2 = far_x**2 + far_y**2
        return all(abs(far_x * (y - y0) - far_y * (x - x0)) <= LEAST_WIDTH * length2 for x, y in others)


def layout_from(text: str) -> PinsSpec:
    """Layout from a text: ``rings:10``, ``hexagon:6``, ``grid:9x7`` (columns, rows) or ``positions:FILE.csv``.

    Raises
    ------
    SpecError
        If the text has another form, or if the layout is impossible.
    """
    kind, _, size = text.partition(":")
    if kind in ("rings", "hexagon") and not size.strip().isdecimal():
        raise SpecError(f"layout {text}: the number of rings is missing or no number; give for example {kind}:10")
    if kind == "grid" and not all(part.strip().isdecimal() for part in size.partition("x")[::2]):
        raise SpecError(f"layout {text}: the numbers of columns and rows are missing or no numbers; give for example grid:9x7")
    try:
        if kind in ("rings", "hexagon"):
            return PinsSpec(layout="rings" if kind == "rings" else "hexagon", rings=int(size))
        if kind == "grid":
            columns, _, rows = size.partition("x")
            return PinsSpec(layout="grid", columns=int(columns), rows=int(rows))
        if kind == "positions":
            return PinsSpec(layout="positions", positions=_places_in(Path(size)))
    except SpecError:
        raise
    except ValidationError as error:
        raise SpecError(f"layout {text}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error
    except ValueError as error:
        raise SpecError(f"layout {text}: {error}; give rings:10, hexagon:6, grid:9x7 or positions:FILE.csv") from error
    raise SpecError(f"layout {text}: not known; give rings:10, hexagon:6, grid:9x7 or positions:FILE.csv")


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
