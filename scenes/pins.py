"""The pins of a TacTip: their layout as data, and their size."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import Field, ValidationError, model_validator

from scenes.base import OpenSection, Positive, SpecError, problem_text
from scenes.layouts import MOST_PINS
from scenes.plugins import classes

if TYPE_CHECKING:
    from scenes.layouts.base import Layout


class PinsSpec(OpenSection):
    """Pins on the skin's inside, normal to it.

    Attributes
    ----------
    layout : str
        Name of the layout: "rings", "hexagon", "grid", "positions", or one of another package. Each has keys of its own.
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

    part_key: ClassVar[str] = "layout"

    layout: str = "rings"
    missing: tuple[Annotated[int, Field(ge=0)], ...] = ()
    spacing: Literal["polar", "plan"] = "polar"
    max_polar_deg: Annotated[float, Field(gt=0, lt=90)] = 64.0
    reach_mm: Positive | None = None
    phase_deg: float = 0.0
    length_mm: Positive = 1.1
    diameter_mm: Positive = 0.8
    cap_diameter_mm: Positive = 1.18
    cap_height_mm: Positive = 0.1

    @classmethod
    def parts(cls) -> "Mapping[str, type[Layout]]":
        from scenes.layouts.base import Layout  # it loads NumPy

        return classes("layouts", Layout)

    @property
    def shape(self) -> "Layout":
        """The layout with its keys."""
        return self.part

    @property
    def complete_count(self) -> int:
        """Number of pins of the layout before any is missing."""
        return self.shape.count

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
        return f"{self.count} pins {self.shape.in_words()}" + (f", {len(self.missing)} missing" if self.missing else "")

    @model_validator(mode="after")
    def _check_missing(self) -> Self:
        complete = self.complete_count
        if len(set(self.missing)) < len(self.missing):
            raise ValueError("missing names a pin twice")
        if self.missing and max(self.missing) >= complete:
            raise ValueError(f"missing names pin {max(self.missing)}, but the pins of this layout are 0 to {complete - 1}")
        if 2 * len(self.missing) >= complete:
            raise ValueError(f"missing names {len(self.missing)} of {complete} pins; at least half must be there")
        if not 3 <= self.count <= MOST_PINS:
            raise ValueError(f"a layout has 3 to {MOST_PINS} pins, this one has {self.count}")
        return self


def layout_from(text: str) -> PinsSpec:
    """Layout from a text: ``rings:10``, ``hexagon:6``, ``grid:9x7`` (columns, rows) or ``positions:FILE.csv``.

    Raises
    ------
    SpecError
        If the text has another form, or if the layout is impossible.
    """
    name, _, size = text.partition(":")
    kinds = PinsSpec.parts()
    forms = {kind: f"{kind}:{layout.example}" for kind, layout in kinds.items() if layout.example}
    if name not in kinds:
        raise SpecError(f"layout {text}: not known; give one of {', '.join(forms.values())}")
    try:
        return PinsSpec.model_validate({"layout": name, **kinds[name].from_text(size).model_dump()})
    except SpecError:
        raise
    except ValidationError as error:
        raise SpecError(f"layout {text}: {problem_text(error.errors()[0])}") from error
    except ValueError as error:
        raise SpecError(f"layout {text}: {error}; give for example {forms.get(name, name)}") from error
