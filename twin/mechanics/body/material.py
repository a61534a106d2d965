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


def distortion_stress(law: FloatArray, f: FloatArray) -> FloatArray:
    """Second Piola-Kirchhoff stresses (..., 3, 3) of a law without kappa, MPa, at deformation gradients F (..., 3, 3)."""
    c, one = f.swapaxes(-1, -2) @ f, np.eye(3)
    inverse, squared = np.linalg.inv(c), np.linalg.det(f)[..., None, None] ** (2 / 3)
    trace = np.trace(c, axis1=-2, axis2=-1)[..., None, None]
    second = (trace**2 - (c**2).sum(axis=(-2, -1), keepdims=True)) / 2
    first = trace / squared - 3
    slope = law[0] + first * (2 * law[2] + 3 * law[3] * first)
    return 2 * (slope / squared * (one - trace / 3 * inverse) + law[1] / squared**2 * (trace * one - c - 2 / 3 * second * inverse))


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
def first_piola(law: FloatArray, f: FloatArray, det: float, g: FloatArray, pressure: float, out: FloatArray) -> float:
    """Return the energy density of the law without kappa and c01, MPa; ``g`` is F^-T.

    The function writes its derivative with respect to F, plus ``pressure`` d det F / dF, into ``out`` (3, 3), MPa.
    """
    trace, scale = 0.0, det ** (-2 / 3)
    for i in range(3):
        for j in range(3):
            trace += f[i, j] * f[i, j]
    first = scale * trace - 3
    a = 2 * scale * (law[0] + first * (2 * law[2] + 3 * law[3] * first))
    b = pressure * det - a * trace / 3
    for i in range(3):
        for j in range(3):
            out[i, j] = a * f[i, j] + b * g[i, j]
    return first * (law[0] + first * (law[2] + law[3] * first))


@compiled(fastmath=True)
def second_stress(c01: float, f: FloatArray, det: float, g: FloatArray, out: FloatArray) -> float:
    """Add the c01 part of the law to a first Piola-Kirchhoff stress (3, 3); returns its energy density. ``g`` is F^-T."""
    scale, trace, slopes = det ** (-4 / 3), 0.0, np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            trace += f[i, j] * f[i, j]
    second = _second_invariant(f, trace, slopes)
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
    slopes = np.empty((3, 3))
    second = _second_invariant(f, trace, slopes)
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
def _second_invariant(f: FloatArray, trace: float, slopes: FloatArray) -> float:
    """Return I2 of C, and write its derivative 2 (tr C F - F C) with respect to F into ``slopes`` (3, 3)."""
    squares = 0.0
    for j in range(3):
        for i in range(3):
            slopes[i, j] = 2 * trace * f[i, j]
        for k in range(3):
            c = f[0, k] * f[0, j] + f[1, k] * f[1, j] + f[2, k] * f[2, j]
            squares += c * c
            for i in range(3):
                slopes[i, j] -= 2 * f[i, k] * c
    return (trace * trace - squares) / 2
