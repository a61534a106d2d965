"""Rotation of the body since its tangent was computed. With it an old tangent converges nearly as well as a new one.

The skin is much stiffer than the gel, and it is stiffest in its tangential directions. When the skin rotates, its stiff directions rotate
with it. This rotation, and not the strain, makes an old tangent K inaccurate. With the rotation R of every control since then, R K R^T
approximates the tangent of the rotated body (stiffness warping; Mueller et al. 2002). This needs no new elimination: a right side is
rotated back before the solution, and the solution is rotated forward.
"""

import numpy as np

from twin.compiled import compiled
from twin.geometry.solid import rotations
from twin.mechanics.balance import Body
from twin.mechanics.body.elements import deformation, gather
from twin.types import FloatArray, IntArray


class Turns:
    """Rotations of a body's controls between two of its states.

    Parameters
    ----------
    body : Body
        The law of its elements is used only as a weight: the rotation of a control is an average over its elements, weighted by stiffness.
    """

    def __init__(self, body: Body) -> None:
        self._kinds = [
            (kind.cells.controls, kind.cells.gradients.mean(axis=1), (kind.law[0] + kind.law[1]) * kind.cells.weights_mm3.sum(axis=1))
            for kind in body.kinds
        ]
        self._free = body.free

    def strains(self, control_mm: FloatArray) -> list[FloatArray]:
        """Inverse of each element's mean deformation gradient, (m, 3, 3) for each kind of elements; ``since`` takes it."""
        return [np.linalg.inv(_mean_gradient(controls, gradients, control_mm)) for controls, gradients, _ in self._kinds]

    def since(self, strains: list[FloatArray], control_mm: FloatArray) -> FloatArray:
        """Rotation of each free control since the state of ``strains``, (free, 3, 3)."""
        total = np.zeros((len(control_mm), 3, 3))
        for (controls, gradients, weights), old in zip(self._kinds, strains, strict=True):
            _add_to_controls(controls, weights[:, None, None] * (_mean_gradient(controls, gradients, control_mm) @ old), total)
        total = total[self._free]
        return rotations(total * np.sqrt(3 / (total**2).sum(axis=(1, 2), keepdims=True)))


@compiled(fastmath=True)
def _mean_gradient(elements: IntArray, gradients: FloatArray, control: FloatArray) -> FloatArray:
    """Mean deformation gradient of each element, (m, 3, 3)."""
    out = np.empty((len(elements), 3, 3))
    x = np.empty((3, elements.shape[1]))
    for m in range(len(elements)):
        gather(control, elements[m], x)
        deformation(x, gradients[m], out[m])
    return out


@compiled(fastmath=True)
def _add_to_controls(elements: IntArray, values: FloatArray, out: FloatArray) -> None:
    """Add each element's matrix (m, 3, 3) to all of its controls."""
    for m in range(len(elements)):
        for a in range(elements.shape[1]):
            total = out[elements[m, a]]
            for i in range(3):
                for j in range(3):
                    total[i, j] += values[m, i, j]


@compiled(fastmath=True)
def turn_vectors(turns: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (3 n,) of n controls, rotated by one rotation for each control (n, 3, 3)."""
    out = np.empty_like(vectors)
    for n in range(len(turns)):
        r = turns[n]
        x, y, z = vectors[3 * n], vectors[3 * n + 1], vectors[3 * n + 2]
        for i in range(3):
            out[3 * n + i] = r[i, 0] * x + r[i, 1] * y + r[i, 2] * z
    return out


def turned_back(turns: FloatArray, vectors: FloatArray) -> FloatArray:
    """The inverse of ``turn_vectors``."""
    return turn_vectors(turns.transpose(0, 2, 1), vectors)


def turned_matrix(turns: FloatArray, matrix: FloatArray) -> FloatArray:
    """R M R^T for a symmetric matrix M (3 n, 3 n), where R has the rotations (n, 3, 3) as blocks on its diagonal."""
    turns = turns.astype(matrix.dtype)
    return _turned_rows(turns, _turned_rows(turns, matrix).T.copy())  # (R M)^T = M R^T by the symmetry of M


@compiled(fastmath=True)
def _turned_rows(turns: FloatArray, matrix: FloatArray) -> FloatArray:
    """R M (see ``turned_matrix``)."""
    out = np.empty_like(matrix)
    for n in range(len(turns)):
        a, b, c = matrix[3 * n], matrix[3 * n + 1], matrix[3 * n + 2]
        for i in range(3):
            r0, r1, r2 = turns[n, i, 0], turns[n, i, 1], turns[n, i, 2]
            row = out[3 * n + i]
            for k in range(len(matrix)):
                row[k] = r0 * a[k] + r1 * b[k] + r2 * c[k]
    return out
