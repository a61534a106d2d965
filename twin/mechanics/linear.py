"""Direct solution of the assembled equations: multifrontal elimination with nested dissection.

Duff & Reid 1983 (multifrontal method), George 1973 (nested dissection of a grid). The mesh is a
square grid of columns of nodes, so the dissection is known: cut the longer side in the middle,
recurse. All arithmetic is dense LAPACK on the fronts; the order is found once per mesh.
"""

from dataclasses import dataclass

import numba
import numpy as np
from scipy.linalg import blas, lapack

_LEAF_COLUMNS = 12


class NotPositiveDefinite(Exception):
    """The symmetric matrix has a direction of no or negative stiffness."""


@dataclass
class _Front:
    own: np.ndarray  # unknowns eliminated here
    border: np.ndarray  # later unknowns they are coupled to
    elements: np.ndarray  # elements assembled here
    places: np.ndarray  # (elements, 24) rows of the front, -1 for clamped
    parent: int
    into_parent: np.ndarray  # rows of the parent's front for ``border``


class FrontalSolver:
    """Symbolic elimination of a mesh; ``factor`` then eliminates any matrix given by its elements.

    Parameters
    ----------
    hexes : (m, 8) int
    fixed : (n,) bool
    grid : (3,) int
        Layers of nodes and nodes along both sides (see ``SensorMesh``).
    """

    def __init__(self, hexes: np.ndarray, fixed: np.ndarray, grid: tuple[int, int, int]):
        per_layer = grid[1] * grid[2]
        free = ~fixed
        self.unknown = np.full((len(fixed), 3), -1)
        self.unknown[free] = np.arange(3 * np.count_nonzero(free)).reshape(-1, 3)
        self.size = 3 * int(np.count_nonzero(free))
        column_of_node = np.arange(len(fixed)) % per_layer
        free_nodes = [[] for _ in range(per_layer)]
        for node in np.flatnonzero(free):
            free_nodes[column_of_node[node]].append(node)
        used = np.array([bool(nodes) for nodes in free_nodes]).reshape(grid[1:])
        boxes = []
        _dissect(1, grid[1] - 1, 1, grid[2] - 1, boxes)
        stage = np.full(grid[1:], -1)
        for number, (rows, columns) in enumerate(boxes):
            stage[np.ix_(rows, columns)] = number
        if (stage[used] < 0).any():
            raise ValueError("free nodes on the border of the grid: the rim must be clamped")
        stage = stage.ravel()

        unknowns_of = [self.unknown[nodes].ravel() if nodes else np.zeros(0, int) for nodes in free_nodes]
        quads = column_of_node[hexes[:, [0, 1, 2, 3]]]
        stages = np.where(stage[quads] < 0, len(boxes), stage[quads])
        first = stages.min(axis=1)
        borders: list[set] = [set() for _ in boxes]
        children: list[list[int]] = [[] for _ in boxes]
        parents = np.full(len(boxes), -1)
        for number in range(len(boxes)):
            touched = set(quads[first == number].ravel().tolist())
            for child in children[number]:
                touched |= borders[child]
            borders[number] = {c for c in touched if stage[c] > number}
            if borders[number]:
                parents[number] = min(stage[c] for c in borders[number])
                children[parents[number]].append(number)

        self._fronts: list[_Front] = []
        rows_of = []
        for number in range(len(boxes)):
            own_columns = np.flatnonzero(stage == number)
            border_columns = sorted(borders[number], key=lambda c: (stage[c], c))
            own = np.concatenate([unknowns_of[c] for c in own_columns])
            border = np.concatenate([unknowns_of[c] for c in border_columns]) if border_columns else np.zeros(0, int)
            rows = np.full(self.size + 1, -1)
            rows[np.concatenate([own, border])] = np.arange(len(own) + len(border))
            rows_of.append(rows)
            elements = np.flatnonzero(first == number)
            places = rows[self.unknown[hexes[elements]]].reshape(len(elements), 24)
            self._fronts.append(_Front(own, border, elements, places, int(parents[number]), np.zeros(0, int)))
        for front in self._fronts:
            if front.parent >= 0:
                front.into_parent = rows_of[front.parent][front.border]

    def factor(self, elements: np.ndarray, *, symmetric: bool, shift: float = 0.0) -> "Factors":
        """Eliminate the matrix whose element blocks are ``elements`` (m, 24, 24), plus ``shift`` on the diagonal.

        Raises
        ------
        NotPositiveDefinite
            If ``symmetric`` and the matrix is not positive definite.
        """
        pending: list[list] = [[] for _ in self._fronts]
        blocks = []
        for number, front in enumerate(self._fronts):
            size, own = len(front.own) + len(front.border), len(front.own)
            matrix = np.zeros((size, size), order="F")
            _assemble(elements, front.elements, front.places, matrix)
            for child, update in pending[number]:
                _extend(matrix, update, child.into_parent)
            pending[number] = []
            if shift:
                matrix[np.arange(own), np.arange(own)] += shift
            head, right = matrix[:own, :own], matrix[:own, own:]
            if symmetric:
                lower, info = lapack.dpotrf(head, lower=1, clean=0)
                if info > 0:
                    raise NotPositiveDefinite
                right = blas.dtrsm(1.0, lower, right, lower=1)
                rest = blas.dsyrk(-1.0, right, beta=1.0, c=matrix[own:, own:], trans=1, lower=1) if len(front.border) else None
                blocks.append((lower, right))
                if rest is not None:
                    rest = _mirror(rest)
            else:
                below = matrix[own:, :own]
                factor, pivots, info = lapack.dgetrf(head)
                if info > 0:
                    raise NotPositiveDefinite
                right = lapack.dgetrs(factor, pivots, right)[0] if len(front.border) else right
                rest = blas.dgemm(-1.0, below, right, beta=1.0, c=matrix[own:, own:]) if len(front.border) else None
                blocks.append((factor, pivots, right, np.asfortranarray(below)))
            if front.parent >= 0:
                pending[front.parent].append((front, rest))
        return Factors(self._fronts, blocks, symmetric)


class Factors:
    """An eliminated matrix."""

    def __init__(self, fronts: list[_Front], blocks: list[tuple], symmetric: bool):
        self._fronts, self._blocks, self._symmetric = fronts, blocks, symmetric

    def solve(self, right_side: np.ndarray) -> np.ndarray:
        """Solution for right sides (unknowns,) or (unknowns, k)."""
        x = np.array(right_side, float)
        flat = x.ndim == 1
        x = x.reshape(len(x), -1)
        for front, block in zip(self._fronts, self._blocks, strict=True):
            if self._symmetric:
                part = blas.dtrsm(1.0, block[0], x[front.own], lower=1)
                x[front.border] -= block[1].T @ part
            else:
                part = lapack.dgetrs(block[0], block[1], x[front.own])[0]
                x[front.border] -= block[3] @ part
            x[front.own] = part
        for front, block in zip(reversed(self._fronts), reversed(self._blocks), strict=True):
            if self._symmetric:
                x[front.own] = blas.dtrsm(1.0, block[0], x[front.own] - block[1] @ x[front.border], lower=1, trans_a=1)
            else:
                x[front.own] -= block[2] @ x[front.border]
        return x[:, 0] if flat else x


def _dissect(row0, row1, column0, column1, boxes):
    """Append (rows, columns) of the sub-grid's pieces, children before their separator."""
    rows, columns = row1 - row0, column1 - column0
    if rows <= 0 or columns <= 0:
        return
    if rows * columns <= _LEAF_COLUMNS or max(rows, columns) < 3:
        boxes.append((range(row0, row1), range(column0, column1)))
    elif rows >= columns:
        middle = (row0 + row1) // 2
        _dissect(row0, middle, column0, column1, boxes)
        _dissect(middle + 1, row1, column0, column1, boxes)
        boxes.append((range(middle, middle + 1), range(column0, column1)))
    else:
        middle = (column0 + column1) // 2
        _dissect(row0, row1, column0, middle, boxes)
        _dissect(row0, row1, middle + 1, column1, boxes)
        boxes.append((range(row0, row1), range(middle, middle + 1)))


@numba.njit(cache=True)
def _assemble(elements, which, places, matrix):
    for k in range(len(which)):
        block = elements[which[k]]
        for c in range(24):
            column = places[k, c]
            if column >= 0:
                for r in range(24):
                    row = places[k, r]
                    if row >= 0:
                        matrix[row, column] += block[r, c]


@numba.njit(cache=True)
def _extend(matrix, update, places):
    for c in range(len(places)):
        for r in range(len(places)):
            matrix[places[r], places[c]] += update[r, c]


@numba.njit(cache=True)
def _mirror(lower):
    for c in range(len(lower)):
        for r in range(c):
            lower[r, c] = lower[c, r]
    return lower
