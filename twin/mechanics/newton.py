"""One load step: from a converged state to the next one, the object moved.

Two nested iterations. The outer one is Newton's method on the elastic body: its tangent is eliminated
down to the controls of the outer skin that the object may touch, and kept while it serves (it usually
lasts for several iterations, and from one load step into the next). The inner one solves contact and
friction exactly against what is left, a small dense problem: which points touch, stick or slip changes
often, and is cheap to find there.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, lu_factor, lu_solve

from twin.mechanics.contact import ContactForces, ContactPoints, contact_forces, positions, spread_forces, spread_stiffness
from twin.mechanics.elements import Elements
from twin.mechanics.linear import Eliminated, FrontalSolver, NotPositiveDefinite

GAP_BOUND_MM = 0.01  # no contact point ends deeper inside the object
RESIDUAL_TOLERANCE = 1e-6  # of the sum of the contact forces
_FORCE_FLOOR_N = 1e-3  # the residual's scale is never less
_PENALTY_GROWTH, _PENALTY_RAISES = 4.0, 5
_OUTER_ITERATIONS, _INNER_ITERATIONS, _HASTY_ITERATIONS = 30, 60, 15
_WORSE = 2.0  # growth of the residual that is put up with
_KEEP_TANGENT = 0.2  # contraction of the residual up to which an old tangent is kept
_LARGEST_MOVE_MM = 1.5  # of a control in one iteration
_SMALLEST_SHIFT_N_MM, _LARGEST_SHIFT_N_MM = 0.01, 50.0  # on the tangent's diagonal, where it leads astray
_SOFTENING = 0.1  # of the contact, on the way to a far solution
_INEXACT = 0.01  # the inner iteration ends at this share of the outer one's residual, but not before the scale's tolerance
_GEL_STEPS = 2  # tangents for which the gel's is kept
_NOTHING = np.zeros((0, 8, 3, 3))
_REACH_MM = 0.15  # contact points farther than this from the object are left out, and checked at the end


class NoConvergence(Exception):
    """A load step was not solved; ``relative`` is the relative residual reached."""

    def __init__(self, relative: float):
        super().__init__(relative)
        self.relative = relative


@dataclass(frozen=True)
class Body:
    """What a sensor brings to every contact.

    Attributes
    ----------
    kinds : tuple of Elements
        Skin first, then the gel.
    points : ContactPoints
    free : (n,) bool
        Controls that move.
    sealed : bool
        Whether the gel's volume is held.
    """

    kinds: tuple[Elements, ...]
    points: ContactPoints
    free: np.ndarray
    sealed: bool


@dataclass(frozen=True)
class Friction:
    """Coulomb friction with slip weakening (Ida 1972).

    A point that has slid by s since it last stuck has mu = kinetic + (static - kinetic) exp(-s / weakening_mm).
    """

    static: float
    kinetic: float
    weakening_mm: float = 0.1


@dataclass(frozen=True)
class LoadState:
    """A converged state.

    Attributes
    ----------
    control_mm : (n, 3) float
    border : (2,) float
        How far the object has given way along z (mm), and the pressure of a sealed gel (MPa).
    anchor_mm : (p, 3) float
        Friction's anchors in the object's frame; meaningful where ``held (p,)``.
    slid_mm : (p,) float
        Slip since the point last stuck.
    penalty_mpa_mm : float
    T : (4, 4) float
        The object's pose before it gave way.
    elastic_nmm, dissipated_nmm : float
        Energy stored in the body, and lost to friction in the step that led here.
    """

    control_mm: np.ndarray
    border: np.ndarray
    anchor_mm: np.ndarray
    held: np.ndarray
    slid_mm: np.ndarray
    penalty_mpa_mm: float
    T: np.ndarray
    elastic_nmm: float = 0.0
    dissipated_nmm: float = 0.0


@dataclass(frozen=True)
class Balance:
    """The equations at a trial state.

    Attributes
    ----------
    elastic : (unknowns,) float
        Elastic force on the free controls; ``residual`` less the contact's.
    border_residual : (2,) float
        Of yield / compliance + force = 0 (N) and of the sealed gel's volume (mm^3).
    contact : ContactForces
        At the points looked at, in the object's frame; ``point_force_n`` (q, 3) the same forces in the sensor's.
    scale_n : float
        Sum of the contact forces.
    elastic_nmm : float
        Energy stored in the body.
    """

    elastic: np.ndarray
    residual: np.ndarray
    border_residual: np.ndarray
    contact: ContactForces
    point_force_n: np.ndarray
    scale_n: float
    elastic_nmm: float

    @property
    def absolute(self) -> float:
        """Norm of the residual in N."""
        return float(np.hypot(np.linalg.norm(self.residual), np.linalg.norm(self.border_residual)))

    @property
    def relative(self) -> float:
        """Norm of the residual over the sum of the contact forces."""
        return self.absolute / self.scale_n


@dataclass(frozen=True)
class _Tangent:
    """The body's tangent, eliminated down to the kept unknowns.

    The sealed gel's pressure is one more unknown: ``volume_column`` (unknowns,) is its eliminated column,
    ``volume_pivot`` what it leaves on the diagonal.
    """

    eliminated: Eliminated
    matrix: np.ndarray  # (k, k), symmetric
    volume_column: np.ndarray | None
    volume_pivot: float


class LoadStepper:
    """Solves load steps of one contact.

    Parameters
    ----------
    body : Body
    frontal : FrontalSolver
        Keeps the controls that the object may touch.
    stimulus : Stimulus
    friction : Friction
    compliance_mm_per_n : float
    """

    def __init__(self, body: Body, frontal: FrontalSolver, stimulus, friction: Friction, compliance_mm_per_n: float):
        self._body, self._frontal, self._stimulus, self._friction = body, frontal, stimulus, friction
        self._compliance = compliance_mm_per_n
        shapes = [(len(kind.cells.controls), 6, *2 * kind.cells.controls.shape[1:]) for kind in body.kinds]
        self._blocks = [np.empty(shape) for shape in shapes]
        local = np.full(len(body.free), -1)  # place of each control among the kept ones
        kept_controls = np.flatnonzero(np.isin(frontal.unknown[:, 0], frontal.kept))
        local[kept_controls] = np.arange(len(kept_controls))
        self._local = local[body.points.controls]
        # a point may be carried by kept and by clamped controls only
        self._reachable = ((self._local >= 0) | ~body.free[body.points.controls]).all(axis=1)
        self._tangent: _Tangent | None = None
        self._shift = 0.0
        self._near: tuple | None = None
        self._gel_age = _GEL_STEPS
        self._last: LoadState | None = None
        self.iterations, self.inner_iterations, self.eliminations = 0, 0, 0

    def follow(self, body: Body) -> None:
        """Go on with changed elements (a relaxing material's law is scaled by the step's duration)."""
        self._body = body

    def step(self, state: LoadState, T: np.ndarray, given: list[np.ndarray]) -> tuple[LoadState, Balance, np.ndarray]:
        """The converged state with the object at ``T``, no contact point deeper than the bound.

        ``given``: stress left of the past, for each kind of elements (see ``Elements.add_forces``).
        Also returns the equations' last balance and which contact points it looked at, (q,) int.

        Raises
        ------
        NoConvergence
        """
        control, border = self._extrapolate(state, T)
        before, after = self._seen(state.control_mm, state.border, state.T), self._seen(control, border, T)
        gap_before, gap = self._stimulus.distance(before), self._stimulus.distance(after)
        looked = np.flatnonzero(self._reachable & (gap < _REACH_MM) | state.held)
        # a point that is driven into the object is anchored where it meets the surface on the way
        driven = (gap_before > 0) & (gap < 0)
        share = np.where(driven, gap_before / np.where(driven, gap_before - gap, 1.0), 0.0)[:, None]
        anchors = np.where(state.held[:, None], state.anchor_mm, (1 - share) * before + share * after)
        penalty = state.penalty_mpa_mm
        for _ in range(_PENALTY_RAISES):
            problem = _Problem(self, state, anchors, looked, penalty, T, given)
            control, border, balance = self._solve(problem, control, border, control is not state.control_mm)
            left_out = np.setdiff1d(np.arange(len(gap)), looked, assume_unique=True)
            missed = left_out[self._stimulus.distance(self._seen(control, border, T)[left_out]) < 0]
            if len(missed):
                if not self._reachable[missed].all():
                    raise NoConvergence(np.inf)
                looked = np.sort(np.concatenate([looked, missed]))
            elif balance.contact.penetration_mm.max(initial=0.0) > GAP_BOUND_MM:
                penalty *= _PENALTY_GROWTH
            else:
                return self._accepted(state, problem, control, border, balance), balance, looked
        raise NoConvergence(balance.relative)

    def _extrapolate(self, state: LoadState, T: np.ndarray):
        """Where the body will be if it goes on as in the last step; where it is if the object turns another way."""
        if self._last is None or not self._last.held.any():  # a first contact grows in no straight line
            return state.control_mm, state.border
        old, at = self._last, self._body.points.positions(state.control_mm)[state.held]
        if not len(at):
            return state.control_mm, state.border

        def carried(start, stop):
            return ((at - start[:3, 3]) @ start[:3, :3] @ stop[:3, :3].T + stop[:3, 3] - at).ravel()

        before, now = carried(old.T, state.T), carried(state.T, T)
        ratio = (before @ now) / max(before @ before, 1e-300)
        if before @ now < 0.95 * np.linalg.norm(before) * np.linalg.norm(now) or ratio > 2:
            return state.control_mm, state.border
        control = state.control_mm + ratio * (state.control_mm - old.control_mm)
        inside_out = any(np.isinf(kind.add_forces(control, _NOTHING, np.zeros_like(control))) for kind in self._body.kinds)
        return (state.control_mm if inside_out else control), state.border

    def _accepted(self, state: LoadState, problem: "_Problem", control, border, balance: Balance) -> LoadState:
        contact, looked, count = balance.contact, problem.looked, len(state.held)
        self._last = state
        held, anchor, slid = np.zeros(count, bool), np.zeros((count, 3)), np.zeros(count)
        held[looked], anchor[looked] = contact.penetration_mm > 0, contact.anchor_mm
        moved = np.linalg.norm(contact.anchor_mm - problem.anchor_mm, axis=1)
        slid[looked] = np.where(contact.slipping, state.slid_mm[looked] + moved, 0.0)
        tangential = np.linalg.norm(contact.force_n - contact.normal_n[:, None] * contact.normal, axis=1)
        lost = float((tangential * moved)[contact.slipping].sum())
        return LoadState(control, border, anchor, held, slid, problem.penalty, problem.T, balance.elastic_nmm, lost)

    def _seen(self, control, border, T) -> np.ndarray:
        """All contact points in the object's frame, (p, 3)."""
        return (self._body.points.positions(control) - T[:3, 3] - [0, 0, border[0]]) @ T[:3, :3]

    def _solve(self, problem: "_Problem", control, border, extrapolated: bool):
        balance = problem.balance(control, border)
        astray = False
        tangent, fresh, shift, last, accepted = self._tangent, False, 0.0, np.inf, 0
        for _ in range(_OUTER_ITERATIONS):
            if balance is None:
                raise NoConvergence(np.inf)
            if balance.relative <= RESIDUAL_TOLERANCE:
                return control, border, balance
            self.iterations += 1
            if tangent is None or (not fresh and balance.absolute > _KEEP_TANGENT * last) or shift != self._shift:
                self._tangent = tangent = self._linearise(problem, control, border, shift)
                self._shift, fresh = shift, True
            else:
                fresh = False
            soften = astray or not (accepted or extrapolated)
            move, border_move = self._contact_move(problem, tangent, control, border, balance, soften)
            size = min(1.0, _LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
            new, new_border = control.copy(), border + size * border_move
            new[self._body.free] += size * move.reshape(-1, 3)
            trial = problem.balance(new, new_border)
            # the first move brings the object's motion: only then may the residual be anything
            if trial is None or size < 1 or (accepted and trial.absolute > _WORSE * balance.absolute):
                astray = True
                if not fresh:
                    last = 0.0  # an old tangent is to blame first
                else:
                    shift = max(8 * shift, _SMALLEST_SHIFT_N_MM)
                    if shift > _LARGEST_SHIFT_N_MM:
                        raise NoConvergence(balance.relative)
                continue
            shift, astray = 0.0, False
            last, accepted = balance.absolute, accepted + 1
            control, border, balance = new, new_border, trial
        raise NoConvergence(balance.relative)

    def _linearise(self, problem: "_Problem", control, border, shift: float) -> _Tangent:
        """The body's tangent at a state, plus a shift on the diagonal."""
        self.eliminations += 1
        problem.stiffness(control, border, self._blocks)
        while True:
            try:
                eliminated = self._frontal.eliminate(self._blocks, shift=shift)
                break
            except NotPositiveDefinite:
                shift = max(8 * shift, _SMALLEST_SHIFT_N_MM)
                if shift > _LARGEST_SHIFT_N_MM:
                    raise NoConvergence(np.inf) from None
        matrix = np.tril(eliminated.matrix) + np.tril(eliminated.matrix, -1).T + shift * np.eye(len(eliminated.matrix))
        if not self._body.sealed:
            return _Tangent(eliminated, matrix, None, 0.0)
        column = np.zeros_like(control)
        problem.volume(control, column)
        column = eliminated.forward(column[self._body.free].ravel())
        inner = np.ones(len(column), bool)
        inner[eliminated.kept] = False
        return _Tangent(eliminated, matrix, column, -float(column[inner] @ column[inner]))

    def _contact_move(self, problem: "_Problem", tangent: _Tangent, control, border, balance: Balance, soften: bool):
        """The move (unknowns,) and (2,) that balances the linearised body with the exact contact."""
        eliminated = tangent.eliminated
        kept = eliminated.kept
        forward = eliminated.forward(balance.elastic)
        volume_residual = balance.border_residual[1]
        if tangent.volume_column is not None:
            inner = np.ones(len(forward), bool)
            inner[kept] = False
            volume_residual = volume_residual - tangent.volume_column[inner] @ forward[inner]
        if self._near is None or self._near[0] is not tangent or not np.array_equal(self._near[1], problem.looked):
            self._near = tangent, problem.looked, _Near.of(tangent, self._local[problem.looked])
        small = _Small(self, problem, self._near[2], tangent.volume_pivot, forward[kept], volume_residual, control, border)
        kept_move, border_move = small.solve(balance, soften)
        if tangent.volume_column is not None:
            forward = forward + border_move[1] * tangent.volume_column
        return eliminated.backward(-forward, kept_move), border_move


class _Problem:
    """The equations of one load step: anchors, penalty, pose and what is left of the past held."""

    def __init__(self, stepper: LoadStepper, state: LoadState, anchor_mm, looked, penalty: float, T: np.ndarray, given):
        body, law = stepper._body, stepper._friction
        self._stepper, self._given, self.T = stepper, given, T
        self.looked, self.penalty = looked, penalty
        points = body.points
        self.controls, self.weights = points.controls[looked], points.weights[looked]
        self.lift = points.lift_mm[looked]
        self.anchor_mm = anchor_mm[looked]
        self.stiff = penalty * points.area_mm2[looked]
        self.friction = law.kinetic + (law.static - law.kinetic) * np.exp(-state.slid_mm[looked] / law.weakening_mm)

    def contact(self, at_sensor, border, soften: float = 1.0) -> ContactForces:
        """Contact with the points looked at in places (q, 3) of the sensor's frame."""
        at = (at_sensor - self.T[:3, 3] - [0, 0, border[0]]) @ self.T[:3, :3]
        return contact_forces(self._stepper._stimulus, at, self.stiff, self.anchor_mm, self.friction, soften=soften)

    def balance(self, control, border) -> Balance | None:
        """The equations; None if an element is inside out."""
        own = self._stepper
        body = own._body
        residual = np.zeros_like(control)
        elastic_nmm = 0.0
        for number, (kind, given) in enumerate(zip(body.kinds, self._given, strict=True)):
            elastic_nmm += kind.add_forces(control, given, residual, border[1] if number else 0.0)
        if not np.isfinite(elastic_nmm):
            return None
        elastic = residual[body.free].ravel()
        contact = self.contact(positions(self.controls, self.weights, self.lift, control), border)
        force = contact.force_n @ self.T[:3, :3].T
        spread_forces(self.controls, self.weights, -force, residual)
        border_residual = np.zeros(2)
        if own._compliance:  # the skin pushes the object with -sum f
            border_residual[0] = border[0] / own._compliance + float(force[:, 2].sum())
        if body.sealed:
            border_residual[1] = self.volume(control, np.zeros_like(control))
            elastic_nmm -= border[1] * border_residual[1]
        scale = max(float(np.linalg.norm(force, axis=1).sum()), _FORCE_FLOOR_N)
        return Balance(elastic, residual[body.free].ravel(), border_residual, contact, force, scale, elastic_nmm)

    def stiffness(self, control, border, blocks) -> None:
        """The elements' tangents into ``blocks``; the gel's, which changes little, only now and then."""
        own = self._stepper
        own._gel_age += 1
        for number, (kind, given, block) in enumerate(zip(own._body.kinds, self._given, blocks, strict=True)):
            if number == 0 or own._gel_age > _GEL_STEPS:
                kind.stiffness(control, given, border[1] if number else 0.0, block)
        own._gel_age = 0 if own._gel_age > _GEL_STEPS else own._gel_age

    def volume(self, control, out) -> float:
        """How much the gel's volume has grown, mm^3; adds its gradient to ``out``."""
        return sum(kind.add_volume(control, out) for kind in self._stepper._body.kinds[1:])


@dataclass(frozen=True)
class _Near:
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
    def of(cls, tangent: _Tangent, local: np.ndarray) -> "_Near":
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


class _Small:
    """Contact against the eliminated body: unknowns are the touched controls' moves, the object's yield and the gel's pressure.

    S dz + v dp + r = forces of contact,   (w + dw) / c + sum f_z = 0,   v . dz + q dp + g = 0
    """

    def __init__(self, stepper: LoadStepper, problem: _Problem, near: _Near, pivot: float, residual, volume_residual, control, border):
        self._stepper, self._problem, self._border, self._near = stepper, problem, border, near
        self._at = positions(problem.controls, problem.weights, problem.lift, control)
        n, f = near.near, near.far
        self._far_residual = residual[f]
        self._r = residual[n] - near.carried[:, :-1].T @ residual[f]
        self._v = near.column[n] - near.coupling.T @ near.carried[:, -1]
        self._g = volume_residual - near.carried[:, -1] @ residual[f]
        self._q = pivot - near.carried[:, -1] @ near.column[f]

    def solve(self, balance: Balance, soften: bool):
        """Moves of all kept unknowns (k,) and of the border (2,).

        ``soften``: far from the solution; softened contact is solved first, and its answer is the start.
        """
        wanted = max(_INEXACT * (_FORCE_FLOOR_N if soften else balance.absolute), 0.1 * RESIDUAL_TOLERANCE * balance.scale_n)
        start = np.zeros(len(self._near.near) + 2)
        y, done = (start, False) if soften else self._newton(start, 1.0, wanted, _HASTY_ITERATIONS)
        if not done:
            y, _ = self._newton(start, _SOFTENING, wanted, _INNER_ITERATIONS)
            y, _ = self._newton(y, 1.0, wanted, _INNER_ITERATIONS)
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
            self._stepper.inner_iterations += 1
            move = self._direction(contact, residual)
            size = min(1.0, _LARGEST_MOVE_MM / max(np.abs(move[:-2]).max(initial=0.0), 1e-300))
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
        problem, own, near = self._problem, self._stepper, self._near
        moves = np.concatenate([y[:-2].reshape(-1, 3), np.zeros((1, 3))])
        border = self._border + y[-2:]
        contact = problem.contact(positions(near.local, problem.weights, self._at, moves), border, soften)
        force = contact.force_n @ problem.T[:3, :3].T
        pull = np.zeros_like(moves)
        spread_forces(near.local, problem.weights, force, pull)
        out = np.zeros(len(y))
        out[:-2] = near.matrix @ y[:-2] + self._r + self._v * y[-1] - pull[:-1].ravel()
        if own._compliance:
            out[-2] = border[0] / own._compliance + force[:, 2].sum()
        if own._body.sealed:
            out[-1] = self._g + self._v @ y[:-2] + self._q * y[-1]
        return out, contact

    def _direction(self, contact: ContactForces, residual):
        """Newton's direction; solved in single precision, which costs half and no convergence."""
        problem, own, local, count = self._problem, self._stepper, self._near.local, len(self._near.near)
        turn = problem.T[:3, :3]
        stiffness = turn @ contact.stiffness @ turn.T
        matrix = np.zeros((count + 2, count + 2), np.float32, order="F")
        matrix[:count, :count] = self._near.matrix
        spread_stiffness(local, problem.weights, stiffness, matrix)
        matrix[count, count] = matrix[count + 1, count + 1] = 1.0
        if own._compliance:  # an object moved by w along z is points moved by -w
            column, row = np.zeros((2, count // 3 + 1, 3))
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, :, 2]), column)
            spread_forces(local, problem.weights, np.ascontiguousarray(-stiffness[:, 2, :]), row)
            matrix[:count, count], matrix[count, :count] = column[:-1].ravel(), row[:-1].ravel()
            matrix[count, count] = 1 / own._compliance + stiffness[:, 2, 2].sum()
        if own._body.sealed:
            matrix[:count, count + 1] = matrix[count + 1, :count] = self._v
            matrix[count + 1, count + 1] = self._q
        return lapack.sgesv(matrix, -residual.astype(np.float32), overwrite_a=1)[2].astype(float)
