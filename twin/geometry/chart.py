"""Charts of the dome: from a square to a disc to directions, fine where a contact is.

A place on the dome is a point w of the unit disc (as a complex number): its radius is the polar angle
over the largest one, its azimuth the azimuth. A ``Focus`` turns and stretches the square's image:

    (u, v) -> w1 (squared disc) -> w2 = e^(i turn) w1 s(|w1|) / |w1| -> w = (w2 + a) / (1 + conj(a) w2)

The elliptical map x = u sqrt(1 - v^2 / 2), y = v sqrt(1 - u^2 / 2) makes a disc of the square without
collapsing an element (Fong, "Analytical methods for squaring the disc", 2015). The function s(r) = c r + (1 - c) r^5
gathers the lines of the grid at the centre. A Moebius transformation moves the centre to where the contact is and
keeps the rim on the rim. All three maps are smooth.
"""

from dataclasses import dataclass

import numpy as np

from twin.types import ComplexArray, FloatArray

_POWER = 5
"""Power in s(r) = c r + (1 - c) r^5: the higher it is, the more evenly the lines lie within the focus."""
_FINE = 0.75
"""Share of the square's half side whose image is the focus."""
_LARGEST_SHIFT = 0.45
"""Largest shift a of the Moebius transformation. Beyond 0.5 elements at the rim turn inside out for some turns of the grid."""
_LEAST_SLOPE = 0.2
"""Smallest c: it bounds how small the elements at the centre of the focus get."""

_LEAST_PAD_SLOPE = 0.5
"""Smallest c on rectangles. Their grid is fine along two whole strips, and coarse elsewhere; elements twice as fine are enough."""


@dataclass(frozen=True)
class Focus:
    """The part of the dome over which the grid is fine.

    Attributes
    ----------
    polar_rad, azimuth_rad : float
        Direction of the centre.
    radius_rad : float
        Angle around it that the fine part covers.
    turn_rad : float
        Turn of the grid's rows about the centre; at the apex it is their azimuth.
    """

    polar_rad: float = 0.0
    azimuth_rad: float = 0.0
    radius_rad: float = float(np.radians(50.0))
    turn_rad: float = 0.0


@dataclass(frozen=True)
class Chart:
    """The map (u, v) in [-1, 1]^2 <-> disc for a focus, on a dome down to ``largest_polar_rad``."""

    focus: Focus
    largest_polar_rad: float

    @property
    def _shift(self) -> complex:
        size = min(self.focus.polar_rad / self.largest_polar_rad, _LARGEST_SHIFT)
        return complex(size * np.exp(1j * self.focus.azimuth_rad))

    @property
    def _centre_slope(self) -> float:
        return _slope(self.focus.radius_rad / self.largest_polar_rad / (1 - abs(self._shift) ** 2))

    def disc(self, square: FloatArray) -> ComplexArray:
        """Complex disc points (k,) of square points (k, 2)."""
        w = disc_of_square(square)
        r = np.minimum(np.abs(w), 1.0)
        c = self._centre_slope
        w = w * (c + (1 - c) * r ** (_POWER - 1)) * np.exp(1j * self.focus.turn_rad)
        a = self._shift
        return (w + a) / (1 + a.conjugate() * w)

    def square(self, disc: ComplexArray) -> FloatArray:
        """Square points (k, 2) of complex disc points (k,)."""
        a = self._shift
        w = (disc - a) / (1 - a.conjugate() * disc) * np.exp(-1j * self.focus.turn_rad)
        r = _spread(np.minimum(np.abs(w), 1.0), self._centre_slope)
        return square_of_disc(w / np.maximum(np.abs(w), 1e-300) * r)


@dataclass(frozen=True)
class RectangleChart:
    """The map (u, v) in [-1, 1]^2 <-> places of a rectangle, for a focus: x + i y in the same square.

    Each axis has the one-dimensional maps of ``Chart``: t -> s(t) -> (s + a) / (1 + a s). The lines stay parallel to the sides, so that
    corners stay corners; the focus' turn does not count.
    """

    focus: Focus
    largest_polar_rad: float

    @property
    def _axes(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Shift a and slope c of the axes u and v."""
        size = min(self.focus.polar_rad / self.largest_polar_rad, 1.0)
        middle = square_of_disc(np.array([size * np.exp(1j * self.focus.azimuth_rad)]))[0]
        reach = self.focus.radius_rad / self.largest_polar_rad
        shifts = np.clip(middle, -_LARGEST_SHIFT, _LARGEST_SHIFT).tolist()
        slopes = [max(_slope(reach / (1 - a * a)), _LEAST_PAD_SLOPE) for a in shifts]
        return (shifts[0], slopes[0]), (shifts[1], slopes[1])

    def disc(self, square: FloatArray) -> ComplexArray:
        """Places (k,) of square points (k, 2)."""
        x, y = ((s + a) / (1 + a * s) for s, a in ((_gathered(t, c), a) for t, (a, c) in zip(square.T, self._axes, strict=True)))
        return x + 1j * y

    def square(self, disc: ComplexArray) -> FloatArray:
        """Square points (k, 2) of places (k,)."""
        shifted = ((p - a) / (1 - a * p) for p, (a, _) in zip((disc.real, disc.imag), self._axes, strict=True))
        return np.column_stack([np.sign(s) * _spread(np.minimum(np.abs(s), 1.0), c) for s, (_, c) in zip(shifted, self._axes, strict=True)])


def disc_of_square(square: FloatArray) -> ComplexArray:
    """Complex disc points (k,) of square points (k, 2), by the elliptical map."""
    u, v = square.T
    return u * np.sqrt(1 - v * v / 2) + 1j * v * np.sqrt(1 - u * u / 2)


def square_of_disc(disc: ComplexArray) -> FloatArray:
    """Inverse of ``disc_of_square``."""
    x, y = disc.real, disc.imag
    root = 2 * np.sqrt(2)

    def half(p: FloatArray, q: FloatArray) -> FloatArray:
        plus = np.sqrt(np.maximum(2 + p * p - q * q + root * p, 0))
        return (plus - np.sqrt(np.maximum(2 + p * p - q * q - root * p, 0))) / 2

    return np.column_stack([half(x, y), half(y, x)])


def _slope(share: float) -> float:
    """Slope c at the centre with which the focus, a share of the way to the rim, is the image of the square's inner ``_FINE``."""
    return float(np.clip((share - _FINE**_POWER) / (_FINE - _FINE**_POWER), _LEAST_SLOPE, 1.0))


def _gathered(r: FloatArray, c: float) -> FloatArray:
    """s(r) = c r + (1 - c) r^5."""
    return r * (c + (1 - c) * r ** (_POWER - 1))


def _spread(wanted: FloatArray, c: float) -> FloatArray:
    """Inverse of ``_gathered`` for 0 to 1: Newton's method kept inside a shrinking bracket."""
    r = np.sqrt(wanted)
    low, high = np.zeros_like(r), np.ones_like(r)
    for _ in range(60):
        off = c * r + (1 - c) * r**_POWER - wanted
        low, high = np.where(off < 0, r, low), np.where(off > 0, r, high)
        r = r - off / (c + _POWER * (1 - c) * r ** (_POWER - 1))
        r = np.where((r < low) | (r > high), (low + high) / 2, r)
        if np.abs(off).max(initial=0) < 1e-15:
            break
    return r
