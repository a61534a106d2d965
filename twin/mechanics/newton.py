"""One load step: from a converged state to the next one, the object moved.

Two iterations are nested. The outer one is Newton's method on the elastic body. Its tangent is eliminated
down to the controls of the outer skin that the object may touch, and is kept as long as it converges well enough
(usually for several iterations, and from one load step into the next); it turns with the body meanwhile (see ``turns``).
The inner one solves contact and friction exactly on the small dense problem that remains: which points touch, stick or slip
changes often, and is cheap to find there.
"""

from dataclasses import replace

import numpy as np

from twin.mechanics.balance import Balance, Body, Friction, LoadState, Problem, in_object
from twin.mechanics.condensed import LARGEST_MOVE_MM, Near, SmallContact, Tangent
from twin.mechanics.contact import touching_mm2
from twin.mechanics.elements import KeptStiffness
from twin.mechanics.linear import FrontalSolver, NotPositiveDefinite, whole
from twin.mechanics.path import carried
from twin.mechanics.rubbing import met, rub, rubbed, substeps
from twin.mechanics.turns import Turns, turned, turned_back
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

GAP_BOUND_MM = 0.01
"""No contact point ends deeper inside the object than this."""
RESIDUAL_TOLERANCE = 1e-5
"""A step is solved when the norm of the residual is at most this share of the sum of the contact forces."""
_ROUGH_TOLERANCE = 1e-2
"""The same where friction within the step is still to be followed: anchors then change the solution by more."""
_PENALTY_GROWTH = 4.0
"""Factor on the penalty when a point ends too deep."""
_PENALTY_RAISES = 5
"""Most solutions of one step: with a larger penalty, or with more contact points, than the one before."""
_ITERATIONS = 30
"""Most outer iterations of one solution."""
_INNER_ITERATIONS = 400
"""Most inner iterations of one solution, all outer ones together. Where contact flickers for longer, shorter load steps are faster."""
_WORSE = 2.0
"""A move that makes the residual larger than this many times is refused."""
_KEEP_TANGENT = 0.9
"""An old tangent is kept as long as it lowers the residual to this share or less."""
_SECANTS = 6
"""Most earlier residuals that the outer iteration combines."""
_SMALLEST_SHIFT_N_MM = 0.01
"""First shift on the diagonal of a tangent that leads to refused moves, or is not positive definite (N/mm)."""
_SHIFT_GROWTH = 8
"""Factor from one shift to the next."""
_LARGEST_SHIFT_N_MM = 50.0
"""Largest diagonal shift, N/mm. A step that needs more counts as not solved."""
_PROVIDED_MM = 1.0
"""Skin that is nearer to the object than this is kept in the elimination, so that it need not be prepared anew in the next load steps."""
_SKIN_STRAIN = 0.01
"""The skin's blocks of a tangent are made anew where F has changed by more than this. With 0.02 the solution takes 5 % more iterations."""
_GEL_STRAIN = 0.05
"""The same for the gel, which is so much softer that its tangent may be older."""
_LEAST_TURN = 0.005
"""The tangent is turned when a direction of a control has changed by more than this since it was last turned (rad)."""
_REACH_MM = 0.15
"""Contact points farther than this from the object are left out of the equations; at the end it is checked that none of them touches."""
_SOLVED_REACH_MM = 0.02
"""The same where the step is solved but for friction within it."""


class NoConvergence(Exception):
    """A load step was not solved; ``relative`` is the relative residual reached."""

    def __init__(self, relative: float) -> None:
        super().__init__(relative)
        self.relative = relative


class _Secants:
    """What the outer iteration has learnt about the error of a tangent that it keeps (Anderson 1965).

    With a tangent K the body is K x + c, and each iteration solves the contact for the last c. At the solution x the elastic force
    says c + r, r being the residual. The next c is the combination of those seen so far whose residuals, combined alike, are smallest.
    """

    def __init__(self, residual: FloatArray) -> None:
        self._offset = residual
        self._seen = [(residual, residual)]

    def mend(self, residual: FloatArray) -> FloatArray:
        """What to add to the elastic force at the present state, whose residual is given, (unknowns,)."""
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
        Where each element of each kind lies (see ``FrontalSolver``).
    field : ObjectField
    friction : Friction
    compliance_mm_per_n : float
    """

    def __init__(self, body: Body, boxes: list[IntArray], field: ObjectField, friction: Friction, compliance_mm_per_n: float) -> None:
        self._body, self._boxes, self._field, self._friction = body, boxes, field, friction
        self._compliance = compliance_mm_per_n
        self._stiffness = [KeptStiffness(kind, _GEL_STRAIN if number else _SKIN_STRAIN) for number, kind in enumerate(body.kinds)]
        self._frontal: FrontalSolver | None = None
        self._kept: BoolArray = np.zeros(len(body.free), bool)
        self._local: IntArray = np.zeros((0, 9), int)
        self._tangent: Tangent | None = None
        self._shift = 0.0
        self._near: tuple[Tangent, IntArray, Near] | None = None
        self._turns = Turns(body)
        self._turned: FloatArray | None = None  # of each free control since the tangent was made; None where it is new
        self._near_turned: tuple[FloatArray, Near] | None = None
        self._forward: tuple[FloatArray, Tangent, FloatArray | None, FloatArray] | None = None
        self._touch: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._last: LoadState | None = None
        self.iterations, self.inner_iterations, self.eliminations = 0, 0, 0

    def follow(self, body: Body) -> None:
        """Go on with changed elements (a relaxing material's law is scaled by the step's duration)."""
        self._body = body

    def step(self, state: LoadState, T: FloatArray, given: list[FloatArray]) -> tuple[LoadState, Balance, IntArray]:
        """The converged state with the object at ``T``, no contact point deeper than the bound.

        ``given``: stress left of the past, for each kind of elements (see ``Elements.add_forces``).
        Also returns the equations' last balance and which contact points it looked at, (q,) int.

        Raises
        ------
        NoConvergence
        """
        control, border = self._extrapolate(state, T)
        before, gap_before = self._gaps(state)
        after = self._seen(control, border, T)
        gap = self._field.distance(after)
        looked = np.flatnonzero((gap < _REACH_MM) | state.held)
        self._provide(looked, gap)
        anchors = met(state.held, state.anchor_mm, before, after, gap_before, gap)
        memory = replace(state, dissipated_nmm=0.0)
        penalty = state.penalty_mpa_mm

        def problem_now() -> Problem:
            return Problem(
                self._body,
                self._field,
                self._friction,
                self._compliance,
                memory,
                anchor_mm=anchors,
                looked=looked,
                penalty=penalty,
                T=T,
                given=given,
            )

        known = control is not state.control_mm
        touched = state.held | ((gap_before > 0) & (gap < 0))
        count = substeps(self._moved_mm(state, T, touched)) if self._friction.static and (touched & ~state.held).any() else 1
        balance: Balance | None = None
        if count > 1:
            problem = problem_now()
            control, border, balance = self._solve(problem, control, border, known, tolerance=_ROUGH_TOLERANCE)
            known = True
            gap_now = self._field.distance(self._seen(control, border, T))
            looked = np.flatnonzero((gap_now < _SOLVED_REACH_MM) | state.held)
            self._provide(looked, gap_now)
            problem = problem_now()
            balance = problem.again(balance, control, border)
            found = self._rubbed(problem, state, anchors, control, border, balance, count)
            if found is not None:
                memory, anchors = found, found.anchor_mm
        for _ in range(_PENALTY_RAISES):
            problem = problem_now()
            control, border, balance = self._solve(problem, control, border, known, before=balance)
            seen = self._seen(control, border, T)
            gap_seen = self._field.distance(seen)
            missed = gap_seen < 0
            missed[looked] = False
            if missed.any():
                looked = np.sort(np.concatenate([looked, np.flatnonzero(missed)]))
                self._provide(looked, gap)
            elif balance.contact.penetration_mm.max(initial=0.0) > GAP_BOUND_MM:
                penalty *= _PENALTY_GROWTH
            else:
                self._last, self._touch = state, (control, seen, gap_seen)
                return self._accepted(memory, problem, control, border, balance, gap_seen), balance, looked
        raise NoConvergence(balance.relative if balance else np.inf)

    def touching_mm2(self, state: LoadState) -> float:
        """Rest area of the skin that touches the object in a state (see ``contact.touching_mm2``)."""
        return touching_mm2(self._body.points, self._gaps(state)[1])

    def _gaps(self, state: LoadState) -> tuple[FloatArray, FloatArray]:
        """All contact points in the object's frame, (p, 3), and their distances from it, (p,); those of the last state are kept."""
        if self._touch is not None and self._touch[0] is state.control_mm:
            return self._touch[1:]
        seen = self._seen(state.control_mm, state.border, state.T)
        return seen, self._field.distance(seen)

    def _provide(self, looked: IntArray, gap: FloatArray) -> None:
        """Prepare the elimination for contact at the points looked at (q,); ``gap`` (p,) in mm are the distances of all points."""
        controls, free = self._body.points.controls, self._body.free
        needed = np.zeros(len(free), bool)
        needed[controls[looked]] = True
        needed &= free
        if self._frontal is not None and not (needed & ~self._kept).any():
            return
        kept = needed.copy()
        kept[controls[gap < _PROVIDED_MM]] = True
        self._kept = kept & free
        self._frontal = FrontalSolver([kind.cells.controls for kind in self._body.kinds], self._boxes, ~free, self._kept)
        self._local = np.where(self._kept, np.cumsum(self._kept) - 1, -1)[controls]
        self._tangent = self._near = None

    def _extrapolate(self, state: LoadState, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Controls and border to start from: the last step continued, or the present state if the object moves another way now.

        If the continued step turns an element inside out, the load step is not solved; a shorter one then continues less far.
        """
        if self._last is None or not self._last.held.any():  # a first contact does not grow in proportion to the motion
            return state.control_mm, state.border
        old, at = self._last, self._body.points.positions(state.control_mm)[state.held]
        if not len(at):
            return state.control_mm, state.border

        before, now = carried(at, old.T, state.T).ravel(), carried(at, state.T, T).ravel()
        ratio = (before @ now) / max(float(before @ before), 1e-300)
        if before @ now < 0.95 * np.linalg.norm(before) * np.linalg.norm(now) or ratio > 2:
            return state.control_mm, state.border
        return state.control_mm + ratio * (state.control_mm - old.control_mm), state.border

    def _accepted(
        self, state: LoadState, problem: Problem, control: FloatArray, border: FloatArray, balance: Balance, gap: FloatArray
    ) -> LoadState:
        """The state that a solved step ends in. ``state`` says what friction remembers, ``gap`` (p,) in mm where all points are."""
        contact, looked, count = balance.contact, problem.looked, len(state.held)
        held, anchor, slid, limit = np.zeros(count, bool), np.zeros((count, 3)), np.zeros(count), np.zeros(count)
        held[looked] = contact.penetration_mm > 0
        before = state.gap_mm[looked]
        anchor[looked], slid[looked], limit[looked], lost = rub(problem, contact, state.limit_n[looked], before, gap[looked])
        return LoadState(
            control, border, anchor, held, slid, limit, gap, problem.penalty, problem.T, balance.elastic_nmm, state.dissipated_nmm + lost
        )

    def _moved_mm(self, state: LoadState, T: FloatArray, which: BoolArray) -> float:
        """How far the object moves in a step to ``T`` (4, 4), seen from those of all points (p,)."""
        at = self._body.points.positions(state.control_mm)[which]
        return float(np.linalg.norm(carried(at, state.T, T), axis=1).max(initial=0.0))

    def _rubbed(
        self,
        problem: Problem,
        state: LoadState,
        anchors: FloatArray,
        control: FloatArray,
        border: FloatArray,
        balance: Balance,
        count: int,
    ) -> LoadState | None:
        """What friction did within the step (see ``rubbing.rubbed``)."""
        if self._tangent is None:
            self._tangent = self._linearise(problem, control, border, 0.0)
        self._turn(self._tangent, control)
        near, local = self._nearest(problem, self._tangent), self._local[problem.looked]
        forward = self._eliminated(self._tangent, balance.elastic)
        return rubbed(
            problem, state, anchors, self._field, near, self._tangent, self._turned, forward, local, control, border, balance, count=count
        )

    def _nearest(self, problem: Problem, tangent: Tangent) -> Near:
        """The tangent eliminated down to the points looked at; the last one is kept."""
        if self._near is None or self._near[0] is not tangent or not np.array_equal(self._near[1], problem.looked):
            self._near = tangent, problem.looked, Near.of(tangent, self._local[problem.looked])
            self._near_turned = None
        if self._turned is None:
            return self._near[2]
        if self._near_turned is None or self._near_turned[0] is not self._turned:
            last = self._near_turned[1] if self._near_turned else self._near[2]
            near = self._near[2].turned(self._turned[tangent.eliminated.kept[::3] // 3])
            near.solved = last.solved
            self._near_turned = self._turned, near
        return self._near_turned[1]

    def _turn(self, tangent: Tangent, control: FloatArray) -> bool:
        """Turn the tangent with the body to a state; whether that changed it."""
        turns = self._turns.since(tangent.strains, control)
        if np.abs(turns - (np.eye(3) if self._turned is None else self._turned)).max() <= _LEAST_TURN:
            return False
        self._turned = turns
        return True

    def _seen(self, control: FloatArray, border: FloatArray, T: FloatArray) -> FloatArray:
        """All contact points in the object's frame, (p, 3)."""
        return in_object(self._body.points.positions(control), T, border)

    def _solve(
        self,
        problem: Problem,
        control: FloatArray,
        border: FloatArray,
        extrapolated: bool,
        *,
        tolerance: float = RESIDUAL_TOLERANCE,
        before: Balance | None = None,
    ) -> tuple[FloatArray, FloatArray, Balance]:
        balance = problem.balance(control, border) if before is None else problem.again(before, control, border)
        if balance is None:
            raise NoConvergence(np.inf)
        astray = False
        tangent, fresh, shift, last, accepted = self._tangent, False, 0.0, np.inf, 0
        secants: _Secants | None = None
        most_inner = self.inner_iterations + _INNER_ITERATIONS
        for _ in range(_ITERATIONS):
            if balance.relative <= tolerance:
                return control, border, balance
            if self.inner_iterations > most_inner:
                break
            self.iterations += 1
            if tangent is None or (not fresh and balance.absolute > _KEEP_TANGENT * last) or shift != self._shift:
                self._tangent = tangent = self._linearise(problem, control, border, shift)
                self._shift, fresh, secants = shift, True, None
            else:
                fresh = False
                if balance.relative > _ROUGH_TOLERANCE and self._turn(tangent, control):
                    secants = None
            elastic = balance.elastic + secants.mend(balance.residual) if secants else balance.elastic
            secants = secants or _Secants(balance.residual)
            soften = astray or not (accepted or extrapolated)
            move, border_move = self._contact_move(problem, tangent, control, border, balance, elastic, soften)
            size = min(1.0, LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
            new, new_border = control.copy(), border + size * border_move
            new[self._body.free] += size * move.reshape(-1, 3)
            trial = problem.balance(new, new_border)
            # the first move takes up the object's motion, and its residual may be of any size; no later one may
            if trial is None or size < 1 or (accepted and trial.absolute > _WORSE * balance.absolute):
                astray, secants = True, None
                if not fresh:
                    last = 0.0  # first the old tangent is suspected: make a new one
                else:
                    shift = max(_SHIFT_GROWTH * shift, _SMALLEST_SHIFT_N_MM)
                    if shift > _LARGEST_SHIFT_N_MM:
                        raise NoConvergence(balance.relative)
                continue
            shift, astray = 0.0, False
            last, accepted = balance.absolute, accepted + 1
            control, border, balance = new, new_border, trial
        if balance.relative <= tolerance:
            return control, border, balance
        raise NoConvergence(balance.relative)

    def _linearise(self, problem: Problem, control: FloatArray, border: FloatArray, shift: float) -> Tangent:
        """The body's tangent at a state, plus a shift on the diagonal."""
        assert self._frontal is not None, "provide first"
        self.eliminations += 1
        self._tangent = self._turned = None  # its memory is overwritten below
        problem.stiffness(control, border, self._stiffness, anew=shift > 0)
        blocks = [kept.blocks for kept in self._stiffness]
        while True:
            try:
                eliminated = self._frontal.eliminate(blocks, shift=shift)
                break
            except NotPositiveDefinite:
                shift = max(_SHIFT_GROWTH * shift, _SMALLEST_SHIFT_N_MM)
                if shift > _LARGEST_SHIFT_N_MM:
                    raise NoConvergence(np.inf) from None
        matrix, strains = whole(eliminated.matrix, shift), self._turns.strains(control)
        if not self._body.sealed:
            return Tangent(eliminated, matrix, None, 0.0, strains)
        column = np.zeros_like(control)
        problem.volume(control, column)
        column = eliminated.forward(column[self._body.free].ravel())
        inner = np.ones(len(column), bool)
        inner[eliminated.kept] = False
        return Tangent(eliminated, matrix, column, -float(column[inner] @ column[inner]), strains)

    def _eliminated(self, tangent: Tangent, elastic: FloatArray) -> FloatArray:
        """Elastic force (unknowns,), turned back to where the tangent was made and eliminated; the last one is kept."""
        kept, turns = self._forward, self._turned
        if kept is None or kept[0] is not elastic or kept[1] is not tangent or kept[2] is not turns:
            forward = tangent.eliminated.forward(elastic if turns is None else turned_back(turns, elastic))
            self._forward = kept = elastic, tangent, turns, forward
        return kept[3]

    def _contact_move(
        self,
        problem: Problem,
        tangent: Tangent,
        control: FloatArray,
        border: FloatArray,
        balance: Balance,
        elastic: FloatArray,
        soften: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """The move (unknowns,) and (2,) that balances the linearised body with the exact contact."""
        eliminated = tangent.eliminated
        kept = eliminated.kept
        forward, turns = self._eliminated(tangent, elastic), self._turned
        volume_residual, near = balance.border_residual[1], self._nearest(problem, tangent)
        if tangent.volume_column is not None:
            inner = np.ones(len(forward), bool)
            inner[kept] = False
            volume_residual = volume_residual - tangent.volume_column[inner] @ forward[inner]
        small = SmallContact(problem, near, tangent.volume_pivot, forward[kept], volume_residual, control, border)
        kept_move, border_move = small.solve(balance, soften=soften, least=0.1 * RESIDUAL_TOLERANCE)
        self.inner_iterations += small.iterations
        if tangent.volume_column is not None:
            forward = forward + border_move[1] * tangent.volume_column
        move = eliminated.backward(-forward, kept_move)
        return move if turns is None else turned(turns, move), border_move
