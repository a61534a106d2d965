"""A law that becomes stiffer at large strain."""

from scenes.base import NonNegative
from scenes.materials.base import MaterialLaw


class Yeoh(MaterialLaw):
    """Yeoh's law: c10, c20 and c30.

    Attributes
    ----------
    c20_c10, c30_c10 : float
        c20 and c30 relative to c10.
    """

    c20_c10: NonNegative = 0.0
    c30_c10: NonNegative = 0.0

    def coefficients(self) -> tuple[float, float, float, float]:
        return 1.0, 0.0, self.c20_c10, self.c30_c10
