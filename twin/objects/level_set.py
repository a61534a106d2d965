"""The base of all signed-distance fields: distance, gradient and Hessian from one probe; and unit normals of fields that are not exact
distances.
"""

from abc import ABC, abstractmethod
from typing import TypeAlias

import numpy as np

from twin.compiled import compiled
from twin.types import FloatArray

Probe: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Distance (k,) in mm, unit gradient (k, 3) and Hessian (k, 3, 3) in 1/mm at k points; or texture coordinates and their derivatives."""
Triple: TypeAlias = tuple[float, float, float]

_FLAT = 1e-12
"""Length of a field's gradient below which it has no usable direction."""


class ObjectField(ABC):
    """A solid in the object frame, as a signed-distance field at points (k, 3) in mm."""

    @abstractmethod
    def probe(self, points_mm: FloatArray) -> Probe:
        """Distance (k,), gradient (k, 3) and Hessian (k, 3, 3) in 1/mm, in one evaluation.

        The Hessian is the second derivative of the distance. It is symmetric, the gradient is in its null space, and it is zero across
        creases. If a field is not an exact distance, it is the derivative of the unit gradient along the level set.
        """

    def distance(self, points_mm: FloatArray) -> FloatArray:
        """(k,) in mm, positive outside."""
        return self.probe(points_mm)[0]


class Wrapped(ObjectField):
    """A field on whose surface a texture can be laid."""

    def unroll(self, points_mm: FloatArray) -> Probe:
        """Two coordinates (k, 2) in mm along the surface, their gradients (k, 2, 3) and their Hessians (k, 2, 3, 3) in 1/mm.

        By default they are x and y: a pattern is projected along z.
        """
        slopes = np.zeros((len(points_mm), 2, 3))
        slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
        return rows(points_mm)[:, :2].copy(), slopes, np.zeros((len(points_mm), 2, 3, 3))


def rows(points_mm: FloatArray) -> FloatArray:
    """Points as C-ordered float64, which the kernels take. With one type of array each kernel is compiled only once."""
    return np.ascontiguousarray(points_mm, dtype=np.float64)


@compiled(error_model="numpy")
def unit_normals(slope: FloatArray, hessian: FloatArray) -> None:
    """Turn, in place, a field's slope g (k, 3) into the unit normal n and its second derivative H (k, 3, 3) into P H P / |g|, P = I - n n.

    The result is the derivative of n along the level set: it is symmetric, and H n = 0. It does not contain the change of n along n, which
    is zero for an exact distance. A place without slope gets the normal -z and no curvature.
    """
    for k in range(len(slope)):
        size = np.sqrt(slope[k, 0] ** 2 + slope[k, 1] ** 2 + slope[k, 2] ** 2)
        if size < _FLAT:
            for i in range(3):
                slope[k, i] = -1.0 if i == 2 else 0.0
                for j in range(3):
                    hessian[k, i, j] = 0.0
            continue
        n, along = (slope[k, 0] / size, slope[k, 1] / size, slope[k, 2] / size), 0.0
        for i in range(3):
            slope[k, i] = hessian[k, i, 0] * n[0] + hessian[k, i, 1] * n[1] + hessian[k, i, 2] * n[2]  # H n for now
            along += slope[k, i] * n[i]
        for i in range(3):
            for j in range(3):
                hessian[k, i, j] = (hessian[k, i, j] - (slope[k, i] * n[j] + slope[k, j] * n[i]) + along * (n[i] * n[j])) / size
        slope[k, 0], slope[k, 1], slope[k, 2] = n
