"""How the body has turned since its tangent was made, so that an old tangent is worth nearly as much as a new one.

The skin is much stiffer than the gel, and stiffest along itself. As it turns, the directions in which it is stiff turn with it; that,
not strain, is what makes a tangent K old. With the rotation R of every control since then, R K R^T is the tangent of the turned body
(stiffness warping; Mueller et al. 2002). It costs no elimination: what comes in is turned back, and what goes out is turned.
"""

import numpy as np

from twin.compiled import compiled
from twin.geometry.solid import rotations
from twin.mechanics.balance import Body
from twin.types import FloatArray, IntArray


class Turns:
    """Rotations of a body's controls between two of its states.

    Parameters
    ----------
    body : Body
        Its elements' law only decides how much each counts for a control that several kinds share: by stiffness.
    """

    def __init__(self, body: Body) -> None:
        self._kinds = [
            (kind.cells.controls, kind.cells.mean_gradients, (kind.law[0] + kind.law[1]) * kind.cells.weights_mm3.sum(axis=1))
            for kind in body.kinds
        ]
        self._free = body.free

    def strains(self, control_mm: FloatArray) -> list[FloatArray]:
        """Inverse of each element's mean deformation gradient, (m, 3, 3) for each kind: what ``since`` asks for."""
        return [np.linalg.inv(_mean_gradient(controls, gradients, control_mm)) for controls, gradients, _ in self._kinds]

    def since(self, strains: list[FloatArray], control_mm: FloatArray) -> FloatArray:
        """Rotation of each free control since the state of ``strains``, (free, 3, 3)."""
        total = np.zeros((len(control_mm), 3, 3))
        for (controls, gradients, weights), old in zip(self._kinds, strains, strict=True):
            _add_turns(controls, gradients, weights, old, control_mm, total)
        total = total[self._free]
        return rotations(total * np.sqrt(3 / (total**2).sum(axis=(1, 2), keepdims=True)))


@compiled(fastmath=True)
def _mean_gradient(elements: IntArray, gradients: FloatArray, control: FloatArray) -> FloatArray:
    out = np.zeros((len(elements), 3, 3))
    for m in range(len(elements)):
        for a in range(elements.shape[1]):
            place = control[elements[m, a]]
            for i in range(3):
                for j in range(3):
                    out[m, i, j] += place[i] * gradients[m, j, a]
    return out


@compiled(fastmath=True)
def _add_turns(
    elements: IntArray, gradients: FloatArray, weights: FloatArray, old: FloatArray, control: FloatArray, out: FloatArray
) -> None:
    """Add each element's deformation since ``old``, weighted, to its controls."""
    x, f, relative = np.zeros((3, elements.shape[1])), np.zeros((3, 3)), np.zeros((3, 3))
    for m in range(len(elements)):
        for a in range(elements.shape[1]):
            for i in range(3):
                x[i, a] = control[elements[m, a], i]
        for j in range(3):
            f0, f1, f2 = 0.0, 0.0, 0.0
            for a in range(elements.shape[1]):
                slope = gradients[m, j, a]
                f0 += x[0, a] * slope
                f1 += x[1, a] * slope
                f2 += x[2, a] * slope
            f[0, j], f[1, j], f[2, j] = f0, f1, f2
        w = weights[m]
        for i in range(3):
            for j in range(3):
                relative[i, j] = w * (f[i, 0] * old[m, 0, j] + f[i, 1] * old[m, 1, j] + f[i, 2] * old[m, 2, j])
        for a in range(elements.shape[1]):
            total = out[elements[m, a]]
            for i in range(3):
                for j in range(3):
                    total[i, j] += relative[i, j]


@compiled(fastmath=True)
def turned(turns: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (3 n,) of n controls, each turned by its own rotation (n, 3, 3)."""
    out = np.empty_like(vectors)
    for n in range(len(turns)):
        r = turns[n]
        x, y, z = vectors[3 * n], vectors[3 * n + 1], vectors[3 * n + 2]
        for i in range(3):
            out[3 * n + i] = r[i, 0] * x + r[i, 1] * y + r[i, 2] * z
    return out


@compiled(fastmath=True)
def turned_back(turns: FloatArray, vectors: FloatArray) -> FloatArray:
    """The inverse of ``turned``."""
    out = np.empty_like(vectors)
    for n in range(len(turns)):
        r = turns[n]
        x, y, z = vectors[3 * n], vectors[3 * n + 1], vectors[3 * n + 2]
        for i in range(3):
            out[3 * n + i] = r[0, i] * x + r[1, i] * y + r[2, i] * z
    return out


@compiled(fastmath=True)
def turned_matrix(turns: FloatArray, matrix: FloatArray) -> FloatArray:
    """R M R^T of a symmetric matrix M (3 n, 3 n), R having the rotations (n, 3, 3) on its diagonal."""
    size = len(matrix)
    rows, out = np.empty_like(matrix), np.empty_like(matrix)
    for n in range(len(turns)):
        r = turns[n].astype(matrix.dtype)
        a, b, c = matrix[3 * n], matrix[3 * n + 1], matrix[3 * n + 2]
        for i in range(3):
            r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
            row = rows[3 * n + i]
            for k in range(size):
                row[k] = r0 * a[k] + r1 * b[k] + r2 * c[k]
    across = rows.T.copy()  # M R^T, by the symmetry of M
    for n in range(len(turns)):
        r = turns[n].astype(matrix.dtype)
        a, b, c = across[3 * n], across[3 * n + 1], across[3 * n + 2]
        for i in range(3):
            r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
            row = out[3 * n + i]
            for k in range(size):
                row[k] = r0 * a[k] + r1 * b[k] + r2 * c[k]
    return out
