"""Direct solution of the assembled equations: multifrontal elimination with nested dissection.

Sources: Duff & Reid 1983 (multifrontal method), George 1973 (nested dissection of a grid). The elements form a square grid, so the
dissection is simple: the longer side of a box is cut in the middle, and each half is cut in the same way. A control is eliminated in the
smallest box that contains all of its elements. All arithmetic on the fronts is dense LAPACK. The order of the elimination is computed once
for each set of kept unknowns. The kept unknowns are not eliminated; a dense matrix remains for them (static condensation; Guyan 1965). The
contact changes from iteration to iteration, and it is cheap to solve on this matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import blas, lapack

from twin.compiled import compiled
from twin.mechanics.body.elements import FIRST, SECOND
from twin.types import BoolArray, FloatArray, IntArray

Box: TypeAlias = Sequence[int]  # first row, last row + 1, first column, last column + 1

_LEAF_ELEMENTS = 36
"""Largest number of elements in a box that is not cut further."""


class NotPositiveDefinite(Exception):
    """The symmetric matrix is not positive definite: in some direction the stiffness is zero or negative."""


@dataclass
class _Front:
    """A front: the dense matrix of one box in the elimination.

    Attributes
    ----------
    own : (o,) int
        Unknowns that are eliminated here.
    border : (r,) int
        Unknowns that are coupled to ``own`` and eliminated later.
    controls_left : (r / 3,) int
        Controls of the border.
    assembled : list of (which, rows)
        For each kind of element: the elements (e,) that are assembled here, and the rows (e, 3 b) of their unknowns in this front,
        direction by direction; -1 where a control is clamped.
    children : list of (number, places)
        Fronts whose remaining matrix is added to this front, and the places (r,) of their borders in it, in rising order.
    head : (o, o) float
        Fortran order, lower triangle; its Cholesky factor overwrites it.
    below : (r, o) float
        Coupling of border and own unknowns.
    """

    own: IntArray
    border: IntArray
    controls_left: IntArray
    assembled: list[tuple[IntArray, IntArray]]
    children: list[tuple[int, IntArray]]
    head: FloatArray
    below: FloatArray


class FrontalSolver:
    """Elimination of all unknowns of a body except the kept ones, for any matrix given by its elements.

    Parameters
    ----------
    groups : list of (m, b) int
        Controls of each element of each kind.
    boxes : list of (m, 4) int
        Place of each element: rows and columns of the grid (first, last + 1).
    fixed : (n,) bool
        Clamped controls.
    keep : (n,) bool
        Controls that are not eliminated.

    Attributes
    ----------
    kept, inner : (k,), (i,) int
        The kept unknowns and the eliminated ones.
    """

    def __init__(self, groups: list[IntArray], boxes: list[IntArray], fixed: BoolArray, keep: BoolArray) -> None:
        free = ~fixed
        self.unknown = np.full((len(fixed), 3), -1)
        self.unknown[free] = np.arange(3 * np.count_nonzero(free)).reshape(-1, 3)
        self.size = 3 * int(np.count_nonzero(free))
        support = np.tile([1 << 30, 0, 1 << 30, 0], (len(fixed), 1))
        for controls, lying in zip(groups, boxes, strict=True):
            for column, better in enumerate((np.minimum, np.maximum, np.minimum, np.maximum)):
                better.at(support[:, column], controls, lying[:, column, None])
        side = int(max(lying[:, 1].max() for lying in boxes if len(lying)))
        tree: list[tuple[Box, list[int]]] = []
        _dissect((0, side, 0, side), tree)
        stage = np.full(len(fixed), len(tree))  # number of the box in which a control is eliminated: the smallest box around its support
        for number, (box, _) in enumerate(tree):
            stage[_inside(support, box) & free & ~keep & (stage == len(tree))] = number

        self._fronts: list[_Front] = []
        for number, (box, children) in enumerate(tree):
            assembled, parts = [], [self._fronts[c].controls_left for c in children]
            for controls, where in zip(groups, boxes, strict=True):
                which = np.flatnonzero(_inside(where, box)) if not children else np.zeros(0, int)
                assembled.append((which, controls[which]))
                parts.append(controls[which].ravel())
            touched = np.unique(np.concatenate(parts))
            touched = touched[free[touched]]
            order = np.lexsort((touched, stage[touched]))
            own, left = np.split(touched[order], [np.count_nonzero(stage[touched] == number)])
            rows = np.full(self.size + 1, -1)
            unknowns = self.unknown[np.concatenate([own, left])].ravel()
            rows[unknowns] = np.arange(len(unknowns))
            front = _Front(
                own=self.unknown[own].ravel(),
                border=self.unknown[left].ravel(),
                controls_left=left,
                assembled=[(w, rows[self.unknown[c]].transpose(0, 2, 1).reshape(len(w), 3 * c.shape[1])) for w, c in assembled],
                children=[(c, rows[self._fronts[c].border]) for c in children],
                head=np.zeros((3 * len(own), 3 * len(own)), np.float32, order="F"),
                below=np.zeros((3 * len(left), 3 * len(own)), np.float32, order="F"),
            )
            self._fronts.append(front)
        self.kept, self._eliminating = self._fronts[-1].border, [front for front in self._fronts if len(front.own)]
        self.inner = np.setdiff1d(np.arange(self.size), self.kept)

    def eliminate(self, blocks: list[FloatArray], *, shift: float = 0.0) -> FloatArray:
        """Eliminate all unknowns except the kept ones, until the next call.

        Parameters
        ----------
        blocks : list of (m, 6, b, b) float
            Symmetric blocks of each kind of element, in the order of ``Elements.stiffness``.
        shift : float
            Value added to the diagonal of the eliminated unknowns.

        Returns
        -------
        (k, k) float
            Remaining matrix of the kept unknowns (Schur complement): the lower triangle, and zeros.

        Raises
        ------
        NotPositiveDefinite
        """
        rests: dict[int, FloatArray] = {}
        for number, front in enumerate(self._fronts):
            front.head[:] = 0.0
            front.below[:] = 0.0
            rest = rests[number] = np.zeros((len(front.border), len(front.border)), np.float32, order="F")
            for block, (which, places) in zip(blocks, front.assembled, strict=True):
                if len(which):
                    _assemble(block, which, places, front.head, front.below, rest)
            for child, places in front.children:
                _extend(rests.pop(child).T, places, np.searchsorted(places, len(front.head)), front.head.T, front.below.T, rest.T)
            if not len(front.own):
                continue
            if shift:
                front.head[np.arange(len(front.own)), np.arange(len(front.own))] += shift
            _, info = lapack.spotrf(front.head, lower=1, clean=0, overwrite_a=1)
            if info > 0:
                raise NotPositiveDefinite
            if len(front.border):
                blas.strsm(1.0, front.head, front.below, side=1, lower=1, trans_a=1, overwrite_b=1)
                blas.ssyrk(-1.0, front.below, beta=1.0, c=rest, lower=1, overwrite_c=1)
        return rest

    def forward(self, right_side: FloatArray) -> FloatArray:
        """Forward elimination of a right side (unknowns,). Its entries at ``kept`` are then the right side for the remaining matrix."""
        x = np.array(right_side, np.float32)
        for front in self._eliminating:
            part = lapack.strtrs(front.head, x[front.own], lower=1)[0]
            x[front.border] -= front.below @ part
            x[front.own] = part
        return x

    def backward(self, eliminated: FloatArray, kept_values: FloatArray) -> FloatArray:
        """Backward substitution: the whole solution (unknowns,) from the result of ``forward`` and the solution at ``kept``."""
        x = eliminated.astype(np.float32)
        x[self.kept] = kept_values
        for front in reversed(self._eliminating):
            x[front.own] = lapack.strtrs(front.head, x[front.own] - front.below.T @ x[front.border], lower=1, trans=1)[0]
        return x


def _dissect(box: Box, tree: list[tuple[Box, list[int]]]) -> int:
    """Append a box and the boxes it is cut into to ``tree``, as (box, children), children before their parent; returns the box's index."""
    row0, row1, column0, column1 = box
    children = []
    if (row1 - row0) * (column1 - column0) > _LEAF_ELEMENTS:
        side = 0 if row1 - row0 >= column1 - column0 else 2  # the longer one begins and ends at these places of the box
        first, second = [*box], [*box]
        first[side + 1] = second[side] = box[side] + (box[side + 1] - box[side]) // 4 * 2
        children = [_dissect(half, tree) for half in (first, second)]
    tree.append((box, children))
    return len(tree) - 1


def _inside(boxes: IntArray, box: Box) -> BoolArray:
    return (boxes[:, 0] >= box[0]) & (boxes[:, 1] <= box[1]) & (boxes[:, 2] >= box[2]) & (boxes[:, 3] <= box[3])


@compiled()
def _assemble(elements: FloatArray, which: IntArray, places: IntArray, head: FloatArray, below: FloatArray, rest: FloatArray) -> None:
    """Add the symmetric blocks of elements to the lower triangle of a front."""
    own, count = len(head), elements.shape[2]
    for e in range(len(which)):
        block = elements[which[e]]
        place = places[e]
        for p in range(6):
            i, k = FIRST[p], SECOND[p]
            for a in range(count):
                r = place[count * i + a]
                if r < 0:
                    continue
                for b in range(count if i != k else a + 1):
                    c = place[count * k + b]
                    if c < 0:
                        continue
                    low, high = min(r, c), max(r, c)
                    if low >= own:
                        rest[high - own, low - own] += block[p, a, b]
                    elif high >= own:
                        below[high - own, low] += block[p, a, b]
                    else:
                        head[high, low] += block[p, a, b]


@compiled()
def _extend(update: FloatArray, places: IntArray, inside: int, head: FloatArray, below: FloatArray, rest: FloatArray) -> None:
    """Add the remaining matrix (r, r) of an earlier front to a front, of which ``inside`` places are in the head.

    All arrays are transposed, so that columns are contiguous.
    """
    own = len(head)
    for j in range(len(places)):
        low = places[j]
        for k in range(j, inside):
            head[low, places[k]] += update[j, k]
        into, column = (below, low) if low < own else (rest, low - own)
        for k in range(max(j, inside), len(places)):
            into[column, places[k] - own] += update[j, k]
