"""A layout."""

from typing import Annotated

import numpy as np
from pydantic import Field

from twin.extend import Layout


class Spiral(Layout):
    """Pins on a spiral of Fermat, which covers a disc evenly.

    Attributes
    ----------
    pins : int
        Number of pins.
    """

    example = "91"

    pins: Annotated[int, Field(ge=3, le=1000)]

    def places(self) -> np.ndarray:
        k = np.arange(self.pins)
        z = np.sqrt(k) * np.exp(1j * np.pi * (3 - np.sqrt(5)) * k)
        return np.column_stack([z.real, z.imag])

    def in_words(self) -> str:
        return "on a spiral"

    @classmethod
    def from_text(cls, size: str) -> "Spiral":
        return cls(pins=int(size))
