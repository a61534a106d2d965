"""Rotation of the body since its tangent was computed. With it an old tangent converges nearly as well as a new one.

The skin is much stiffer than the gel, and it is stiffest in its tangential directions. When the skin rotates, its stiff directions rotate
with it. This rotation, and not the strain, makes an old tangent K inaccurate. With the rotation R of every control since then, R K R^T
approximates the tangent of the rotated body (stiffness warping; Mueller et al. 2002). This needs no new elimination: a right side is
rotated back before the solution, and the solution is rotated forward.
"""

import numpy as np
from scipy.sparse import csr_array, vstack

from twin.geometry.solid import rotations
from twin.mechanics.balance import Body
from twin.types import FloatArray


class Turns:
    """Rotations of a body's controls between two of its states.

    Parameters
    ----------
    body : Body
        The law of its elements is used only as a weight: the rotation of a control is an average over its elements, weighted by stiffness.
    """

    def __init__(self, body: Body) -> None:
        means, spreads, count = [], [], len(body.free)
        for kind in body.kinds:
            controls, gradients, weights = kind.cells
            slopes, ends = gradients.mean(axis=1), np.arange(0, 3 * controls.size + 1, controls.shape[1])
            means.append(csr_array((slopes.ravel(), np.repeat(controls, 3, axis=0).ravel(), ends), (3 * len(controls), count)))
            stiff = (kind.law[0] + kind.law[1]) * np.repeat(weights.sum(axis=1), controls.shape[1])
            spreads.append(csr_array((stiff, controls.ravel(), ends[: len(controls) + 1]), (len(controls), count)))
        self._mean, self._spread = vstack(means).tocsr(), vstack(spreads).T.tocsr()[body.free]

    def strains(self, control_mm: FloatArray) -> FloatArray:
        """Inverse of each element's mean deformation gradient, (m, 3, 3) for all elements; ``since`` takes it."""
        return np.linalg.inv(self._gradients(control_mm))

    def since(self, strains: FloatArray, control_mm: FloatArray) -> FloatArray:
        """Rotation of each free control since the state of ``strains``, (free, 3, 3)."""
        total = (self._spread @ (self._gradients(control_mm) @ strains).reshape(-1, 9)).reshape(-1, 3, 3)
        return rotations(total * np.sqrt(3 / (total**2).sum(axis=(1, 2), keepdims=True)))

    def _gradients(self, control_mm: FloatArray) -> FloatArray:
        """Mean deformation gradient of each element, (m, 3, 3)."""
        return (self._mean @ control_mm).reshape(-1, 3, 3).swapaxes(1, 2)


def turn_vectors(turns: FloatArray | None, vectors: FloatArray) -> FloatArray:
    """Vectors (3 n,) of n controls, rotated by one rotation for each control (n, 3, 3); None: as they are."""
    if turns is None:
        return vectors
    each = vectors.astype(turns.dtype, copy=False).reshape(-1, 3)  # einsum is slow for arrays of two types
    return np.einsum("nij,nj->ni", turns, each).ravel().astype(vectors.dtype, copy=False)


def turned_back(turns: FloatArray | None, vectors: FloatArray) -> FloatArray:
    """The inverse of ``turn_vectors``."""
    return turn_vectors(None if turns is None else turns.transpose(0, 2, 1), vectors)


def turned_matrix(turns: FloatArray, matrix: FloatArray) -> FloatArray:
    """R M R^T for a symmetric matrix M (3 n, 3 n), where R has the rotations (n, 3, 3) as blocks on its diagonal."""
    for _ in range(2):  # (R M)^T = M R^T by the symmetry of M
        matrix = (turns.astype(matrix.dtype) @ matrix.reshape(len(turns), 3, len(matrix))).reshape(matrix.shape).T
    return matrix
