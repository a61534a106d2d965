"""Well-distributed random numbers for the samples of pixels, in Dr.Jit's terms."""

from types import ModuleType

from twin.optics.variant import DrJit

GOLDEN = 0x9E3779B9
"""2^32 over the golden ratio: spreads consecutive dimensions over the seeds of the hash."""


class PixelSamples:
    """Numbers for ``spp`` samples in each of many pixels: every dimension a scrambled (0, 2)-net over a pixel's samples.

    Dimensions are decorrelated by scrambles and orders of their own (padding; Kollig and Keller 2002).

    Parameters
    ----------
    mi, dr : modules
        Mitsuba, its variant set, and Dr.Jit.
    pixel : mi.UInt32
        Number of each sample's pixel.
    index : mi.UInt32
        Number of the sample in its pixel, below ``spp``.
    spp : int
    seed : int
    """

    def __init__(self, mi: ModuleType, dr: ModuleType, pixel: DrJit, index: DrJit, spp: int, seed: int) -> None:
        self._mi, self._dr, self._pixel, self._index, self._spp = mi, dr, pixel, index, spp
        self._seed, self._dimension = dr.opaque(mi.UInt32, seed), 0  # not a constant: a new seed needs no new kernel

    def of(self, chosen: DrJit) -> "PixelSamples":
        """The further numbers of some samples only."""
        part = PixelSamples.__new__(PixelSamples)
        part.__dict__.update(self.__dict__)
        part._pixel, part._index = (self._dr.gather(self._mi.UInt32, values, chosen) for values in (self._pixel, self._index))
        return part

    def next_1d(self) -> DrJit:
        """Uniform numbers in [0, 1)."""
        order, scramble, _ = self._scrambles()
        return self._mi.radical_inverse_2(order, scramble)

    def next_2d(self) -> DrJit:
        """Uniform points in the unit square."""
        order, first, second = self._scrambles()
        return self._mi.Point2f(self._mi.radical_inverse_2(order, first), self._mi.sobol_2(order, second))

    def _scrambles(self) -> tuple[DrJit, DrJit, DrJit]:
        mi = self._mi
        self._dimension += 1
        salt = self._seed * 0x85EBCA6B + (self._dimension * GOLDEN) % 2**32
        first, second = mi.sample_tea_32(self._pixel, salt)
        order = self._index if self._spp == 1 else mi.permute_kensler(self._index, self._spp, first ^ 0x5BD1E995)
        return order, first, second
