"""The law with the second invariant."""

from scenes.base import Fraction
from scenes.materials.base import MaterialLaw


class MooneyRivlin(MaterialLaw):
    """The law of Mooney and Rivlin: c10 and c01.

    Attributes
    ----------
    second_invariant_share : float
        c01 / (c10 + c01).
    """

    second_invariant_share: Fraction = 0.0

    def coefficients(self) -> tuple[float, float, float, float]:
        return 1 - self.second_invariant_share, self.second_invariant_share, 0.0, 0.0
