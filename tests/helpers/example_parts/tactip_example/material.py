"""A material law."""

from typing import Annotated

from pydantic import Field

from twin.extend import MaterialLaw


class Biderman(MaterialLaw):
    """Biderman's law: all four coefficients.

    Attributes
    ----------
    c01_c10, c20_c10, c30_c10 : float
        Relative to c10.
    """

    c01_c10: Annotated[float, Field(ge=0)] = 0.0
    c20_c10: Annotated[float, Field(ge=0)] = 0.0
    c30_c10: Annotated[float, Field(ge=0)] = 0.0

    def coefficients(self) -> tuple[float, float, float, float]:
        c10 = 1 / (1 + self.c01_c10)
        return c10, c10 * self.c01_c10, c10 * self.c20_c10, c10 * self.c30_c10
