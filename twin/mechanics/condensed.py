"""Contact problem on the condensed body, a small dense system that is solved by Newton's method; and on it, friction in short substeps.

Friction depends on the path. A point at the edge of a growing contact first bears a small pressure and slips; when the edge has passed,
the point sticks. In one long load step it would stick from the moment it touches, and the shear forces would be up to 10 % too small.
Therefore a load step with friction in which new places touch is computed a second time in short substeps. They use the body's tangent K,
condensed at the end of the step. The elastic force is linear in the controls x, plus a term that makes it exact at the start of the step
(0) as well as at its end (1):

    f(x, t) = f_1 + K (x - x_1) + (1 - t) [f_0 - f_1 - K (x_0 - x_1)],    t from 0 to 1

Each substep solves contact and friction exactly on this small problem. The anchors and slips after the substeps then enter the equations of
the whole load step.
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import blas, lapack

from twin.mechanics.balance import FORCE_FLOOR_N, Balance, LoadState, Problem, in_object
from twin.mechanics.body.linear import FrontalSolver
from twin.mechanics.contact import ContactForces, positions, spread_forces, spread_stiffness
from twin.mechanics.path import ContactPath
from twin.mechanics.turns import turn_vectors, turned_back, turned_matrix
from twin.types import BoolArray, FloatArray, IntArray

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
SUBSTEP_MM = 0.05
"""Largest motion of the object at a contact point in one substep, mm. Substeps of half this length change the shear forces by less
than 1 %."""
_MOST_SUBSTEPS = 16
"""Largest number of substeps in a load step."""
_SUBSTEP_TOLERANCE = 5e-3
"""Convergence threshold of a substep: norm of the residual relative to the sum of the contact forces at the end of the load step."""
_SUBSTEP_ITERATIONS = 20
"""Largest number of iterations of a substep; three are usual."""


@dataclass
class Tangent:
    """The body's tangent stiffness, condensed to the kept unknowns, and its rotation with the body since it was computed.

    Attributes
    ----------
    eliminated : FrontalSolver
    matrix : (k, k) float
        Condensed matrix of the kept unknowns.
    volume_column : (unknowns,) float
        Column of the sealed gel's pressure, which is one more unknown, after elimination. Zero for a gel that is not sealed.
    volume_pivot : float
        Diagonal entry of that pressure after elimination.
    strains : (m, 3, 3) float
        State at which the tangent was computed (see ``Turns.strains``).
    local : (p, 9) int
        Index of each contact point's controls among the kept controls.
    turns : (free, 3, 3) float, optional
        Rotation of each free control since the tangent was computed; None for a new tangent.
    """

    eliminated: FrontalSolver
    matrix: FloatArray  # (k, k), symmetric
    volume_column: FloatArray
    volume_pivot: float
    strains: FloatArray
    local: IntArray
    turns: FloatArray | None = None
    _forward: tuple[FloatArray, FloatArray] | None = None
    _near: tuple[IntArray, "Near", FloatArray | None, "Near"] | None = None

    def turn(self, turns: FloatArray) -> None:
        """Rotate the tangent with the body, by ``turns`` since it was computed."""
        self.turns, self._forward = turns, None

    def forward(self, elastic: FloatArray, volume_mm3: float) -> tuple[FloatArray, float]:
        """Forces (unknowns,), rotated back to the state of the tangent, and a change of volume, both after forward elimination."""
        if self._forward is None or self._forward[0] is not elastic:
            self._forward = elastic, self.eliminated.forward(turned_back(self.turns, elastic))
        forward, inner = self._forward[1], self.eliminated.inner
        return forward, np.float64(volume_mm3 - self.volume_column[inner] @ forward[inner])

    def near(self, looked: IntArray) -> "Near":
        """The tangent condensed to the candidate points (q,). The last result is stored."""
        if self._near is None or not np.array_equal(self._near[0], looked):
            still = Near(self, self.local[looked])
            self._near = looked, still, None, still
        _, still, turns, last = self._near
        if self.turns is not None and turns is not self.turns:
            last = still.turn(self.turns[self.eliminated.kept[::3] // 3], last.solved)
            self._near = looked, still, self.turns, last
        return last


class Near:
    """The tangent, condensed further to the controls that carry the candidate points.

    Kept controls that carry a candidate point are "near", the other ones are "far" and are eliminated here. The far part of the tangent
    is L L^T. All arrays are computed in single precision.

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

    def __init__(self, tangent: Tangent, local: IntArray) -> None:
        matrix, count = tangent.matrix, len(tangent.matrix)
        stays = np.zeros(count // 3 + 1, bool)
        stays[local] = True
        stays = np.repeat(stays[:-1], 3)
        far, near = np.flatnonzero(~stays), np.flatnonzero(stays)
        rows = matrix.take(near, axis=0)
        within, across, rest = matrix.take(far, axis=0).take(far, axis=1), rows.take(far, axis=1), rows.take(near, axis=1)
        factor, info = lapack.spotrf(within.T, lower=1, clean=0, overwrite_a=1) if len(far) else (np.zeros((0, 0)), 0)
        if info > 0:  # without contact some far controls have no stiffness: eliminate none
            near, far, factor, rest = np.arange(count), far[:0], np.zeros((0, 0)), matrix
        controls = near[::3] // 3
        renumber = np.full(count // 3 + 1, len(controls))
        renumber[controls] = np.arange(len(controls))
        column = tangent.volume_column[tangent.eliminated.kept]
        column, far_column = column[near].astype(float), column[far]
        coupling = np.zeros((0, len(near)), np.float32)
        if len(far):
            coupling = blas.strsm(1.0, factor, across.T, lower=1, overwrite_b=1)
            far_column = lapack.strtrs(factor, far_column, lower=1)[0]
            rest = rest - coupling.T @ coupling
            column = column - coupling.T @ far_column
        self.near, self.far, self.local, self.matrix, self.column = near, far, renumber[local], rest.astype(float), column
        self.factor, self.coupling, self.far_column = factor, coupling, far_column
        self.turns: FloatArray | None = None
        self.solved: tuple[float, FloatArray, IntArray] | None = None

    def turn(self, turns: FloatArray, solved: tuple[float, FloatArray, IntArray] | None) -> "Near":
        """The same for a body whose kept controls have rotated by ``turns`` (k / 3, 3, 3) since the tangent was computed."""
        other = copy(self)
        other.turns, other.solved = turns[self.near[::3] // 3], solved
        other.matrix, other.column = turned_matrix(other.turns, self.matrix), turn_vectors(other.turns, self.column)
        return other


class SmallContact:
    """Contact problem on the condensed body.

    The unknowns are the displacements dz of the near controls, the change dw of the object's displacement w along z, and the change dp of
    the gel's pressure:

    S dz + v dp + r = contact forces,   (w + dw) / c + sum f_z = 0,   k (v . dz + q dp + g) = 0

    S is the condensed tangent, v and q are the volume column and its diagonal entry, r and g the residuals, c the compliance. k converts a
    volume into a force (``Body.volume_force_n_per_mm3``), so that all residuals are in N and have one norm.
    """

    def __init__(self, problem: Problem, tangent: Tangent, residual: FloatArray, volume_residual: float, balance: Balance) -> None:
        self._problem, self._border, self.iterations = problem, balance.border, 0
        near = self._near = tangent.near(problem.looked)
        self._turn = np.ascontiguousarray(problem.T[:3, :3])
        self._at = in_object(positions(problem.controls, problem.weights, problem.lift, balance.control_mm), problem.T, balance.border)
        self._far_residual = lapack.strtrs(near.factor, residual[near.far], lower=1)[0] if len(near.far) else residual[near.far]
        self._r = turn_vectors(near.turns, residual[near.near] - near.coupling.T @ self._far_residual)
        self._v = near.column
        self._g = volume_residual - near.far_column @ self._far_residual
        self._q = tangent.volume_pivot - near.far_column @ near.far_column

    def solve(self, balance: Balance, *, soften: bool, least: float) -> tuple[FloatArray, FloatArray]:
        """Displacements of all kept unknowns (k,), rotated back to the state of the tangent, and changes of the border unknowns (2,).

        ``soften``: solve softened contact first, and start the true problem from its solution.
        ``least`` is the smallest residual, relative to the contact forces, that is required.
        """
        wanted = max(_INEXACT * (FORCE_FLOOR_N if soften else balance.absolute), least * balance.scale_n)
        start = np.zeros(len(self._near.near) + 2)
        y, done = (start, False) if soften else self.newton(start, wanted, _HASTY_ITERATIONS)
        if not done:
            y, _ = self.newton(start, wanted, _ITERATIONS, _SOFTENING)
            y, _ = self.newton(y, wanted, _ITERATIONS)
        near = self._near
        out = np.zeros(len(near.near) + len(near.far))
        out[near.near] = moved = turned_back(near.turns, y[:-2])
        if len(near.far):
            right = self._far_residual + near.far_column * y[-1] + near.coupling @ moved.astype(np.float32)
            out[near.far] = -lapack.strtrs(near.factor, right, lower=1, trans=1)[0]
        return out, y[-2:]

    def places(self, y: FloatArray) -> FloatArray:
        """Candidate points (q, 3) after displacements ``y`` (n + 2,), in the object's frame."""
        moved = np.zeros((len(y) // 3 + 1, 3))
        moved[:-1] = y[:-2].reshape(-1, 3) @ self._turn
        return positions(self._near.local, self._problem.weights, self._at - y[-2] * self._turn[2], moved)

    def newton(self, y: FloatArray, wanted: float, most: int, soften: float = 1.0) -> tuple[FloatArray, bool]:
        """Solve the problem with softened contact from a start (n + 2,), in at most ``most`` iterations.

        Returns the displacements of the near controls and the border, and whether the residual (N) is at most ``wanted``.
        """
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
        contact, out = problem.contact(self.places(y), soften), np.zeros(len(y))
        carried = np.zeros((len(y) // 3 + 1, 3))
        spread_forces(near.local, problem.weights, contact.force_n, carried)
        out[:-2] = self._r + self._v * y[-1] + near.matrix @ y[:-2] - (carried[:-1] @ self._turn.T).ravel()
        if problem.compliance:
            out[-2] = (self._border[0] + y[-2]) / problem.compliance + contact.force_n.sum(axis=0) @ self._turn[2]
        out[-1] = problem.volume_force_n_per_mm3 * (self._g + self._v @ y[:-2] + self._q * y[-1])
        return out, contact

    def _factorise(self, contact: ContactForces, soften: float) -> None:
        """Factorise the matrix of Newton's method, in single precision: that halves the cost and does not harm the convergence."""
        problem, local, count = self._problem, self._near.local, len(self._near.near)
        turn = problem.T[:3, :3]
        stiffness = (contact.stiffness.reshape(-1, 9) @ np.kron(turn, turn).T).reshape(-1, 3, 3)  # R K R^T of each point
        matrix = np.zeros((count + 2, count + 2), np.float32, order="F")
        matrix[:count, :count] = self._near.matrix.T
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


def substeps(moved_mm: float) -> int:
    """Number of substeps of a load step in which the object moves by ``moved_mm`` at a contact point."""
    return min(int(np.ceil(moved_mm / SUBSTEP_MM)), _MOST_SUBSTEPS)


def friction_substeps(
    problem: Problem, state: LoadState, anchor_mm: FloatArray, tangent: Tangent, balance: Balance, count: int
) -> LoadState | None:
    """The history of friction up to the last substep of a load step, and the anchors for the last substep.

    Parameters
    ----------
    problem : Problem
        Equations of the load step.
    state : LoadState
        State at the start of the load step.
    anchor_mm : (p, 3) float
        Anchors of all contact points. Those of the candidate points are replaced in the result.
    tangent : Tangent
        The body's tangent, near the end of the load step.
    balance : Balance
        State at the end of the load step, at least approximately solved.
    count : int
        Number of substeps.

    Returns
    -------
    LoadState
        The state at the start, except for ``held``, ``slid_mm``, ``limit_n`` and ``gap_mm``, which are those one substep before the end,
        ``dissipated_nmm`` up to there, and ``T`` and ``anchor_mm`` of the last substep. None if a substep did not converge.
    """
    looked, kept, field = problem.looked, tangent.eliminated.kept, problem.field
    near, turns = tangent.near(looked), tangent.turns
    forward, volume = tangent.forward(balance.elastic, balance.border_residual[1])
    start: FloatArray = (state.control_mm - balance.control_mm)[problem.body.free].ravel()[kept]
    y = np.concatenate([start[near.near], state.border - balance.border])
    turns = None if turns is None else turns[kept[::3] // 3]
    start = turned_back(turns, start).astype(np.float32)
    at_start = in_object(positions(problem.controls, problem.weights, problem.lift, state.control_mm), state.T, state.border)
    held = state.held[looked]
    pressed = problem.move_object(state.T, state.anchor_mm[looked], state.slid_mm[looked]).contact(at_start).force_n @ state.T[:3, :3].T
    spread = np.zeros((len(kept) // 3 + 1, 3))
    spread_forces(tangent.local[looked], problem.weights, pressed * held[:, None], spread)
    residual_start = turned_back(turns, spread[:-1].ravel()) - tangent.matrix @ start
    column, pressure = tangent.volume_column[kept], state.border[1] - balance.border[1]
    residual_start -= column * pressure
    volume_start = -float(column @ start + tangent.volume_pivot * pressure)

    way = ContactPath(np.stack([state.T, problem.T]))
    anchor, slid, limit, lost = state.anchor_mm[looked], state.slid_mm[looked], state.limit_n[looked], 0.0
    wanted, before, gap_before = _SUBSTEP_TOLERANCE * balance.scale_n, at_start, field.distance(at_start)
    for number in range(1, count + 1):
        share, predicted = number / count, y * (1 - 1 / (count + 1 - number))
        T = way.at(share)
        substep = problem.move_object(T, anchor, slid)
        residual_now, volume_now = (1 - share) * residual_start + share * forward[kept], (1 - share) * volume_start + share * volume
        small = SmallContact(substep, tangent, residual_now, volume_now, balance)
        after = small.places(predicted)
        substep.anchor_mm = anchor = first_touch(held, anchor, before, after, gap_before, field.distance(after))
        if number == count:
            break
        y, done = small.newton(predicted, wanted, _SUBSTEP_ITERATIONS)
        if not done:
            near.solved = None
            return None
        before = small.places(y)
        contact = substep.contact(before)
        held, gap, gap_before = contact.penetration_mm > 0, gap_before, field.distance(before)
        anchor, slid, limit, more = update_friction(substep, contact, limit, gap, gap_before)
        lost += more
    anchors, all_held, all_slid, all_limit = anchor_mm.copy(), state.held.copy(), state.slid_mm.copy(), state.limit_n.copy()
    gap = state.gap_mm.copy()
    anchors[looked], all_held[looked], all_slid[looked], all_limit[looked], gap[looked] = anchor, held, slid, limit, gap_before
    history = replace(state, held=all_held, slid_mm=all_slid, limit_n=all_limit, gap_mm=gap, dissipated_nmm=lost)
    return replace(history, T=problem.T, anchor_mm=anchors)


def first_touch(
    held: BoolArray, anchor: FloatArray, before: FloatArray, after: FloatArray, gap_before: FloatArray, gap: FloatArray
) -> FloatArray:
    """Anchors (q, 3) for a step. A point in contact keeps its anchor. A point that enters the object is anchored at its place of entry.

    ``before`` and ``after`` (q, 3) are the points in the object's frame; between them each point moves on a straight line. ``gap_before``
    and ``gap`` (q,) are the points' distances from the object at both ends.
    """
    driven = (gap_before > 0) & (gap < 0)
    share = np.where(driven, gap_before / np.where(driven, gap_before - gap, 1.0), 0.0)[:, None]
    return np.where(held[:, None], anchor, (1 - share) * before + share * after)


def update_friction(
    problem: Problem, contact: ContactForces, limit_n: FloatArray, gap_before: FloatArray, gap: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Friction after a step: anchors (q, 3), slip since each point last stuck (q,), limits of friction (q,) in N, dissipated work in N mm.

    The friction force of a slipping point equals its limit. During the step the limit changes from ``limit_n`` (q,) to its new value, with
    the point's normal force and slip. A point that slipped and leaves the object bears friction until its distance, which goes from
    ``gap_before`` (q,) to ``gap`` (q,), reaches 0.
    """
    limit = np.minimum(problem.friction * contact.normal_n, problem.bound_n)
    way = contact.anchor_mm - problem.anchor_mm
    moved = np.linalg.norm(way, axis=1)
    slid = np.where(contact.slipping, problem.slid_mm + moved, 0.0)
    lost = float(((limit_n + limit) / 2 * moved)[contact.slipping].sum())
    left = np.flatnonzero((gap >= 0) & (gap_before < 0) & (problem.slid_mm > 0))
    across = way[left] - (way[left] * contact.normal[left]).sum(axis=1, keepdims=True) * contact.normal[left]
    share = gap_before[left] / (gap_before[left] - gap[left])
    lost += float((limit_n[left] / 2 * share * np.linalg.norm(across, axis=1)).sum())
    return contact.anchor_mm, slid, limit, lost
