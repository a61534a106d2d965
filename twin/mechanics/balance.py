"""Equilibrium equations of one load step: elastic forces, contact forces and friction."""

from copy import copy
from dataclasses import dataclass

import numpy as np

from twin.mechanics.body.elements import Elements, KeptStiffness
from twin.mechanics.contact import ContactForces, ContactPoints, contact_forces, positions, spread_forces
from twin.mechanics.law import ContactLaw
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

FORCE_FLOOR_N = 1e-3  # least force by which a residual is divided; without contact the sum of the contact forces is 0


@dataclass(frozen=True)
class Body:
    """Finite-element model of one sensor: elements, contact points and boundary conditions.

    Attributes
    ----------
    kinds : tuple of Elements
        Skin first, then the gel.
    points : ContactPoints
    free : (n,) bool
        Controls that are not clamped.
    sealed : bool
        Whether the gel is enclosed, so that its volume is constant.
    """

    kinds: tuple[Elements, ...]
    points: ContactPoints
    free: BoolArray
    sealed: bool

    @property
    def volume_force_n_per_mm3(self) -> float:
        """Factor that converts a change of the gel's volume (mm^3) into a force (N); 0 for a gel that is not sealed.

        With it the volume residual and the force residuals have the same unit. It is mu A / V, with the gel's shear modulus mu (at
        small strain), the gel's rest volume V and the skin's area A: a change of the whole volume counts as much as a stress mu on the
        whole skin.
        """
        if not self.sealed:
            return 0.0
        shear_modulus_mpa = 2 * float(self.kinds[1].law[:2].sum())
        return shear_modulus_mpa * float(self.points.area_mm2.sum()) / sum(kind.rest_volume_mm3 for kind in self.kinds[1:])


@dataclass(frozen=True)
class LoadState:
    """State of the contact at the end of a converged load step.

    Attributes
    ----------
    control_mm : (n, 3) float
        Positions of the controls.
    border : (2,) float
        Displacement of the object along z under its compliance (mm), and the pressure of a sealed gel (MPa).
    anchor_mm : (p, 3) float
        Friction anchors of the contact points in the object's frame; meaningful where ``held (p,)``.
    held : (p,) bool
        Whether the point presses on the object, so that friction acts on it.
    slid_mm : (p,) float
        Slip since the point last stuck.
    limit_n : (p,) float
        Largest friction force that each point can bear.
    gap_mm : (p,) float
        Distance of each point from the object, negative inside.
    penalty_mpa_mm : float
        Contact pressure for a unit of penetration, MPa/mm.
    T : (4, 4) float
        The object's pose without the displacement ``border[0]``.
    elastic_nmm, dissipated_nmm : float
        Energy stored in the body, and energy lost to friction in the last load step.
    """

    control_mm: FloatArray
    border: FloatArray
    anchor_mm: FloatArray
    held: BoolArray
    slid_mm: FloatArray
    limit_n: FloatArray
    gap_mm: FloatArray
    penalty_mpa_mm: float
    T: FloatArray
    elastic_nmm: float = 0.0
    dissipated_nmm: float = 0.0


@dataclass(frozen=True)
class Balance:
    """Residuals and forces of the equilibrium equations at a trial state.

    Attributes
    ----------
    control_mm, border : (n, 3) float, (2,) float
        The trial state, as in ``LoadState``.
    elastic : (unknowns,) float
        Elastic force on the free controls.
    residual : (unknowns,) float
        Elastic force minus contact force on the free controls, N.
    border_residual : (2,) float
        Residual of displacement / compliance + force along z = 0 (N), and change of the sealed gel's volume (mm^3).
    contact : ContactForces
        Contact at the candidate points, in the object's frame.
    point_force_n : (q, 3) float
        The contact forces in the sensor's frame.
    scale_n : float
        Sum of the magnitudes of the contact forces, at least ``FORCE_FLOOR_N``.
    elastic_nmm : float
        Energy stored in the body.
    absolute : float
        Norm of all residuals in N; the gel's change of volume is converted to a force.
    """

    control_mm: FloatArray
    border: FloatArray
    elastic: FloatArray
    residual: FloatArray
    border_residual: FloatArray
    contact: ContactForces
    point_force_n: FloatArray
    scale_n: float
    elastic_nmm: float
    absolute: float

    @property
    def relative(self) -> float:
        """Norm of all residuals, divided by the sum of the contact forces."""
        return self.absolute / self.scale_n


def in_object(points_mm: FloatArray, T: FloatArray, border: FloatArray) -> FloatArray:
    """Points (k, 3) of the sensor's frame in the frame of the object at ``T``, displaced by ``border[0]`` (mm) along z."""
    return points_mm @ T[:3, :3] - (T[:3, 3] + [0, 0, border[0]]) @ T[:3, :3]


class Problem:
    """The equilibrium equations of one load step. Anchors, penalty, the object's pose and the viscoelastic stress are constant.

    Parameters
    ----------
    body : Body
    field : ObjectField
        The object that presses.
    law : ContactLaw
        Its friction, and its displacement of the object along z per N.
    state : LoadState
        State at the start of the step, with the pose and the anchors of its end. The slip of each point determines its coefficient of
        friction.
    looked : (q,) int
        Candidate points: the contact points that the equations include. The other points are assumed to be free.
    """

    def __init__(self, body: Body, field: ObjectField, law: ContactLaw, state: LoadState, looked: IntArray) -> None:
        self.body, self.field, self.T, self.looked = body, field, state.T, looked
        self.compliance, self._law = law.compliance_mm_per_n, law.friction
        self.volume_force_n_per_mm3 = body.volume_force_n_per_mm3
        points = body.points
        self.controls, self.weights = points.controls[looked], points.weights[looked]
        self.lift = points.lift_mm[looked]
        self.anchor_mm = state.anchor_mm[looked]
        self.stiff = state.penalty_mpa_mm * points.area_mm2[looked]
        self.bound_n = self._law.shear_strength_mpa * points.area_mm2[looked]
        self.slid_mm = state.slid_mm[looked]
        self.friction = self._law.after(self.slid_mm)

    def move_object(self, T: FloatArray, anchor_mm: FloatArray, slid_mm: FloatArray) -> "Problem":
        """The same equations with the object at ``T`` (4, 4), and with anchors (q, 3) and slip (q,) of the candidate points."""
        other = copy(self)
        other.T, other.anchor_mm, other.slid_mm, other.friction = T, anchor_mm, slid_mm, self._law.after(slid_mm)
        return other

    def contact(self, at: FloatArray, soften: float = 1.0) -> ContactForces:
        """Contact forces with the candidate points at positions ``at`` (q, 3) in the object's frame."""
        return contact_forces(self.field, at, self.stiff, self.anchor_mm, self.friction, self.bound_n, soften)

    def balance(self, control: FloatArray, border: FloatArray) -> Balance | None:
        """The balance at a state; None if an element is inverted (det F <= 0)."""
        body, volume = self.body, 0.0
        residual = np.zeros(control.shape)
        elastic_nmm = 0.0
        for number, kind in enumerate(body.kinds):
            elastic_nmm += kind.add_forces(control, residual, border[1] if number else 0.0)
        if not np.isfinite(elastic_nmm):
            return None
        if body.sealed:
            volume = self.volume(control, np.zeros(control.shape))
            elastic_nmm -= border[1] * volume
        return self._with_contact(control, border, residual[body.free].ravel(), volume, elastic_nmm)

    def again(self, before: Balance) -> Balance:
        """The balance at the state of ``before``, which these equations share except for contact and friction.

        The elastic forces of ``before`` are used again.
        """
        return self._with_contact(before.control_mm, before.border, before.elastic, float(before.border_residual[1]), before.elastic_nmm)

    def _with_contact(self, control: FloatArray, border: FloatArray, elastic: FloatArray, volume_mm3: float, elastic_nmm: float) -> Balance:
        contact = self.contact(in_object(positions(self.controls, self.weights, self.lift, control), self.T, border))
        force = contact.force_n @ self.T[:3, :3].T
        pushed = np.zeros_like(control)
        spread_forces(self.controls, self.weights, force, pushed)
        border_residual = np.array([0.0, volume_mm3])
        if self.compliance:  # the force of the skin on the object is -sum f
            border_residual[0] = border[0] / self.compliance + float(force[:, 2].sum())
        scale = max(float(np.linalg.norm(force, axis=1).sum()), FORCE_FLOOR_N)
        residual = elastic - pushed[self.body.free].ravel()
        absolute = float(np.linalg.norm([np.linalg.norm(residual), border_residual[0], self.volume_force_n_per_mm3 * volume_mm3]))
        return Balance(control, border, elastic, residual, border_residual, contact, force, scale, elastic_nmm, absolute)

    def stiffness(self, at: Balance, kept: list[KeptStiffness], *, fresh: bool) -> None:
        """Update the elements' tangents to a state; ``fresh`` recomputes all of them."""
        for number, (kind, blocks) in enumerate(zip(self.body.kinds, kept, strict=True)):
            blocks.update(kind, at.control_mm, at.border[1] if number else 0.0, fresh=fresh)

    def volume(self, control: FloatArray, out: FloatArray) -> float:
        """Increase of the gel's volume, mm^3; adds its gradient to ``out``."""
        return sum(kind.add_volume(control, out) for kind in self.body.kinds[1:])
