"""Hyperelastic laws: stress and stiffness of a nearly incompressible rubber at one point.

All laws separate the change of volume from the distortion (Holzapfel, "Nonlinear Solid Mechanics", ch. 6):

    W = c10 (I1 - 3) + c01 (I2 - 3) + c20 (I1 - 3)^2 + c30 (I1 - 3)^3 + kappa / 2 (J - 1)^2

with I1 = J^(-2/3) tr C and I2 = J^(-4/3) (tr^2 C - tr C^2) / 2. The neo-Hookean law has c10 alone, Mooney-Rivlin c10 and c01, and Yeoh c10,
c20 and c30. At small strain the shear modulus is 2 (c10 + c01), and the bulk modulus is kappa.
"""

import numpy as np

from scenes.body import MaterialSpec
from twin.compiled import compiled
from twin.types import FloatArray

_LARGEST_DIFFERENCE = 9.0
"""Limit of kappa_d of an element that is quadratic through its depth, in units of the shear modulus mu. It was found with planes, balls and
edges that are pressed into a gel with a Poisson's ratio of 0.486: two layers of gel are 2 to 3 % too stiff with kappa_d = kappa (35 mu),
and 1 to 2 % too soft with 3.5 mu."""


def law_coefficients(spec: MaterialSpec, *, layer: bool) -> FloatArray:
    """Coefficients (6,) c10, c01, c20, c30, kappa and kappa_d of a material, MPa.

    ``layer`` selects kappa_d for the elements of a skin, which are linear through its depth (see ``elements``).
    """
    mu = spec.young_modulus_mpa / (2 * (1 + spec.poisson_ratio))
    kappa = spec.young_modulus_mpa / (3 * (1 - 2 * spec.poisson_ratio))
    limit = _LARGEST_DIFFERENCE * mu
    difference = 2 * mu * (spec.poisson_ratio / (1 - spec.poisson_ratio) + 1 / 3) if layer else kappa * limit / (kappa + limit)
    return np.array([*(mu / 2 * np.array(spec.part.coefficients())), kappa, difference])


@compiled(inline="always")
def invariants(f: FloatArray, g: FloatArray) -> float:
    """Return det F, and write F^-T into ``g`` (3, 3) if det F > 0."""
    g00 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
    g01 = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
    g02 = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
    det = f[0, 0] * g00 + f[0, 1] * g01 + f[0, 2] * g02
    if det > 0:
        d = 1 / det
        g[0, 0], g[0, 1], g[0, 2] = g00 * d, g01 * d, g02 * d
        g[1, 0] = (f[0, 2] * f[2, 1] - f[0, 1] * f[2, 2]) * d
        g[1, 1] = (f[0, 0] * f[2, 2] - f[0, 2] * f[2, 0]) * d
        g[1, 2] = (f[0, 1] * f[2, 0] - f[0, 0] * f[2, 1]) * d
        g[2, 0] = (f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]) * d
        g[2, 1] = (f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]) * d
        g[2, 2] = (f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]) * d
    return det


@compiled(fastmath=True)
def determinant(f: FloatArray) -> float:
    """det F."""
    minor_0 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
    minor_1 = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
    minor_2 = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
    return f[0, 0] * minor_0 + f[0, 1] * minor_1 + f[0, 2] * minor_2


@compiled(fastmath=True)
def first_piola(law: FloatArray, f: FloatArray, det: float, pressure: float, out: FloatArray) -> float:
    """Return the energy density of the law without kappa and c01, MPa.

    The function writes its derivative with respect to F, plus ``pressure`` d det F / dF, into ``out`` (3, 3), MPa.
    """
    f00, f01, f02, f10, f11, f12, f20, f21, f22 = f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2], f[2, 0], f[2, 1], f[2, 2]
    trace = f00 * f00 + f01 * f01 + f02 * f02 + f10 * f10 + f11 * f11 + f12 * f12 + f20 * f20 + f21 * f21 + f22 * f22
    scale = det ** (-2 / 3)
    first = scale * trace - 3
    a = 2 * scale * (law[0] + first * (2 * law[2] + 3 * law[3] * first))
    energy = first * (law[0] + first * (law[2] + law[3] * first))
    b = pressure - a * trace / (3 * det)
    out[0, 0] = a * f00 + b * (f11 * f22 - f12 * f21)
    out[0, 1] = a * f01 + b * (f12 * f20 - f10 * f22)
    out[0, 2] = a * f02 + b * (f10 * f21 - f11 * f20)
    out[1, 0] = a * f10 + b * (f02 * f21 - f01 * f22)
    out[1, 1] = a * f11 + b * (f00 * f22 - f02 * f20)
    out[1, 2] = a * f12 + b * (f01 * f20 - f00 * f21)
    out[2, 0] = a * f20 + b * (f01 * f12 - f02 * f11)
    out[2, 1] = a * f21 + b * (f02 * f10 - f00 * f12)
    out[2, 2] = a * f22 + b * (f00 * f11 - f01 * f10)
    return energy


@compiled(fastmath=True)
def add_second_stress(c01: float, f: FloatArray, out: FloatArray) -> float:
    """Add the c01 part of the law to a first Piola-Kirchhoff stress (3, 3); returns its energy density."""
    g = np.zeros((3, 3))
    scale = invariants(f, g) ** (-4 / 3)
    second, slopes = _second_invariant(f, (f * f).sum())
    for i in range(3):
        for j in range(3):
            out[i, j] += c01 * scale * (slopes[i, j] - 4 / 3 * second * g[i, j])
    return c01 * (scale * second - 3)


@compiled(fastmath=True)
def distortion_stiffness(law: FloatArray, f: FloatArray, det: float, g: FloatArray, out: FloatArray) -> None:
    """Write the second derivative of the distortion energy density with respect to F into ``out`` (3, 3, 3, 3): out[i, J, k, L], MPa."""
    trace, scale = 0.0, det ** (-2 / 3)
    for i in range(3):
        for j in range(3):
            trace += f[i, j] * f[i, j]
    first = scale * trace - 3
    slope = 2 * scale * (law[0] + first * (2 * law[2] + 3 * law[3] * first))
    bend = 4 * scale * scale * (2 * law[2] + 6 * law[3] * first)
    for i in range(3):
        for j in range(3):
            to_k, to_g = -2 / 3 * slope * g[i, j], slope * (2 / 9 * trace * g[i, j] - 2 / 3 * f[i, j])
            curved = bend * (f[i, j] - trace / 3 * g[i, j])
            for k in range(3):
                turned = slope * trace / 3 * g[k, j]
                for m in range(3):
                    out[i, j, k, m] = to_k * f[k, m] + to_g * g[k, m] + turned * g[i, m] + curved * (f[k, m] - trace / 3 * g[k, m])
            out[i, j, i, j] += slope
    if law[1] != 0:
        _add_second_stiffness(law[1] * scale * scale, f, g, trace, out)


@compiled(fastmath=True)
def _add_second_stiffness(factor: float, f: FloatArray, g: FloatArray, trace: float, out: FloatArray) -> None:
    """Add the c01 part of ``distortion_stiffness``."""
    second, slopes = _second_invariant(f, trace)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    curve = 4 * f[i, j] * f[k, m] - 2 * f[i, m] * f[k, j]
                    if i == k:
                        curve -= 2 * (f[0, j] * f[0, m] + f[1, j] * f[1, m] + f[2, j] * f[2, m])
                        if j == m:
                            curve += 2 * trace
                    if j == m:
                        curve -= 2 * (f[i, 0] * f[k, 0] + f[i, 1] * f[k, 1] + f[i, 2] * f[k, 2])
                    curve += second * (16 / 9 * g[i, j] * g[k, m] + 4 / 3 * g[i, m] * g[k, j])
                    out[i, j, k, m] += factor * (curve - 4 / 3 * (slopes[i, j] * g[k, m] + g[i, j] * slopes[k, m]))


@compiled(fastmath=True)
def _second_invariant(f: FloatArray, trace: float) -> tuple[float, FloatArray]:
    """I2 of C, and its derivative 2 (tr C F - F C) with respect to F."""
    c = f.T @ f
    second = (trace * trace - (c * c).sum()) / 2
    return second, 2 * (trace * f - f @ c)
