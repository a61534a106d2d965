"""Sampling of pixels: which pixels need many samples, and well-distributed random numbers in Dr.Jit.

Pixels that show pins need many samples, because edges are noisy. Dark bare skin is free of noise after few samples; bright skin is not,
because pins shadow it.
"""

from copy import copy
from types import ModuleType

import cv2
import numpy as np

from scenes.sensor import AppearanceSpec, PinsSpec, ViewSpec
from twin.camera.projection import project
from twin.geometry.pins import across_axis
from twin.optics.variant import DrJit
from twin.types import BoolArray, PinState

SKIN_SAVING = 4
"""Ratio of the samples of a pixel that may show a pin to those of a pixel that shows only bare skin."""
MARGIN_PX = 2.0
"""Length in px that is added to the radius of each pin, because the estimated place of its edge may be wrong by this much."""
SUBPIXEL_BITS = 4
"""Number of fractional bits of the places of lines that OpenCV draws: the unit is 1 / 16 px."""
GOLDEN = 0x9E3779B9
"""2^32 divided by the golden ratio. Multiples of it give the hash very different seeds for consecutive dimensions."""


def near_pins(
    view: ViewSpec, pins: PinsSpec, appearance: AppearanceSpec, state: PinState, window_px: tuple[int, int, int, int]
) -> BoolArray:
    """Pixels (H, W) bool of a window of the raw frame that may show a part of a pin, from its foot to its cap."""
    x0, y0, x1, y1 = window_px
    across, back = across_axis(state.axis)
    middle = project(view, state.caps_mm)
    reach_mm = 0.5 * pins.cap_diameter_mm * float(1 + np.abs(np.array(appearance.cap_shapes or [[0.0]])).sum(axis=1).max())
    sides = [project(view, state.caps_mm + reach_mm * way) for way in (across, -back)]
    radius = np.max([np.linalg.norm(side - middle, axis=1) for side in sides], axis=0) + MARGIN_PX
    feet = project(view, state.base_mm)
    mask, ends = np.zeros((y1 - y0, x1 - x0), np.uint8), np.stack([feet, middle], axis=1) - [x0, y0]
    fine = np.rint(ends * (1 << SUBPIXEL_BITS)).astype(np.int32)
    width = np.ceil(2 * radius).astype(int)
    for wide in np.unique(width):
        cv2.polylines(mask, list(fine[width == wide]), False, 1, int(wide), cv2.LINE_8, SUBPIXEL_BITS)  # the lines have round ends
    return mask.astype(bool)


PASCAL_STEPS = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


def times_pascal(bits: DrJit) -> DrJit:
    """Bits of a UInt32 times Pascal's triangle modulo 2: read in reverse, the second coordinate of Sobol's sequence.

    Bit j of the result is the sum of the bits k for which the binomial coefficient (k over j) is odd. By Lucas' theorem these are the k
    that have all ones of j. Therefore five steps, one for each digit of k, do the work of a 32 x 32 matrix. (Mitsuba's own ``sobol_2`` and
    ``radical_inverse_2`` belong to the backend that a process uses first, and fail with another one.)
    """
    for shift, where in PASCAL_STEPS:
        bits = bits ^ ((bits >> shift) & where)
    return bits


class PixelSamples:
    """Random numbers for ``spp`` samples in each of many pixels. In each dimension a pixel's samples form a scrambled (0, 2)-net:
    the first 2^m points have one in each box of the sizes 2^-k x 2^(k-m) (Sobol 1967).

    Each dimension has its own scramble and its own order of samples, so that dimensions are not correlated (padding; Kollig and Keller
    2002).

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
        self._seed, self._dimension = dr.opaque(mi.UInt32, seed), 0  # opaque, so that another seed uses the same kernel

    def of(self, chosen: DrJit) -> "PixelSamples":
        """The remaining random numbers of some of the samples."""
        part = copy(self)
        part._pixel, part._index = (self._dr.gather(self._mi.UInt32, values, chosen) for values in (self._pixel, self._index))
        return part

    def next_1d(self) -> DrJit:
        """Uniform numbers in [0, 1)."""
        order, scramble, _ = self._scrambles()
        return self._uniform(self._dr.brev(order) ^ scramble)

    def next_2d(self) -> DrJit:
        """Uniform points in the unit square."""
        order, first, second = self._scrambles()
        brev = self._dr.brev
        return self._mi.Point2f(self._uniform(brev(order) ^ first), self._uniform(brev(times_pascal(order)) ^ second))

    def _uniform(self, bits: DrJit) -> DrJit:
        """The number 0.b31 b30 ... b9 of a UInt32: its highest 23 bits behind the point."""
        return self._dr.reinterpret_array(self._mi.Float, (bits >> 9) | 0x3F800000) - 1

    def _scrambles(self) -> tuple[DrJit, DrJit, DrJit]:
        mi = self._mi
        self._dimension += 1
        salt = self._seed * 0x85EBCA6B + (self._dimension * GOLDEN) % 2**32
        first, second = mi.sample_tea_32(self._pixel, salt)
        order = self._index if self._spp == 1 else mi.permute_kensler(self._index, self._spp, first ^ 0x5BD1E995)
        return order, first, second
