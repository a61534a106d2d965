"""B-splines, the basis of the skin and the gel.

A quadratic basis of m elements has m + 2 functions and is C1; a linear basis has m + 1 functions and is C0. At both ends a spline
equals its first and last coefficient (open knot vector; Piegl & Tiller, "The NURBS Book", ch. 2).
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import BSpline

from twin.types import FloatArray, IntArray

_legendre = cache(np.polynomial.legendre.leggauss)


@dataclass(frozen=True)
class Basis:
    """B-splines of a degree between ``breaks`` (elements + 1,)."""

    breaks: FloatArray
    degree: int = 2

    @property
    def elements(self) -> int:
        """Number of intervals."""
        return len(self.breaks) - 1

    @property
    def count(self) -> int:
        """Number of functions."""
        return self.elements + self.degree

    @property
    def _knots(self) -> FloatArray:
        return np.concatenate([[self.breaks[0]] * self.degree, self.breaks, [self.breaks[-1]] * self.degree])

    @property
    def greville(self) -> FloatArray:
        """Greville points (count,): means of ``degree`` neighbouring knots. The coefficients of a linear function are its values there."""
        knots = self._knots
        return np.array([knots[i + 1 : i + 1 + self.degree].mean() for i in range(self.count)])

    def values(self, at: FloatArray, *, derivative: int = 0) -> FloatArray:
        """Values (k, count) of all functions, or of one of their derivatives, at points (k,)."""
        splines = BSpline.construct_fast(self._knots, np.eye(self.count), self.degree)
        return (splines.derivative(derivative) if derivative else splines)(np.clip(at, self.breaks[0], self.breaks[-1]))

    def element_of(self, at: FloatArray) -> IntArray:
        """Index (k,) of the element that contains each point."""
        return np.clip(np.searchsorted(self.breaks, at, side="right") - 1, 0, self.elements - 1)

    def gauss(self, points: int) -> tuple[FloatArray, FloatArray]:
        """Gauss points and weights (elements, points) of every element."""
        local, weights = _legendre(points)
        half = np.diff(self.breaks)[:, None] / 2
        return (self.breaks[1:] + self.breaks[:-1])[:, None] / 2 + half * local, half * weights
