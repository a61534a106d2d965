"""Eight-node hexahedra of a nearly incompressible Neo-Hookean rubber with mean dilatation.

Energy per element of rest volume V (Simo & Taylor 1985 mean dilatation; Bonet & Wood, "Nonlinear
Continuum Mechanics for Finite Element Analysis", for the compressible Neo-Hookean form):

    W = sum_q w_q [mu / 2 (tr F^T F - 3) - mu ln J] + V lambda / 2 (v / V - 1)^2

with F, J at 2x2x2 Gauss points and the deformed volume v = sum_q w_q J. One volume ratio per
element frees it from volumetric locking. At small strain mu and lambda are Lame's constants.
"""

from dataclasses import dataclass

import numba
import numpy as np

_CORNERS = np.array([[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)


@dataclass(frozen=True)
class ElementTable:
    """What the assembly needs of each element.

    Attributes
    ----------
    hexes : (m, 8) int
    gradients : (m, 8, 8, 3) float
        Shape function gradients (element, Gauss point, corner) in 1/mm at rest.
    weights_mm3 : (m, 8) float
        Rest volume of each Gauss point.
    mu_mpa, lame_mpa : (m,) float
    """

    hexes: np.ndarray
    gradients: np.ndarray
    weights_mm3: np.ndarray
    mu_mpa: np.ndarray
    lame_mpa: np.ndarray


def lame_constants(young_modulus_mpa: float, poisson_ratio: float) -> tuple[float, float]:
    """mu = E / 2 (1 + nu) and lambda = E nu / (1 + nu)(1 - 2 nu), in MPa."""
    mu = young_modulus_mpa / (2 * (1 + poisson_ratio))
    return mu, 2 * mu * poisson_ratio / (1 - 2 * poisson_ratio)


def element_table(nodes_mm: np.ndarray, hexes: np.ndarray, mu_mpa: np.ndarray, lame_mpa: np.ndarray) -> ElementTable:
    """Gradients and volumes at rest; ValueError if an element is inside out."""
    at = _CORNERS / np.sqrt(3)
    factors = 1 + at[:, None, :] * _CORNERS[None, :, :]
    local = (
        np.stack(
            [
                _CORNERS[:, 0] * factors[:, :, 1] * factors[:, :, 2],
                _CORNERS[:, 1] * factors[:, :, 0] * factors[:, :, 2],
                _CORNERS[:, 2] * factors[:, :, 0] * factors[:, :, 1],
            ],
            axis=2,
        )
        / 8
    )
    jacobian = np.einsum("mai,qaj->mqij", nodes_mm[hexes], local)
    weights = np.linalg.det(jacobian)
    if weights.min() <= 0:
        raise ValueError(f"{np.count_nonzero(weights.min(axis=1) <= 0)} elements are inside out at rest; check the node order")
    gradients = np.einsum("qaj,mqji->mqai", local, np.linalg.inv(jacobian))
    return ElementTable(np.ascontiguousarray(hexes), np.ascontiguousarray(gradients), weights, mu_mpa, lame_mpa)


def elastic_energy(table: ElementTable, nodes_mm: np.ndarray) -> float:
    """Elastic energy in N mm (infinite if an element is inside out)."""
    return _energy(table.hexes, table.gradients, table.weights_mm3, table.mu_mpa, table.lame_mpa, nodes_mm)


def elastic_forces(table: ElementTable, nodes_mm: np.ndarray) -> np.ndarray | None:
    """Gradient of the energy by the nodes, (n, 3) in N; None if an element is inside out."""
    out = np.zeros_like(nodes_mm)
    ok = _forces(table.hexes, table.gradients, table.weights_mm3, table.mu_mpa, table.lame_mpa, nodes_mm, out)
    return out if ok else None


def elastic_stiffness(table: ElementTable, nodes_mm: np.ndarray, out: np.ndarray) -> None:
    """Second derivative of each element's energy into ``out`` (m, 24, 24), N/mm, corner-major."""
    _stiffness(table.hexes, table.gradients, table.weights_mm3, table.mu_mpa, table.lame_mpa, nodes_mm, out)


@numba.njit(cache=True, inline="always")
def _kinematics(corners, gradients, current):
    """Current gradients F^-T grad N into ``current`` (8, 3); returns det F and tr F^T F."""
    f = np.zeros((3, 3))
    for a in range(8):
        for i in range(3):
            for j in range(3):
                f[i, j] += corners[a, i] * gradients[a, j]
    c00 = f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]
    c01 = f[1, 2] * f[2, 0] - f[1, 0] * f[2, 2]
    c02 = f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]
    c10 = f[2, 1] * f[0, 2] - f[2, 2] * f[0, 1]
    c11 = f[2, 2] * f[0, 0] - f[2, 0] * f[0, 2]
    c12 = f[2, 0] * f[0, 1] - f[2, 1] * f[0, 0]
    c20 = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
    c21 = f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]
    c22 = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
    det = f[0, 0] * c00 + f[0, 1] * c01 + f[0, 2] * c02
    trace = 0.0
    for i in range(3):
        for j in range(3):
            trace += f[i, j] * f[i, j]
    if det > 0:
        for a in range(8):
            g0, g1, g2 = gradients[a, 0] / det, gradients[a, 1] / det, gradients[a, 2] / det
            current[a, 0] = c00 * g0 + c01 * g1 + c02 * g2
            current[a, 1] = c10 * g0 + c11 * g1 + c12 * g2
            current[a, 2] = c20 * g0 + c21 * g1 + c22 * g2
    return det, trace


@numba.njit(cache=True)
def _energy(hexes, gradients, weights, mu, lame, nodes):
    total = 0.0
    current = np.zeros((8, 3))
    corners = np.zeros((8, 3))
    for m in range(len(hexes)):
        for a in range(8):
            corners[a] = nodes[hexes[m, a]]
        rest, volume = 0.0, 0.0
        for q in range(8):
            det, trace = _kinematics(corners, gradients[m, q], current)
            if det <= 0:
                return np.inf
            total += weights[m, q] * mu[m] * ((trace - 3) / 2 - np.log(det))
            rest += weights[m, q]
            volume += weights[m, q] * det
        total += rest * lame[m] / 2 * (volume / rest - 1) ** 2
    return total


@numba.njit(cache=True)
def _forces(hexes, gradients, weights, mu, lame, nodes, out):
    current = np.zeros((8, 3))
    corners = np.zeros((8, 3))
    swell = np.zeros((8, 3))
    for m in range(len(hexes)):
        for a in range(8):
            corners[a] = nodes[hexes[m, a]]
        rest, volume = 0.0, 0.0
        swell[:] = 0.0
        for q in range(8):
            det, _ = _kinematics(corners, gradients[m, q], current)
            if det <= 0:
                return False
            w = weights[m, q]
            rest += w
            volume += w * det
            # mu F grad N: F's rows applied to the rest gradient, summed corner by corner
            for i in range(3):
                f0, f1, f2 = 0.0, 0.0, 0.0
                for b in range(8):
                    f0 += corners[b, i] * gradients[m, q, b, 0]
                    f1 += corners[b, i] * gradients[m, q, b, 1]
                    f2 += corners[b, i] * gradients[m, q, b, 2]
                for a in range(8):
                    stretch = f0 * gradients[m, q, a, 0] + f1 * gradients[m, q, a, 1] + f2 * gradients[m, q, a, 2]
                    out[hexes[m, a], i] += w * mu[m] * (stretch - current[a, i])
                    swell[a, i] += w * det * current[a, i]
        pressure = lame[m] * (volume / rest - 1)
        for a in range(8):
            for i in range(3):
                out[hexes[m, a], i] += pressure * swell[a, i]
    return True


@numba.njit(cache=True)
def _stiffness(hexes, gradients, weights, mu, lame, nodes, out):
    current = np.zeros((8, 8, 3))
    det = np.zeros(8)
    corners = np.zeros((8, 3))
    swell = np.zeros(24)
    for m in range(len(hexes)):
        for a in range(8):
            corners[a] = nodes[hexes[m, a]]
        rest, volume = 0.0, 0.0
        swell[:] = 0.0
        for q in range(8):
            det[q], _ = _kinematics(corners, gradients[m, q], current[q])
            rest += weights[m, q]
            volume += weights[m, q] * det[q]
            for a in range(8):
                for i in range(3):
                    swell[3 * a + i] += weights[m, q] * det[q] * current[q, a, i]
        pressure = lame[m] * (volume / rest - 1)
        k = out[m]
        for r in range(24):
            for c in range(r + 1):
                k[r, c] = lame[m] / rest * swell[r] * swell[c]
        for q in range(8):
            w = weights[m, q]
            shear = w * mu[m]
            push = w * det[q] * pressure
            grad = gradients[m, q]
            cur = current[q]
            for a in range(8):
                for b in range(a + 1):
                    diagonal = shear * (grad[a, 0] * grad[b, 0] + grad[a, 1] * grad[b, 1] + grad[a, 2] * grad[b, 2])
                    for i in range(3):
                        k[3 * a + i, 3 * b + i] += diagonal
                        for j in range(3):
                            k[3 * a + i, 3 * b + j] += (shear - push) * cur[b, i] * cur[a, j] + push * cur[a, i] * cur[b, j]
        for r in range(24):
            for c in range(r):
                k[c, r] = k[r, c]
