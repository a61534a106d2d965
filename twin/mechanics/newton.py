"""Solver of one load step: the object moves, and the equilibrium of the sensor is found by Newton's method.

Two iterations are nested. The outer iteration is Newton's method on the elastic body. Its tangent is condensed to the controls of the
outer skin that the object may touch. The same tangent is used again as long as the residual decreases fast enough: usually for several
iterations, and also in the next load step. Meanwhile it is rotated with the body (see ``turns``).
The inner iteration solves contact and friction exactly on the small condensed system. The points that touch, stick or slip change often,
and on this system it is cheap to find them.
"""

from dataclasses import replace

import numpy as np

from twin.mechanics.balance import Balance, Body, LoadState, Problem, in_object
from twin.mechanics.body.elements import Elements, KeptStiffness
from twin.mechanics.body.linear import FrontalSolver, NotPositiveDefinite
from twin.mechanics.condensed import LARGEST_MOVE_MM, SmallContact, Tangent, first_touch, friction_substeps, substeps, update_friction
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import carry_points
from twin.mechanics.turns import Turns, turn_vectors
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

GAP_BOUND_MM = 0.01
"""Largest penetration of a contact point into the object at the end of a load step, mm."""
RESIDUAL_TOLERANCE = 1e-5
"""Convergence threshold: norm of the residual relative to the sum of the contact forces."""
_ROUGH_TOLERANCE = 1e-2
"""Convergence threshold, relative in the same way, of the solution before the substeps of friction: these change the anchors, and with them
the solution by more than this. A tangent is rotated only above this residual."""
_PENALTY_GROWTH = 4.0
"""Factor by which the penalty grows if a point penetrates by more than ``GAP_BOUND_MM``."""
_PENALTY_RAISES = 5
"""Largest number of solutions in one load step. Each of them has a larger penalty or more contact points than the one before."""
_ITERATIONS = 30
"""Largest number of outer iterations of one solution."""
_INNER_ITERATIONS = 400
"""Largest number of inner iterations of one solution, summed over its outer iterations. If the points in contact still change after
these, shorter load steps are faster."""
_WORSE = 2.0
"""A move is rejected if it increases the norm of the residual by more than this factor."""
_KEEP_TANGENT = 0.9
"""An old tangent is used again as long as each move with it reduces the norm of the residual at least by this factor."""
_SECANTS = 6
"""Largest number of earlier residuals that the outer iteration combines."""
_SMALLEST_SHIFT_N_MM = 0.01
"""Smallest shift of the tangent's diagonal, N/mm. The diagonal is shifted if a new tangent leads to rejected moves, or is not positive
definite."""
_SHIFT_GROWTH = 8
"""Factor from one shift of the diagonal to the next."""
_LARGEST_SHIFT_N_MM = 50.0
"""Largest shift of the diagonal, N/mm. A load step that needs a larger one counts as not converged."""
_PROVIDED_MM = 1.0
"""Distance to the object, mm, below which the skin's controls are not eliminated from the tangent. They are then available in the next load
steps without a new symbolic elimination."""
_SKIN_STRAIN = 0.01
"""The skin's blocks of a tangent are computed again where an entry of F has changed by more than this. With 0.02 the solution takes 5 %
more iterations."""
_GEL_STRAIN = 0.05
"""The gel's blocks of a tangent are computed again where an entry of F has changed by more than this. The limit is larger than the skin's,
because the gel is much softer."""
_LEAST_TURN = 0.005
"""The tangent is rotated again when an entry of a control's rotation matrix has changed by more than this since the last time."""
_REACH_MM = 0.15
"""Distance to the object, mm, beyond which contact points are omitted from the equations. At the end of the step it is checked that none of
them touches."""
_SOLVED_REACH_MM = 0.02
"""Distance to the object, mm, beyond which contact points are omitted once the step is solved except for friction within it."""


class NoConvergence(Exception):
    """A load step did not converge; ``relative`` is the relative residual reached."""

    def __init__(self, relative: float) -> None:
        super().__init__(relative)
        self.relative = relative


class _Secants:
    """Anderson acceleration of the outer iteration while it uses an old tangent (Anderson 1965).

    The tangent K approximates the elastic force by K x + c, and each iteration solves the contact with the latest c. At the solution x the
    exact elastic force corresponds to the constant c + r, where r is the residual. The next c is a combination of the earlier constants
    with coefficients that sum to 1; they are the ones with which the combined residual has the smallest norm.
    """

    def __init__(self, residual: FloatArray) -> None:
        self._offset = residual
        self._seen = [(residual, residual)]

    def correction(self, residual: FloatArray) -> FloatArray:
        """Correction (unknowns,) to add to the elastic force at the present state, from the residual (unknowns,) there."""
        offset = self._offset + residual
        errors = np.column_stack([residual - old for _, old in self._seen])
        shares = np.linalg.lstsq(errors, residual, rcond=1e-6)[0]
        mend = -np.column_stack([offset - old for old, _ in self._seen]) @ shares
        self._seen = [*self._seen[1 - _SECANTS :], (offset, residual)]
        self._offset = offset + mend
        return mend


class LoadStepper:
    """Solves load steps of one contact.

    Parameters
    ----------
    body : Body
    boxes : list of (m, 4) int
        Place of each element in the grid, for each kind of elements (see ``FrontalSolver``).
    field : ObjectField
    law : ContactLaw
    """

    def __init__(self, body: Body, boxes: list[IntArray], field: ObjectField, law: ContactLaw) -> None:
        self._body, self._boxes, self._field, self._law = body, boxes, field, law
        self._stiffness = [KeptStiffness(kind, _GEL_STRAIN if number else _SKIN_STRAIN) for number, kind in enumerate(body.kinds)]
        self._frontal: FrontalSolver | None = None
        self._kept: BoolArray = np.zeros(len(body.free), bool)
        self._local: IntArray = np.zeros((0, 9), int)
        self._tangent: Tangent | None = None
        self._shift = 0.0
        self._turns = Turns(body)
        self._last: LoadState | None = None
        self.iterations, self.inner_iterations, self.eliminations = 0, 0, 0

    def step(self, state: LoadState, T: FloatArray, kinds: tuple[Elements, ...]) -> tuple[LoadState, Balance, IntArray]:
        """The converged state with the object at ``T`` (4, 4); no contact point penetrates by more than ``GAP_BOUND_MM``.

        ``kinds`` are the body's elements: those of a viscoelastic material depend on its past and on the step's duration.
        The method also returns the balance of the equations at that state, and the indices (q,) int of the contact points in them.

        Raises
        ------
        NoConvergence
        """
        self._body = replace(self._body, kinds=kinds)
        control, border = self._extrapolate(state, T)
        before = self._points_in_object_frame(state.control_mm, state.border, state.T)
        after = self._points_in_object_frame(control, border, T)
        gap = self._field.distance(after)
        looked = np.flatnonzero((gap < _REACH_MM) | state.held)
        self._provide(looked, gap)
        anchors = first_touch(state.held, state.anchor_mm, before, after, state.gap_mm, gap)
        memory = replace(state, T=T, anchor_mm=anchors, dissipated_nmm=0.0)

        known = control is not state.control_mm
        touched, count = state.held | ((state.gap_mm > 0) & (gap < 0)), 1
        if self._law.friction.static and (touched & ~state.held).any():
            moved = carry_points(self._body.points.positions(state.control_mm)[touched], state.T, T)
            count = substeps(float(np.linalg.norm(moved, axis=1).max(initial=0.0)))
        balance: Balance | None = None
        if count > 1:
            problem = Problem(self._body, self._field, self._law, memory, looked)
            balance = self._solve(problem, problem.balance(control, border), known, tolerance=_ROUGH_TOLERANCE)
            known = True
            gap_now = self._field.distance(self._points_in_object_frame(balance.control_mm, balance.border, T))
            looked = np.flatnonzero((gap_now < _SOLVED_REACH_MM) | state.held)
            self._provide(looked, gap_now)
            problem = Problem(self._body, self._field, self._law, memory, looked)
            balance = problem.again(balance)
            if self._tangent is None:
                self._tangent = self._linearise(problem, balance, 0.0)
            self._turn(self._tangent, balance.control_mm)
            memory = friction_substeps(problem, state, anchors, self._tangent, balance, count) or memory
        for _ in range(_PENALTY_RAISES):
            problem = Problem(self._body, self._field, self._law, memory, looked)
            balance = self._solve(problem, problem.again(balance) if balance else problem.balance(control, border), known)
            gap_seen = self._field.distance(self._points_in_object_frame(balance.control_mm, balance.border, T))
            missed = gap_seen < 0
            missed[looked] = False
            if missed.any():
                looked = np.sort(np.concatenate([looked, np.flatnonzero(missed)]))
                self._provide(looked, gap)
            elif balance.contact.penetration_mm.max(initial=0.0) > GAP_BOUND_MM:
                memory = replace(memory, penalty_mpa_mm=_PENALTY_GROWTH * memory.penalty_mpa_mm)
            else:
                self._last = state
                return self._accept_step(memory, problem, balance, gap_seen), balance, looked
        raise NoConvergence(balance.relative if balance else np.inf)

    def _provide(self, looked: IntArray, gap: FloatArray) -> None:
        """Prepare the elimination for contact at the candidate points (q,); ``gap`` (p,) in mm are the distances of all points."""
        controls, free = self._body.points.controls, self._body.free
        needed = np.zeros(len(free), bool)
        needed[controls[looked]] = True
        needed &= free
        if self._frontal is not None and not (needed & ~self._kept).any():
            return
        needed[controls[gap < _PROVIDED_MM]] = True
        self._kept = needed & free
        self._frontal = FrontalSolver([kind.cells.controls for kind in self._body.kinds], self._boxes, ~free, self._kept)
        self._local = np.where(self._kept, np.cumsum(self._kept) - 1, -1)[controls]
        self._tangent = None

    def _extrapolate(self, state: LoadState, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Initial guess of controls and border: an extrapolation of the last step, or the present state if the direction of motion changed.

        If the extrapolation turns an element inside out, the load step does not converge. A shorter step then extrapolates less far.
        """
        old, at = self._last, self._body.points.positions(state.control_mm)[state.held]
        if old is None or not old.held.any() or not len(at):  # the first contact does not grow in proportion to the motion
            return state.control_mm, state.border
        before, now = carry_points(at, old.T, state.T).ravel(), carry_points(at, state.T, T).ravel()
        ratio = (before @ now) / max(float(before @ before), 1e-300)
        if before @ now < 0.95 * np.linalg.norm(before) * np.linalg.norm(now) or ratio > 2:
            return state.control_mm, state.border
        return state.control_mm + ratio * (state.control_mm - old.control_mm), state.border

    def _accept_step(self, state: LoadState, problem: Problem, balance: Balance, gap: FloatArray) -> LoadState:
        """The state at the end of a converged step.

        ``state`` contains the history of friction, ``gap`` (p,) the distances of all contact points from the object in mm.
        """
        contact, looked, count = balance.contact, problem.looked, len(state.held)
        held, anchor, slid, limit = np.zeros(count, bool), np.zeros((count, 3)), np.zeros(count), np.zeros(count)
        held[looked] = contact.penetration_mm > 0
        before = state.gap_mm[looked]
        anchor[looked], slid[looked], limit[looked], lost = update_friction(problem, contact, state.limit_n[looked], before, gap[looked])
        energies = balance.elastic_nmm, state.dissipated_nmm + lost
        return LoadState(balance.control_mm, balance.border, anchor, held, slid, limit, gap, state.penalty_mpa_mm, problem.T, *energies)

    def _turn(self, tangent: Tangent, control: FloatArray) -> bool:
        """Rotate the tangent with the body to the state ``control``; True if the rotation changed."""
        turns = self._turns.since(tangent.strains, control)
        if np.abs(turns - (np.eye(3) if tangent.turns is None else tangent.turns)).max() <= _LEAST_TURN:
            return False
        tangent.turn(turns)
        return True

    def _points_in_object_frame(self, control: FloatArray, border: FloatArray, T: FloatArray) -> FloatArray:
        """All contact points in the object's frame, (p, 3)."""
        return in_object(self._body.points.positions(control), T, border)

    def _solve(self, problem: Problem, balance: Balance | None, extrapolated: bool, *, tolerance: float = RESIDUAL_TOLERANCE) -> Balance:
        """The balance that the iterations reach from the given one, whose residual is small enough."""
        if balance is None:
            raise NoConvergence(np.inf)
        astray = False
        tangent, fresh, shift, last, accepted = self._tangent, False, 0.0, np.inf, 0
        secants: _Secants | None = None
        most_inner = self.inner_iterations + _INNER_ITERATIONS
        for _ in range(_ITERATIONS):
            if balance.relative <= tolerance:
                return balance
            if self.inner_iterations > most_inner:
                break
            self.iterations += 1
            if tangent is None or (not fresh and balance.absolute > _KEEP_TANGENT * last) or shift != self._shift:
                self._tangent = tangent = self._linearise(problem, balance, shift)
                self._shift, fresh, secants = shift, True, None
            else:
                fresh = False
                if balance.relative > _ROUGH_TOLERANCE and self._turn(tangent, balance.control_mm):
                    secants = None
            elastic = balance.elastic + secants.correction(balance.residual) if secants else balance.elastic
            secants = secants or _Secants(balance.residual)
            soften = astray or not (accepted or extrapolated)
            move, border_move = self._contact_move(problem, tangent, balance, elastic, soften)
            size = min(1.0, LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
            new = balance.control_mm.copy()
            new[self._body.free] += size * move.reshape(-1, 3)
            trial = problem.balance(new, balance.border + size * border_move)
            # the first move contains the object's motion, so its residual may have any size; later moves may not increase it much
            if trial is None or size < 1 or (accepted and trial.absolute > _WORSE * balance.absolute):
                astray, secants = True, None
                if not fresh:
                    last = 0.0  # the old tangent may be the cause: this forces a new one before any shift
                else:
                    shift = max(_SHIFT_GROWTH * shift, _SMALLEST_SHIFT_N_MM)
                    if shift > _LARGEST_SHIFT_N_MM:
                        raise NoConvergence(balance.relative)
                continue
            shift, astray = 0.0, False
            last, accepted, balance = balance.absolute, accepted + 1, trial
        if balance.relative <= tolerance:
            return balance
        raise NoConvergence(balance.relative)

    def _linearise(self, problem: Problem, at: Balance, shift: float) -> Tangent:
        """The body's tangent at a state, with a shift added to its diagonal."""
        frontal = self._frontal
        assert frontal is not None, "provide first"
        self.eliminations += 1
        self._tangent = None  # the elimination below overwrites its memory
        problem.stiffness(at, self._stiffness, fresh=shift > 0)
        blocks = [kept.blocks for kept in self._stiffness]
        while True:
            try:
                lower = frontal.eliminate(blocks, shift=shift)
                break
            except NotPositiveDefinite:
                shift = max(_SHIFT_GROWTH * shift, _SMALLEST_SHIFT_N_MM)
                if shift > _LARGEST_SHIFT_N_MM:
                    raise NoConvergence(np.inf) from None
        column = np.zeros_like(at.control_mm)
        if self._body.sealed:
            problem.volume(at.control_mm, column)
        column = frontal.forward(column[self._body.free].ravel())
        inner, strains = column[frontal.inner], self._turns.strains(at.control_mm)
        matrix = lower + lower.T
        np.fill_diagonal(matrix, lower.diagonal() + np.float32(shift))
        return Tangent(frontal, matrix, column, -float(inner @ inner), strains, self._local)

    def _contact_move(
        self, problem: Problem, tangent: Tangent, balance: Balance, elastic: FloatArray, soften: bool
    ) -> tuple[FloatArray, FloatArray]:
        """The move of the controls (unknowns,) and of the border (2,) that balances the linearised body with the exact contact."""
        eliminated = tangent.eliminated
        kept = eliminated.kept
        forward, volume_residual = tangent.forward(elastic, balance.border_residual[1])
        small = SmallContact(problem, tangent, forward[kept], volume_residual, balance)
        kept_move, border_move = small.solve(balance, soften=soften, least=0.1 * RESIDUAL_TOLERANCE)
        self.inner_iterations += small.iterations
        move = eliminated.backward(-(forward + border_move[1] * tangent.volume_column), kept_move)
        return turn_vectors(tangent.turns, move), border_move
