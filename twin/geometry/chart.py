"""Charts of the skin: maps from a square to the places of a dome or a rectangular pad. The grid of the square is fine around the contact.

A place on the dome is a point w of the unit disc, as a complex number. Its radius is the polar angle divided by the largest polar angle,
and its angle is the azimuth. A ``Focus`` rotates and stretches the image of the square:

    (u, v) -> w1 (squared disc) -> w2 = e^(i turn) w1 s(|w1|) / |w1| -> w = (w2 + a) / (1 + conj(a) w2)

The elliptical map x = u sqrt(1 - v^2 / 2), y = v sqrt(1 - u^2 / 2) maps the square to a disc without degenerate elements (Fong, "Analytical
methods for squaring the disc", 2015). The function s(r) = c r + (1 - c) r^5 concentrates the lines of the grid at the centre. A Moebius
transformation moves the centre to the contact, and maps the rim to itself. All three maps are smooth.
"""

from dataclasses import dataclass

import numpy as np

from twin.types import ComplexArray, FloatArray

_POWER = 5
"""Power in s(r) = c r + (1 - c) r^5. A higher power makes the spacing of the lines within the focus more uniform."""
_FINE = 0.75
"""Radius of the part of the square that is mapped to the focus, relative to half the square's side."""
_LARGEST_SHIFT = 0.45
"""Largest shift a of the Moebius transformation. With more than 0.5, elements at the rim turn inside out for some rotations of the grid."""
_LEAST_SLOPE = 0.2
"""Smallest c on round skins. It limits how small the elements at the centre of the focus become."""

_LEAST_PAD_SLOPE = 0.5
"""Smallest c on rectangles: elements twice as fine are enough. The grid of a rectangle is fine along two whole strips, and coarse
elsewhere."""


@dataclass(frozen=True)
class Focus:
    """The part of the dome on which the grid is fine.

    Attributes
    ----------
    polar_rad, azimuth_rad : float
        Direction of the centre of the fine part.
    radius_rad : float
        Angular radius of the fine part.
    turn_rad : float
        Rotation of the grid's rows about the centre. At the apex it is the azimuth of the rows.
    """

    polar_rad: float = 0.0
    azimuth_rad: float = 0.0
    radius_rad: float = float(np.radians(50.0))
    turn_rad: float = 0.0


@dataclass(frozen=True)
class Chart:
    """The map between (u, v) in [-1, 1]^2 and the unit disc, for a focus on a dome that ends at ``largest_polar_rad``."""

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
        r = _ungather(np.minimum(np.abs(w), 1.0), self._centre_slope)
        return square_of_disc(w / np.maximum(np.abs(w), 1e-300) * r)


@dataclass(frozen=True)
class RectangleChart:
    """The map between (u, v) in [-1, 1]^2 and the places x + i y of a rectangle, in the same square, for a focus.

    Each axis uses the one-dimensional maps of ``Chart``: t -> s(t) -> (s + a) / (1 + a s). The lines of the grid stay parallel to the
    sides, so that corners are mapped to corners. The rotation of the focus is ignored.
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
        x, y = ((s + a) / (1 + a * s) for s, a in ((_gather(t, c), a) for t, (a, c) in zip(square.T, self._axes, strict=True)))
        return x + 1j * y

    def square(self, disc: ComplexArray) -> FloatArray:
        """Square points (k, 2) of places (k,)."""
        shifted = ((p - a) / (1 - a * p) for p, (a, _) in zip((disc.real, disc.imag), self._axes, strict=True))
        return np.column_stack(
            [np.sign(s) * _ungather(np.minimum(np.abs(s), 1.0), c) for s, (_, c) in zip(shifted, self._axes, strict=True)]
        )


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
    """Slope c with which s maps ``_FINE`` to ``share``, the radius of the focus relative to the rim; limited to permitted values."""
    return float(np.clip((share - _FINE**_POWER) / (_FINE - _FINE**_POWER), _LEAST_SLOPE, 1.0))


def _gather(r: FloatArray, c: float) -> FloatArray:
    """s(r) = c r + (1 - c) r^5."""
    return r * (c + (1 - c) * r ** (_POWER - 1))


def _ungather(wanted: FloatArray, c: float) -> FloatArray:
    """Inverse of ``_gather`` for values from 0 to 1, by Newton's method inside a shrinking bracket."""
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
