"""What a hyperelastic law is."""

from abc import ABC, abstractmethod

from scenes.base import Section


class MaterialLaw(Section, ABC):
    """A hyperelastic law of a rubber. Its keys are keys of ``[skin]`` and ``[gel]``.

    The energy of a change of shape is (``twin.mechanics.body.material``)

        W = c10 (I1 - 3) + c01 (I2 - 3) + c20 (I1 - 3)^2 + c30 (I1 - 3)^3.
    """

    @abstractmethod
    def coefficients(self) -> tuple[float, float, float, float]:
        """c10, c01, c20 and c30, relative to half the shear modulus at small strain. The first two sum to 1."""
