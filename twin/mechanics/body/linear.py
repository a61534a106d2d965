"""Direct solution of the assembled equations: multifrontal elimination with nested dissection.

Sources: Duff & Reid 1983 (multifrontal method), George 1973 (nested dissection of a grid). The elements form a square grid, so the
dissection is simple: the longer side of a box is cut in the middle, and each half is cut in the same way. A control is eliminated in the
smallest box that contains all of its elements. All arithmetic on the fronts is dense LAPACK. The order of the elimination is computed once
for each set of kept unknowns. The kept unknowns are not eliminated; a dense matrix remains for them (static condensation; Guyan 1965). The
contact changes from iteration to iteration, and it is cheap to solve on this matrix.
"""

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.linalg import blas, lapack

from twin.compiled import compiled
from twin.mechanics.body.elements import PAIRS
from twin.types import BoolArray, FloatArray, IntArray

Box: TypeAlias = tuple[int, int, int, int]  # first row, last row + 1, first column, last column + 1

_LEAF_ELEMENTS = 36
"""Largest number of elements in a box that is not cut further."""
_I = np.array([i for i, _ in PAIRS])
_K = np.array([k for _, k in PAIRS])


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
    children : list of (front, runs)
        Fronts whose ``rest`` is added to this front, and the runs of their borders in it (see ``_runs``).
    head : (o, o) float
        Fortran order, lower triangle; its Cholesky factor overwrites it.
    below : (r, o) float
        Coupling of border and own unknowns.
    rest : (r, r) float
        Matrix that remains for the border. Other fronts use its memory before and after (see ``_make_room``).
    """

    own: IntArray
    border: IntArray
    controls_left: IntArray
    assembled: list[tuple[IntArray, IntArray]]
    children: list[tuple["_Front", IntArray]]
    head: FloatArray
    below: FloatArray
    rest: FloatArray = field(default_factory=lambda: np.zeros((0, 0), np.float32))


class FrontalSolver:
    """Symbolic elimination of a body; ``eliminate`` then works on any matrix given by its elements.

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
                assembled=[
                    (
                        which,
                        np.ascontiguousarray(rows[self.unknown[controls]].transpose(0, 2, 1).reshape(len(which), 3 * controls.shape[1])),
                    )
                    for which, controls in assembled
                ],
                children=[(self._fronts[c], _runs(rows[self._fronts[c].border], 3 * len(own))) for c in children],
                head=np.zeros((3 * len(own), 3 * len(own)), np.float32, order="F"),
                below=np.zeros((3 * len(left), 3 * len(own)), np.float32, order="F"),
            )
            self._fronts.append(front)
        self._make_room([children for _, children in tree])
        self.kept = self._fronts[-1].border

    def eliminate(self, blocks: list[FloatArray], *, shift: float = 0.0) -> "Eliminated":
        """Eliminate all unknowns except the kept ones. The result is valid until the next call.

        Parameters
        ----------
        blocks : list of (m, 6, b, b) float
            Symmetric blocks of each kind of element, in the order of ``Elements.stiffness``.
        shift : float
            Value added to the diagonal of the eliminated unknowns.

        Raises
        ------
        NotPositiveDefinite
        """
        for front in self._fronts:
            front.head[:] = 0.0
            front.below[:] = 0.0
            front.rest[:] = 0.0
            for block, (which, places) in zip(blocks, front.assembled, strict=True):
                if len(which):
                    _assemble(block, which, places, front.head, front.below, front.rest)
            for child, runs in front.children:
                _extend(child.rest.T, runs, front.head.T, front.below.T, front.rest.T)
            if not len(front.own):
                continue
            if shift:
                front.head[np.arange(len(front.own)), np.arange(len(front.own))] += shift
            _, info = lapack.spotrf(front.head, lower=1, clean=0, overwrite_a=1)
            if info > 0:
                raise NotPositiveDefinite
            if len(front.border):
                blas.strsm(1.0, front.head, front.below, side=1, lower=1, trans_a=1, overwrite_b=1)
                blas.ssyrk(-1.0, front.below, beta=1.0, c=front.rest, lower=1, overwrite_c=1)
        return Eliminated(self._fronts, self.kept)

    def _make_room(self, children: list[list[int]]) -> None:
        """Assign memory to the ``rest`` of every front. A rest is needed only until its parent has added it, so fronts share memory."""
        room: list[int] = []
        sizes: list[int] = []
        unused: list[int] = []
        for front, before in zip(self._fronts, children, strict=True):
            if not unused:
                unused.append(len(sizes))
                sizes.append(0)
            room.append(unused.pop())
            sizes[room[-1]] = max(sizes[room[-1]], len(front.border) ** 2)
            unused += [room[child] for child in before]
        rooms = [np.empty(size, np.float32) for size in sizes]
        for front, number in zip(self._fronts, room, strict=True):
            size = len(front.border)
            front.rest = rooms[number][: size * size].reshape(size, size, order="F")


class Eliminated:
    """A matrix after the elimination of all unknowns except the kept ones.

    Attributes
    ----------
    kept : (k,) int
        The kept unknowns.
    matrix : (k, k) float
        Remaining matrix of the kept unknowns (Schur complement); lower triangle.
    """

    def __init__(self, fronts: list[_Front], kept: IntArray) -> None:
        self._fronts = [front for front in fronts if len(front.own)]
        self.kept, self.matrix = kept, fronts[-1].rest

    def inner(self, values: FloatArray) -> FloatArray:
        """The part of values (unknowns,) at the eliminated unknowns."""
        return np.delete(values, self.kept)

    def forward(self, right_side: FloatArray) -> FloatArray:
        """Forward elimination of a right side (unknowns,). Its entries at ``kept`` are then the right side for ``matrix``."""
        x = np.array(right_side, np.float32)
        for front in self._fronts:
            part = lapack.strtrs(front.head, x[front.own], lower=1)[0]
            x[front.border] -= front.below @ part
            x[front.own] = part
        return x

    def backward(self, eliminated: FloatArray, kept_values: FloatArray) -> FloatArray:
        """Backward substitution: the whole solution (unknowns,) from the result of ``forward`` and the solution at ``kept``."""
        x = eliminated.astype(np.float32)
        x[self.kept] = kept_values
        for front in reversed(self._fronts):
            x[front.own] = lapack.strtrs(front.head, x[front.own] - front.below.T @ x[front.border], lower=1, trans=1)[0]
        return x


def _dissect(box: Box, tree: list[tuple[Box, list[int]]]) -> int:
    """Append a box and the boxes it is cut into to ``tree``, as (box, children), children before their parent; returns the box's index."""
    row0, row1, column0, column1 = box
    children = []
    if (row1 - row0) * (column1 - column0) > _LEAF_ELEMENTS:
        if row1 - row0 >= column1 - column0:
            middle = row0 + (row1 - row0) // 4 * 2
            halves = (row0, middle, column0, column1), (middle, row1, column0, column1)
        else:
            middle = column0 + (column1 - column0) // 4 * 2
            halves = (row0, row1, column0, middle), (row0, row1, middle, column1)
        children = [_dissect(half, tree) for half in halves]
    tree.append((box, children))
    return len(tree) - 1


def _inside(boxes: IntArray, box: Box) -> BoolArray:
    return (boxes[:, 0] >= box[0]) & (boxes[:, 1] <= box[1]) & (boxes[:, 2] >= box[2]) & (boxes[:, 3] <= box[3])


@compiled()
def whole(lower: FloatArray, shift: float) -> FloatArray:
    """The symmetric matrix of a lower triangle, with a shift added to the diagonal."""
    out = np.empty_like(lower)
    for c in range(len(lower)):
        out[c, c] = lower[c, c] + shift
        for r in range(c + 1, len(lower)):
            out[r, c] = out[c, r] = lower[r, c]
    return out


@compiled()
def split_matrix(matrix: FloatArray, far: IntArray, near: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parts of a symmetric matrix: (f, f) of the unknowns ``far``, (n, f) of ``near`` and ``far``, and (n, n) of ``near``."""
    f, n = len(far), len(near)
    within, across, rest = np.empty((f, f), matrix.dtype), np.empty((n, f), matrix.dtype), np.empty((n, n), matrix.dtype)
    for i in range(f):
        row = matrix[far[i]]
        for j in range(f):
            within[i, j] = row[far[j]]
    for i in range(n):
        row = matrix[near[i]]
        for j in range(f):
            across[i, j] = row[far[j]]
        for j in range(n):
            rest[i, j] = row[near[j]]
    return within, across, rest


def _runs(places: IntArray, own: int) -> IntArray:
    """Runs (k, 3) of consecutive ``places``: index of the first, its place, and the length. A run does not cross the place ``own``."""
    first = np.flatnonzero(np.diff(places, prepend=-2) != 1)
    first = np.union1d(first, np.searchsorted(places, own))
    first = first[first < len(places)]
    return np.column_stack([first, places[first], np.diff(first, append=len(places))])


@compiled()
def _assemble(elements: FloatArray, which: IntArray, places: IntArray, head: FloatArray, below: FloatArray, rest: FloatArray) -> None:
    """Add the symmetric blocks of elements to the lower triangle of a front."""
    own, count = len(head), elements.shape[2]
    for e in range(len(which)):
        block = elements[which[e]]
        place = places[e]
        for p in range(6):
            i, k = _I[p], _K[p]
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
def _extend(update: FloatArray, runs: IntArray, head: FloatArray, below: FloatArray, rest: FloatArray) -> None:
    """Add the ``rest`` (border, border) of an earlier front to a front. All arrays are transposed, so that columns are contiguous."""
    own = len(head)
    for j in range(len(runs)):
        for shift in range(runs[j, 2]):
            source, low = update[runs[j, 0] + shift], runs[j, 1] + shift
            for k in range(j, len(runs)):
                skip = shift if k == j else 0
                row, place, count = runs[k, 0] + skip, runs[k, 1] + skip, runs[k, 2] - skip
                if place < own:
                    _add(source[row : row + count], head[low, place : place + count])
                elif low < own:
                    _add(source[row : row + count], below[low, place - own : place - own + count])
                else:
                    _add(source[row : row + count], rest[low - own, place - own : place - own + count])


@compiled()
def _add(values: FloatArray, out: FloatArray) -> None:
    for k in range(len(values)):
        out[k] += values[k]
