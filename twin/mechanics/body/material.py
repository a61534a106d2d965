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
def first_part(law: FloatArray, first: float) -> tuple[float, float, float]:
    """Energy density of the law's terms in I1, MPa, and its first and second derivative; ``first`` is I1 - 3."""
    energy = first * (law[0] + first * (law[2] + first * law[3]))
    return energy, law[0] + first * (2 * law[2] + 3 * law[3] * first), 2 * law[2] + 6 * law[3] * first
