"""One load step: from a converged state to the next one, the object moved.

Three stages. A tangent predictor carries the skin along with the object. A minimiser with the
friction limits frozen (a potential: Newton directions made descending by a diagonal shift, Armijo
line search) comes close from anywhere. Newton's method on the exact, unsymmetric Coulomb law
finishes; where it does not, the limits are thawed, frozen anew, and both are repeated.
"""

from dataclasses import dataclass

import numpy as np

from twin.mechanics.contact import Anchors, ContactForces, ContactPoints, contact_forces, spread_forces, spread_stiffness
from twin.mechanics.elements import ElementTable, elastic_energy, elastic_forces, elastic_stiffness
from twin.mechanics.linear import FrontalSolver, NotPositiveDefinite

GAP_BOUND_MM = 0.01  # no contact point ends deeper inside the object
RESIDUAL_TOLERANCE = 1e-7  # of the sum of the contact forces
_FORCE_FLOOR_N = 1e-3  # the residual's scale is never less
_CLOSE = 1e-2  # relative residual at which the minimiser hands over at first, then
_CLOSER = 0.1  # times that in each round
_PENALTY_GROWTH, _PENALTY_RAISES = 4.0, 5
_ROUNDS = 8
_MINIMISER_ITERATIONS, _NEWTON_ITERATIONS = 25, 12
_LARGEST_MOVE_MM = 1.0  # of a node in one iteration
_SMALLEST_SHIFT_N_MM = 1e-3


class NoConvergence(Exception):
    """A load step was not solved; ``relative`` is the relative residual reached."""

    def __init__(self, relative: float):
        super().__init__(relative)
        self.relative = relative


@dataclass(frozen=True)
class Body:
    """What a sensor brings to every contact."""

    elements: ElementTable
    points: ContactPoints
    frontal: FrontalSolver
    free: np.ndarray


@dataclass(frozen=True)
class LoadState:
    """A converged state.

    Attributes
    ----------
    nodes_mm : (n, 3) float
    yield_mm : float
        How far the object has given way along z.
    anchors : Anchors
    normal_n : (p,) float
        Normal force at the contact points.
    penalty_mpa_mm : float
    T : (4, 4) float
        The object's pose before it gave way.
    """

    nodes_mm: np.ndarray
    yield_mm: float
    anchors: Anchors
    normal_n: np.ndarray
    penalty_mpa_mm: float
    T: np.ndarray


@dataclass(frozen=True)
class Balance:
    """The equations at a trial state.

    Attributes
    ----------
    residual : (unknowns,) float
        Elastic minus contact force on the free nodes; ``yield_residual_n`` that of yield / compliance = force.
    contact : ContactForces
        In the object's frame; ``point_force_n`` (p, 3) the same forces in the sensor's.
    scale_n : float
        Sum of the contact forces.
    """

    residual: np.ndarray
    yield_residual_n: float
    contact: ContactForces
    point_force_n: np.ndarray
    scale_n: float

    @property
    def absolute(self) -> float:
        """Norm of the residual in N."""
        return float(np.hypot(np.linalg.norm(self.residual), self.yield_residual_n))

    @property
    def relative(self) -> float:
        """Norm of the residual over the sum of the contact forces."""
        return self.absolute / self.scale_n

    def work(self, move: np.ndarray, yield_move: float) -> float:
        """Residual times a move: the slope of the energy along it."""
        return float(self.residual @ move + self.yield_residual_n * yield_move)


class LoadStepper:
    """Solves load steps of one contact.

    Parameters
    ----------
    body : Body
    stimulus : Stimulus
    friction : float
    compliance_mm_per_n : float
    """

    def __init__(self, body: Body, stimulus, friction: float, compliance_mm_per_n: float):
        self._body, self._stimulus = body, stimulus
        self._friction, self._compliance = friction, compliance_mm_per_n
        self._blocks = np.zeros((len(body.elements.hexes), 24, 24))

    def step(self, state: LoadState, T: np.ndarray) -> tuple[LoadState, Balance]:
        """The converged state with the object at ``T``, no contact point deeper than the bound.

        Raises
        ------
        NoConvergence
        """
        nodes, yielded = self._predict(state, T)
        penalty, normal = state.penalty_mpa_mm, state.normal_n
        anchors = self._anchors_at_touch(state, T, nodes, yielded)
        for _ in range(_PENALTY_RAISES):
            problem = _Problem(self, anchors, penalty, T)
            nodes, yielded, balance = self._solve(problem, nodes, yielded, normal)
            normal = balance.contact.normal_n
            if balance.contact.penetration_mm.max() <= GAP_BOUND_MM:
                return LoadState(nodes, yielded, balance.contact.anchors, normal, penalty, T), balance
            penalty *= _PENALTY_GROWTH
        raise NoConvergence(balance.relative)

    def _anchors_at_touch(self, state: LoadState, T: np.ndarray, nodes, yielded) -> Anchors:
        """Anchors with guesses for the points that may touch in this step.

        A point that the predicted step drives into the object is anchored where it meets the surface on
        the way. Any other starts from where it is: when it takes over from a neighbour that slides, it slides.
        """
        if self._friction == 0:
            return state.anchors
        points = self._body.points
        before = (points.positions(state.nodes_mm) - state.T[:3, 3] - [0, 0, state.yield_mm]) @ state.T[:3, :3]
        after = (points.positions(nodes) - T[:3, 3] - [0, 0, yielded]) @ T[:3, :3]
        gap_before, gap_after = self._stimulus.distance(before), self._stimulus.distance(after)
        driven = (gap_before > 0) & (gap_after < 0)
        share = np.where(driven, gap_before / np.where(driven, gap_before - gap_after, 1.0), 0.0)[:, None]
        guess = (1 - share) * before + share * after
        held = state.anchors.held[:, None]
        return Anchors(np.where(held, state.anchors.position_mm, guess), np.ones(len(guess), bool))

    def _solve(self, problem: "_Problem", nodes, yielded, normal):
        if self._friction == 0:
            return self._minimise(problem, nodes, yielded, None, RESIDUAL_TOLERANCE)
        for close in np.maximum(_CLOSE * _CLOSER ** np.arange(_ROUNDS), RESIDUAL_TOLERANCE):
            limit = self._friction * normal / (problem.penalty * self._body.points.area_mm2)
            nodes, yielded, balance = self._minimise(problem, nodes, yielded, limit, close)
            normal = balance.contact.normal_n
            try:
                return self._coulomb(problem, nodes, yielded)
            except NoConvergence as failure:
                relative = failure.relative
        raise NoConvergence(relative)

    def _predict(self, state: LoadState, T: np.ndarray) -> tuple[np.ndarray, float]:
        """First-order guess: contact points in touch follow the object from its pose to ``T``."""
        points = self._body.points
        if not state.normal_n.any():
            return state.nodes_mm, state.yield_mm
        problem = _Problem(self, state.anchors, state.penalty_mpa_mm, state.T)
        limit = self._friction * state.normal_n / (problem.penalty * points.area_mm2)
        stiffness = problem.stiffness(state.nodes_mm, state.yield_mm, limit)
        now = points.positions(state.nodes_mm) - [0, 0, state.yield_mm]
        carried = (now - state.T[:3, 3]) @ state.T[:3, :3] @ T[:3, :3].T + T[:3, 3] - now
        push = np.einsum("pij,pj->pi", stiffness, carried)
        pull = np.zeros_like(state.nodes_mm)
        spread_forces(points.nodes, points.weights, push, pull)
        move, yield_move, _ = self._direction(stiffness, -pull[self._body.free].ravel(), push[:, 2].sum(), symmetric=True, shift=0.0)
        size = min(1.0, 2 * _LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
        nodes, yielded = self._moved(state.nodes_mm, state.yield_mm, move, yield_move, size)
        if elastic_forces(self._body.elements, nodes) is None:
            return state.nodes_mm, state.yield_mm
        return nodes, yielded

    def _minimise(self, problem: "_Problem", nodes, yielded, limit, tolerance):
        """Descend to a minimum of the potential with the friction limits (p,) frozen."""
        balance, energy = problem.balance(nodes, yielded, limit), problem.energy(nodes, yielded, limit)
        shift = 0.0
        for _ in range(_MINIMISER_ITERATIONS):
            if balance.relative <= tolerance:
                return nodes, yielded, balance
            stiffness = problem.stiffness(nodes, yielded, limit)
            move, yield_move, shift = self._direction(stiffness, balance.residual, balance.yield_residual_n, symmetric=True, shift=shift)
            slope = balance.work(move, yield_move)
            size = min(1.0, _LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
            for _ in range(12):
                new = self._moved(nodes, yielded, move, yield_move, size)
                new_energy = problem.energy(*new, limit)
                # differences below rounding say nothing: there the residual decides
                blurred = abs(slope) * size < 1e-10 * abs(energy)
                if np.isfinite(new_energy) and (blurred or new_energy <= energy + 1e-4 * size * slope):
                    new_balance = problem.balance(*new, limit)
                    if not blurred or new_balance.absolute < balance.absolute:
                        break
                size /= 2
            else:
                raise NoConvergence(balance.relative)
            (nodes, yielded), balance, energy = new, new_balance, new_energy
        if balance.relative <= tolerance or limit is not None:
            return nodes, yielded, balance
        raise NoConvergence(balance.relative)

    def _coulomb(self, problem: "_Problem", nodes, yielded):
        """Newton's method on the exact law, from nearby."""
        balance = problem.balance(nodes, yielded)
        for _ in range(_NEWTON_ITERATIONS):
            if balance.relative <= RESIDUAL_TOLERANCE:
                return nodes, yielded, balance
            stiffness = problem.stiffness(nodes, yielded)
            symmetric = not balance.contact.slipping.any()
            move, yield_move, _ = self._direction(stiffness, balance.residual, balance.yield_residual_n, symmetric=symmetric, shift=0.0)
            slope = balance.work(move, yield_move)
            if slope >= 0:
                raise NoConvergence(balance.relative)
            size = min(1.0, _LARGEST_MOVE_MM / max(np.abs(move).max(), 1e-300))
            for _ in range(6):
                new = self._moved(nodes, yielded, move, yield_move, size)
                trial = problem.balance(*new)
                if trial and (trial.absolute < balance.absolute or abs(trial.work(move, yield_move)) < 0.8 * abs(slope)):
                    break
                size /= 2
            else:
                raise NoConvergence(balance.relative)
            (nodes, yielded), balance = new, trial
        if balance.relative <= RESIDUAL_TOLERANCE:
            return nodes, yielded, balance
        raise NoConvergence(balance.relative)

    def _moved(self, nodes, yielded, move, yield_move, size):
        out = nodes.copy()
        out[self._body.free] += size * move.reshape(-1, 3)
        return out, yielded + size * yield_move

    def _direction(self, stiffness, residual, yield_residual, *, symmetric: bool, shift: float):
        """Minus the inverse tangent times the residual; the shift that made a symmetric tangent positive definite.

        ``self._blocks`` must hold the tangent with the contact's stiffness (p, 3, 3), as ``_Problem.stiffness`` leaves it.
        """
        factors, shift = self._factor(symmetric, shift)
        if not self._compliance:
            return factors.solve(-residual), 0.0, shift
        # an object moved by w along z is points moved by -w: a bordered system, solved by its Schur complement
        body = self._body
        column, row = np.zeros((2, len(body.free), 3))
        spread_forces(body.points.nodes, body.points.weights, np.ascontiguousarray(-stiffness[:, :, 2]), column)
        spread_forces(body.points.nodes, body.points.weights, np.ascontiguousarray(-stiffness[:, 2, :]), row)
        column, row = column[body.free].ravel(), row[body.free].ravel()
        both = factors.solve(np.column_stack([-residual, column]))
        pivot = 1 / self._compliance + stiffness[:, 2, 2].sum() - row @ both[:, 1]
        yield_move = float((-yield_residual - row @ both[:, 0]) / pivot)
        return both[:, 0] - both[:, 1] * yield_move, yield_move, shift

    def _factor(self, symmetric: bool, shift: float):
        if not symmetric:
            return self._body.frontal.factor(self._blocks, symmetric=False), 0.0
        shift = shift / 4 if shift > _SMALLEST_SHIFT_N_MM else 0.0
        for _ in range(12):
            try:
                return self._body.frontal.factor(self._blocks, symmetric=True, shift=shift), shift
            except NotPositiveDefinite:
                shift = max(4 * shift, _SMALLEST_SHIFT_N_MM)
        raise NoConvergence(np.inf)


class _Problem:
    """The equations of one load step: anchors, penalty and pose held."""

    def __init__(self, stepper: LoadStepper, anchors: Anchors, penalty: float, T: np.ndarray):
        self._stepper, self.anchors, self.penalty, self._T = stepper, anchors, penalty, T

    def _contact(self, nodes, yielded, limit, *, with_stiffness: bool = False) -> ContactForces:
        own = self._stepper
        points = own._body.points
        at = (points.positions(nodes) - self._T[:3, 3] - [0, 0, yielded]) @ self._T[:3, :3]
        return contact_forces(
            points,
            at,
            own._stimulus,
            self.anchors,
            friction=own._friction,
            penalty_mpa_mm=self.penalty,
            frozen_limit_mm=limit,
            with_stiffness=with_stiffness,
        )

    def energy(self, nodes, yielded, limit) -> float:
        """Potential in N mm, infinite where an element is inside out."""
        own = self._stepper
        elastic = elastic_energy(own._body.elements, nodes)
        if not np.isfinite(elastic):
            return np.inf
        spring = yielded**2 / (2 * own._compliance) if own._compliance else 0.0
        return elastic + spring + self._contact(nodes, yielded, limit).energy_nmm

    def balance(self, nodes, yielded, limit=None) -> Balance | None:
        """Residual of the free nodes and of the object's yield; None if an element is inside out."""
        own = self._stepper
        residual = elastic_forces(own._body.elements, nodes)
        if residual is None:
            return None
        contact = self._contact(nodes, yielded, limit)
        force = contact.force_n @ self._T[:3, :3].T
        spread_forces(own._body.points.nodes, own._body.points.weights, -force, residual)
        # the skin pushes the object with -sum f
        yield_residual = yielded / own._compliance + float(force[:, 2].sum()) if own._compliance else 0.0
        scale = max(float(np.linalg.norm(force, axis=1).sum()), _FORCE_FLOOR_N)
        return Balance(residual[own._body.free].ravel(), yield_residual, contact, force, scale)

    def stiffness(self, nodes, yielded, limit=None) -> np.ndarray:
        """Assemble the tangent's element blocks; returns the contact's (p, 3, 3) in the sensor's frame."""
        own = self._stepper
        points = own._body.points
        contact = self._contact(nodes, yielded, limit, with_stiffness=True)
        turn = self._T[:3, :3]
        active = np.flatnonzero(contact.stiffness.any(axis=(1, 2)))
        stiffness = np.zeros_like(contact.stiffness)
        stiffness[active] = turn @ contact.stiffness[active] @ turn.T
        elastic_stiffness(own._body.elements, nodes, own._blocks)
        spread_stiffness(points.element, points.corner, points.weights, stiffness, active, own._blocks)
        return stiffness
