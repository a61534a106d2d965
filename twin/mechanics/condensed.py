"""Contact against the eliminated body: small, dense, and solved exactly."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, lu_factor, lu_solve

from twin.mechanics.balance import FORCE_FLOOR_N, Balance, Problem
from twin.mechanics.contact import ContactForces, positions, spread_forces, spread_stiffness
from twin.mechanics.linear import Eliminated

_ITERATIONS, _HASTY_ITERATIONS = 60, 15
LARGEST_MOVE_MM = 1.5  # of a control in one iteration
_SOFTENING = 0.1  # of the contact, on the way to a far solution
_INEXACT = 0.01  # the iteration ends at this share of the whole problem's residual, but not before ``least`` of the scale


@dataclass(frozen=True)
class Tangent:
    """The body's tangent, eliminated down to the kept unknowns.

    The sealed gel's pressure is one more unknown: ``volume_column`` (unknowns,) is its eliminated column,
    ``volume_pivot`` what it leaves on the diagonal.
    """

    eliminated: Eliminated
    matrix: np.ndarray  # (k, k), symmetric
    volume_column: np.ndarray | None
    volume_pivot: float


@dataclass(frozen=True)
class Near:
    """The tangent once more eliminated, down to the controls that carry the points looked at.

    ``near``, ``far``: kept unknowns that stay and go. ``local (q, 9)``: place of each point's controls among
    those that stay (their number: none of them).
    """

    near: np.ndarray
    far: np.ndarray
    local: np.ndarray
    matrix: np.ndarray
    factor: tuple | None
    coupling: np.ndarray  # (far, near)
    carried: np.ndarray  # the far part's inverse applied to the coupling and to the volume's column
    column: np.ndarray  # (k,) volume's

    @classmethod
    def of(cls, tangent: Tangent, local: np.ndarray) -> "Near":
        matrix, count = tangent.matrix, len(tangent.matrix)
        controls = np.unique(local[local >= 0])
        n = (3 * controls[:, None] + np.arange(3)).ravel()
        f = np.setdiff1d(np.arange(count), n, assume_unique=True)
        renumber = np.full(count // 3 + 1, len(controls))
        renumber[controls] = np.arange(len(controls))
        column = np.zeros(count) if tangent.volume_column is None else tangent.volume_column[tangent.eliminated.kept]
        coupling, rest = matrix[np.ix_(f, n)], matrix[np.ix_(n, n)]
        if not len(f):
            return cls(n, f, renumber[local], rest, None, coupling, np.zeros((0, len(n) + 1)), column)
        factor = lu_factor(matrix[np.ix_(f, f)], check_finite=False)
        carried = lu_solve(factor, np.column_stack([coupling, column[f]]), check_finite=False)
        return cls(n, f, renumber[local], rest - coupling.T @ carried[:, :-1], factor, coupling, carried, column)


class SmallContact:
    """Contact against the eliminated body: unknowns are the touched controls' moves, the object's yield and the gel's pressure.

    S dz + v dp + r = forces of contact,   (w + dw) / c + sum f_z = 0,   v . dz + q dp + g = 0
    """

    def __init__(self, problem: Problem, near: Near, pivot: float, residual, volume_residual, control, border):
        self._problem, self._border, self._near = problem, border, near
        self.iterations = 0
        self._at = positions(problem.controls, problem.weights, problem.lift, control)
        n, f = near.near, near.far
        self._far_residual = residual[f]
        self._r = residual[n] - near.carried[:, :-1].T @ residual[f]
        self._v = near.column[n] - near.coupling.T @ near.carried[:, -1]
        self._g = volume_residual - near.carried[:, -1] @ residual[f]
        self._q = pivot - near.carried[:, -1] @ near.column[f]

    def solve(self, balance: Balance, *, soften: bool, least: float):
        """Moves of all kept unknowns (k,) and of the border (2,).

        ``soften``: far from the solution; softened contact is solved first, and its answer is the start.
        ``least``: residual, relative to the contact forces, that is never gone below.
        """
        wanted = max(_INEXACT * (FORCE_FLOOR_N if soften else balance.absolute), least * balance.scale_n)
        start = np.zeros(len(self._near.near) + 2)
        y, done = (start, False) if soften else self._newton(start, 1.0, wanted, _HASTY_ITERATIONS)
        if not done:
            y, _ = self._newton(start, _SOFTENING, wanted, _ITERATIONS)
            y, _ = self._newton(y, 1.0, wanted, _ITERATIONS)
        near = self._near
        out = np.zeros(len(near.column))
        out[near.near] = y[:-2]
        if len(near.far):
            right = self._far_residual + near.column[near.far] * y[-1] + near.coupling @ y[:-2]
            out[near.far] = -lu_solve(near.factor, right, check_finite=False)
        return out, y[-2:]

    def _newton(self, y, soften: float, wanted: float, most: int):
        residual, contact = self._equations(y, soften)
        norm = np.linalg.norm(residual)
        for _ in range(most):
            if norm <= wanted:
                return y, True
            self.iterations += 1
            move = self._direction(contact, residual)
            size = min(1.0, LARGEST_MOVE_MM / max(np.abs(move[:-2]).max(initial=0.0), 1e-300))
            best = None
            for _ in range(6):
                trial, trial_contact = self._equations(y + size * move, soften)
                trial_norm = np.linalg.norm(trial)
                if best is None or trial_norm < best[0]:
                    best = (trial_norm, size, trial, trial_contact)
                if trial_norm < (1 - 0.1 * size) * norm:
                    break
                size /= 2
            norm, size, residual, contact = best
            y = y + size * move
        return y, False

    def _equations(self, y, soften: float):
        problem, near = self._problem, self._near
        moves = np.concatenate([y[:-2].reshape(-1, 3), np.zeros((1, 3))])
        border = self._border + y[-2:]
        contact = problem.contact(positions(near.local, problem.weights, self._at, moves), border, soften)
        force = contact.force_n @ problem.T[:3, :3].T
        pull = np.zeros_like(moves)
        spread_forces(near.local, problem.weights, force, pull)
        out = np.zeros(len(y))
        out[:-2] = near.matrix @ y[:-2] + self._r + self._v * y[-1] - pull[:-1].ravel()
        if problem.compliance:
            out[-2] = border[0] / problem.compliance + force[:, 2].sum()
        if problem.body.sealed:
            out[-1] = self._g + self._v @ y[:-2] + self._q * y[-1]
        return out, contact

    def _direction(self, contact: ContactForces, residual):
        """Newton's direction; solved in single precision, which costs half and no convergence."""
        problem, local, count = self._problem, self._near.local, len(self._near.near)
        turn = problem.T[:3, :3]
        stiffness = turn @ contact.stiffness @ turn.T
        matrix = np.zeros((count + 2, count + 2), np.float32, order="F")
        matrix[:count, :count] = self._near.matrix
        spread_stiffness(local, problem.weights, stiffness, matrix)
        matrix[count, count] = matrix[count + 1, count + 1] = 1.0
        if problem.compliance:  # an object moved by w along z is points moved by -w
            column, row = np.zeros((2, count // 3 + 1, 3))
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, :, 2]), column)
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, 2, :]), row)
            matrix[:count, count], matrix[count, :count] = column[:-1].ravel(), row[:-1].ravel()
            matrix[count, count] = 1 / problem.compliance + stiffness[:, 2, 2].sum()
        if problem.body.sealed:
            matrix[:count, count + 1] = matrix[count + 1, :count] = self._v
            matrix[count + 1, count + 1] = self._q
        return lapack.sgesv(matrix, -residual.astype(np.float32), overwrite_a=1)[2].astype(float)
