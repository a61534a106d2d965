"""The simplest law."""

from scenes.materials.base import MaterialLaw


class NeoHookean(MaterialLaw):
    """The neo-Hookean law: c10 alone."""

    def coefficients(self) -> tuple[float, float, float, float]:
        return 1.0, 0.0, 0.0, 0.0
