"""Contact problem on the condensed body: a small dense system, solved by Newton's method."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import blas, lapack

from twin.compiled import compiled
from twin.mechanics.balance import FORCE_FLOOR_N, Balance, Problem
from twin.mechanics.body.linear import Eliminated, split_matrix
from twin.mechanics.contact import ContactForces, positions, spread_forces, spread_stiffness
from twin.mechanics.turns import turn_vectors, turned_back, turned_matrix
from twin.types import FloatArray, IntArray

_ITERATIONS = 60
"""Largest number of Newton iterations on the small problem."""
_HASTY_ITERATIONS = 15
"""Largest number of Newton iterations of the first attempt. If it does not converge, softened contact is solved first."""
LARGEST_MOVE_MM = 1.5
"""Largest displacement of a control in one iteration (mm)."""
_HALVINGS = 5
"""Largest number of times that the line search halves a step."""
_LEAST_GAIN = 0.1
"""The line search accepts a step of size s that reduces the residual's norm by at least this factor times s, relative to the norm."""
_KEEP_FACTORS = 0.2
"""The factors of an earlier matrix are used again as long as a step with them reduces the residual to this share or less."""
_SOFTENING = 0.1
"""Factor on the contact stiffness in the softened problem, which gives the start for the true one."""
_INEXACT = 0.01
"""The inner iteration ends when its residual is this share of the whole problem's residual. A smaller one does not help the outer
iteration."""


@dataclass(frozen=True)
class Tangent:
    """The body's tangent stiffness, condensed to the kept unknowns.

    Attributes
    ----------
    eliminated : Eliminated
    matrix : (k, k) float
        Condensed matrix of the kept unknowns.
    volume_column : (unknowns,) float, optional
        Column of the sealed gel's pressure, which is one more unknown, after elimination. None for a gel that is not sealed.
    volume_pivot : float
        Diagonal entry of that pressure after elimination.
    strains : list of float arrays
        State at which the tangent was computed (see ``Turns.strains``).
    """

    eliminated: Eliminated
    matrix: FloatArray  # (k, k), symmetric
    volume_column: FloatArray | None
    volume_pivot: float
    strains: list[FloatArray]


@dataclass
class Near:
    """The tangent, condensed further to the controls that carry the candidate points.

    Kept controls that carry a candidate point are "near", the other ones are "far" and are eliminated here. The far part of the tangent
    is L L^T. All arrays are in single precision.

    Attributes
    ----------
    near, far : (n,), (f,) int
        Near and far ones among the kept unknowns.
    local : (q, 9) int
        Index of each point's controls among the near controls; the number of near controls where a control is not among them.
    matrix : (n, n) float
        Condensed tangent of the near unknowns, symmetric, rotated by ``turns``.
    column : (n,) float
        Condensed volume column, rotated by ``turns``.
    factor : (f, f) float
        L, Fortran order, lower triangle.
    coupling, far_column : (f, n), (f,) float
        L^-1 applied to the coupling of far and near unknowns, and to the far part of the volume column.
    turns : (n / 3, 3, 3) float, optional
        Rotations of the near controls since the tangent was computed. The arrays of the far part, and the residual given to
        ``SmallContact``, are not rotated.
    solved : tuple
        Softening of the contact, and the factors and pivots of the last matrix (n + 2, n + 2) of Newton's method.
    """

    near: IntArray
    far: IntArray
    local: IntArray
    matrix: FloatArray
    column: FloatArray
    factor: FloatArray
    coupling: FloatArray
    far_column: FloatArray
    turns: FloatArray | None = None
    solved: tuple[float, FloatArray, IntArray] | None = None

    @classmethod
    def of(cls, tangent: Tangent, local: IntArray) -> "Near":
        matrix, count = tangent.matrix, len(tangent.matrix)
        stays = np.zeros(count // 3 + 1, bool)
        stays[local] = True
        stays = np.repeat(stays[:-1], 3)
        far = np.flatnonzero(~stays)
        near = np.flatnonzero(stays)
        within, across, rest = split_matrix(matrix, far, near)
        factor, info = lapack.spotrf(within.T, lower=1, clean=0, overwrite_a=1) if len(far) else (np.zeros((0, 0)), 0)
        if info > 0:  # without contact some far controls have no stiffness: eliminate none
            near, far, factor, rest = np.arange(count), far[:0], np.zeros((0, 0)), matrix
        controls = near[::3] // 3
        renumber = np.full(count // 3 + 1, len(controls))
        renumber[controls] = np.arange(len(controls))
        column = np.zeros(count, np.float32) if tangent.volume_column is None else tangent.volume_column[tangent.eliminated.kept]
        column, far_column = column[near], column[far]
        coupling = np.zeros((0, len(near)), np.float32)
        if len(far):
            coupling = blas.strsm(1.0, factor, across.T, lower=1, overwrite_b=1)
            far_column = lapack.strtrs(factor, far_column, lower=1)[0]
            rest = rest - coupling.T @ coupling
            column = column - coupling.T @ far_column
        return cls(near, far, renumber[local], rest, column, factor, coupling, far_column)

    def turn(self, turns: FloatArray) -> "Near":
        """The same for a body whose kept controls have rotated by ``turns`` (k / 3, 3, 3) since the tangent was computed."""
        turns = turns[self.near[::3] // 3]
        return replace(self, matrix=turned_matrix(turns, self.matrix), column=turn_vectors(turns, self.column), turns=turns)


class SmallContact:
    """Contact problem on the condensed body.

    The unknowns are the displacements dz of the near controls, the change dw of the object's displacement w along z, and the change dp of
    the gel's pressure:

    S dz + v dp + r = contact forces,   (w + dw) / c + sum f_z = 0,   k (v . dz + q dp + g) = 0

    S is the condensed tangent, v and q are the volume column and its diagonal entry, r and g the residuals, c the compliance. k converts a
    volume into a force (``Body.volume_force_n_per_mm3``), so that all residuals are in N and have one norm.
    """

    def __init__(self, problem: Problem, near: Near, pivot: float, residual: FloatArray, volume_residual: float, balance: Balance) -> None:
        self._problem, self._border, self._near = problem, balance.border, near
        self.iterations = 0
        self._at = positions(problem.controls, problem.weights, problem.lift, balance.control_mm)
        self._far_residual = lapack.strtrs(near.factor, residual[near.far], lower=1)[0] if len(near.far) else residual[near.far]
        self._r = residual[near.near] - near.coupling.T @ self._far_residual
        if near.turns is not None:
            self._r = turn_vectors(near.turns, self._r)
        self._v = near.column
        self._g = volume_residual - near.far_column @ self._far_residual
        self._q = pivot - near.far_column @ near.far_column

    def solve(self, balance: Balance, *, soften: bool, least: float) -> tuple[FloatArray, FloatArray]:
        """Displacements of all kept unknowns (k,), rotated back to the state of the tangent, and changes of the border unknowns (2,).

        ``soften``: solve softened contact first, and start the true problem from its solution.
        ``least`` is the smallest residual, relative to the contact forces, that is required.
        """
        wanted = max(_INEXACT * (FORCE_FLOOR_N if soften else balance.absolute), least * balance.scale_n)
        start = np.zeros(len(self._near.near) + 2)
        y, done = (start, False) if soften else self._newton(start, 1.0, wanted, _HASTY_ITERATIONS)
        if not done:
            y, _ = self._newton(start, _SOFTENING, wanted, _ITERATIONS)
            y, _ = self._newton(y, 1.0, wanted, _ITERATIONS)
        near = self._near
        out = np.zeros(len(near.near) + len(near.far))
        moved = y[:-2] if near.turns is None else turned_back(near.turns, y[:-2])
        out[near.near] = moved
        if len(near.far):
            right = self._far_residual + near.far_column * y[-1] + near.coupling @ moved.astype(np.float32)
            out[near.far] = -lapack.strtrs(near.factor, right, lower=1, trans=1)[0]
        return out, y[-2:]

    def newton(self, y: FloatArray, wanted: float, most: int) -> tuple[FloatArray, bool]:
        """Solve from a start (n + 2,), in at most ``most`` iterations.

        Returns the displacements of the near controls and the border, and whether the residual (N) is at most ``wanted``.
        """
        return self._newton(y, 1.0, wanted, most)

    def contact(self, y: FloatArray) -> ContactForces:
        """Contact forces after displacements ``y`` (n + 2,)."""
        return self._problem.contact(self.places(y))

    def places(self, y: FloatArray) -> FloatArray:
        """Candidate points (q, 3) after displacements ``y`` (n + 2,), in the object's frame."""
        return _move_points(self._near.local, self._problem.weights, self._at, y, self._problem.T, self._border[0] + y[-2])

    def _newton(self, y: FloatArray, soften: float, wanted: float, most: int) -> tuple[FloatArray, bool]:
        residual, contact = self._equations(y, soften)
        norm = float(np.linalg.norm(residual))
        for _ in range(most):
            if norm <= wanted:
                return y, True
            self.iterations += 1
            # the earlier factors are nearly right as long as the same points touch and stick
            if self._near.solved and self._near.solved[0] == soften:
                trial_y = y - self._solve(residual)
                trial, trial_contact = self._equations(trial_y, soften)
                trial_norm = float(np.linalg.norm(trial))
                if trial_norm < max(_KEEP_FACTORS * norm, wanted):
                    y, residual, contact, norm = trial_y, trial, trial_contact, trial_norm
                    continue
            self._factorise(contact, soften)
            move = -self._solve(residual)
            size = min(1.0, LARGEST_MOVE_MM / max(np.abs(move[:-2]).max(initial=0.0), 1e-300))
            trial, trial_contact = self._equations(y + size * move, soften)
            best = latest = float(np.linalg.norm(trial)), size, trial, trial_contact
            for _ in range(_HALVINGS):
                if latest[0] < (1 - _LEAST_GAIN * size) * norm:
                    break
                size /= 2
                trial, trial_contact = self._equations(y + size * move, soften)
                latest = float(np.linalg.norm(trial)), size, trial, trial_contact
                if latest[0] < best[0]:
                    best = latest
            norm, size, residual, contact = best
            y = y + size * move
        return y, False

    def _equations(self, y: FloatArray, soften: float) -> tuple[FloatArray, ContactForces]:
        problem, near = self._problem, self._near
        border = self._border + y[-2:]
        at = _move_points(near.local, problem.weights, self._at, y, problem.T, border[0])
        contact = problem.contact(at, soften)
        out = np.zeros(len(y))
        force_z = _residual(near.matrix, y, self._r, self._v, near.local, problem.weights, contact.force_n, problem.T, out)
        if problem.compliance:
            out[-2] = border[0] / problem.compliance + force_z
        if problem.body.sealed:
            out[-1] = problem.volume_force_n_per_mm3 * (self._g + self._v @ y[:-2] + self._q * y[-1])
        return out, contact

    def _factorise(self, contact: ContactForces, soften: float) -> None:
        """Factorise the matrix of Newton's method, in single precision: that halves the cost and does not harm the convergence."""
        problem, local, count = self._problem, self._near.local, len(self._near.near)
        turn = problem.T[:3, :3]
        stiffness = turn @ contact.stiffness @ turn.T
        matrix = np.zeros((count + 2, count + 2), np.float32, order="F")
        matrix[:count, :count] = self._near.matrix
        spread_stiffness(local, problem.weights, stiffness, matrix)
        matrix[count, count] = matrix[count + 1, count + 1] = 1.0
        if problem.compliance:  # a displacement w of the object along z acts like a displacement -w of all points
            column, row = np.zeros((2, count // 3 + 1, 3))
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, :, 2]), column)
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, 2, :]), row)
            matrix[:count, count], matrix[count, :count] = column[:-1].ravel(), row[:-1].ravel()
            matrix[count, count] = 1 / problem.compliance + stiffness[:, 2, 2].sum()
        if problem.body.sealed:
            matrix[:count, count + 1] = self._v
            matrix[count + 1, :count] = problem.volume_force_n_per_mm3 * self._v
            matrix[count + 1, count + 1] = problem.volume_force_n_per_mm3 * self._q
        factors, pivots, _ = lapack.sgetrf(matrix, overwrite_a=1)
        self._near.solved = soften, factors, pivots

    def _solve(self, right_side: FloatArray) -> FloatArray:
        """Solution for a right side with the latest factors."""
        assert self._near.solved is not None, "factorise first"
        _, factors, pivots = self._near.solved
        return lapack.sgetrs(factors, pivots, right_side.astype(np.float32))[0].astype(float)


@compiled()
def _move_points(local: IntArray, weights: FloatArray, at: FloatArray, y: FloatArray, T: FloatArray, yielded: float) -> FloatArray:
    """Points (q, 3) in the object's frame after displacements ``y`` of their controls."""
    controls = (len(y) - 2) // 3
    out = np.empty_like(at)
    for p in range(len(at)):
        x0, x1, x2 = at[p, 0] - T[0, 3], at[p, 1] - T[1, 3], at[p, 2] - T[2, 3] - yielded
        for a in range(9):
            c = local[p, a]
            if c < controls:
                w = weights[p, a]
                x0 += w * y[3 * c]
                x1 += w * y[3 * c + 1]
                x2 += w * y[3 * c + 2]
        for i in range(3):
            out[p, i] = x0 * T[0, i] + x1 * T[1, i] + x2 * T[2, i]
    return out


@compiled(fastmath=True)
def _residual(
    matrix: FloatArray,
    y: FloatArray,
    start: FloatArray,
    column: FloatArray,
    local: IntArray,
    weights: FloatArray,
    force: FloatArray,
    T: FloatArray,
    out: FloatArray,
) -> float:
    """Write the residual forces on the near controls into ``out``; returns the sum of the contact forces along z. Sensor frame."""
    count = len(y) - 2
    for r in range(count):
        total = start[r] + column[r] * y[count + 1]
        for c in range(count):
            total += matrix[r, c] * y[c]
        out[r] = total
    force_z = 0.0
    for p in range(len(force)):
        f0, f1, f2 = force[p, 0], force[p, 1], force[p, 2]
        if f0 == 0 and f1 == 0 and f2 == 0:
            continue
        g0 = T[0, 0] * f0 + T[0, 1] * f1 + T[0, 2] * f2
        g1 = T[1, 0] * f0 + T[1, 1] * f1 + T[1, 2] * f2
        g2 = T[2, 0] * f0 + T[2, 1] * f1 + T[2, 2] * f2
        force_z += g2
        for a in range(9):
            c = 3 * local[p, a]
            if c < count:
                w = weights[p, a]
                out[c] -= w * g0
                out[c + 1] -= w * g1
                out[c + 2] -= w * g2
    return force_z
