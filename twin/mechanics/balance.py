"""The equations of one load step: elastic forces against contact and friction."""

from copy import copy
from dataclasses import dataclass

import numpy as np

from twin.errors import ContactError
from twin.mechanics.contact import ContactForces, ContactPoints, contact_forces, positions, spread_forces
from twin.mechanics.elements import Elements, KeptStiffness
from twin.objects import ObjectField
from twin.types import BoolArray, FloatArray, IntArray

FORCE_FLOOR_N = 1e-3  # the residual's scale is never less


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
    free: BoolArray
    sealed: bool

    @property
    def volume_force_n_per_mm3(self) -> float:
        """Force that stands for 1 mm^3 of the gel's volume gained or lost, so that both can be measured in N; 0 for an open gel.

        It is mu A / V with the gel's shear modulus mu (at small strain) and rest volume V and the skin's area A: what a stress mu
        on the whole skin is for the whole volume. The ratio is the same in any unit of length.
        """
        if not self.sealed:
            return 0.0
        gel = self.kinds[1:]
        shear_modulus_mpa = 2 * float(gel[0].law[0] + gel[0].law[1])
        return shear_modulus_mpa * float(self.points.area_mm2.sum()) / sum(kind.rest_volume_mm3 for kind in gel)


@dataclass(frozen=True)
class Friction:
    """Coulomb friction with slip weakening (Ida 1972).

    A point that has slid by s since it last stuck has mu = kinetic + (static - kinetic) exp(-s / weakening_mm).
    The shear stress never exceeds ``shear_strength_mpa``.
    """

    static: float
    kinetic: float
    weakening_mm: float = 0.1
    shear_strength_mpa: float = np.inf

    def __post_init__(self) -> None:
        if not (0 <= self.kinetic <= self.static < np.inf and self.weakening_mm > 0 and self.shear_strength_mpa > 0):
            raise ContactError(f"friction needs 0 <= kinetic <= static, weakening_mm > 0 and shear_strength_mpa > 0, got {self}")

    def after(self, slid_mm: FloatArray) -> FloatArray:
        """Coefficients (q,) of points that have slid so far since they last stuck."""
        return self.kinetic + (self.static - self.kinetic) * np.exp(-slid_mm / self.weakening_mm)


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
    limit_n : (p,) float
        Largest friction force that each point could bear.
    gap_mm : (p,) float
        Distance of each point from the object, negative inside; 0 before the contact.
    penalty_mpa_mm : float
    T : (4, 4) float
        The object's pose before it gave way.
    elastic_nmm, dissipated_nmm : float
        Energy stored in the body, and lost to friction in the step that led here.
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
    volume_force_n_per_mm3 : float
        See ``Body``.
    """

    elastic: FloatArray
    residual: FloatArray
    border_residual: FloatArray
    contact: ContactForces
    point_force_n: FloatArray
    scale_n: float
    elastic_nmm: float
    volume_force_n_per_mm3: float

    @property
    def absolute(self) -> float:
        """Norm of the residual in N, the gel's change of volume counted as a force."""
        yielding_n, volume_mm3 = self.border_residual
        return float(np.linalg.norm([np.linalg.norm(self.residual), yielding_n, self.volume_force_n_per_mm3 * volume_mm3]))

    @property
    def relative(self) -> float:
        """Norm of the residual over the sum of the contact forces."""
        return self.absolute / self.scale_n


def in_object(points_mm: FloatArray, T: FloatArray, border: FloatArray) -> FloatArray:
    """Points (k, 3) of the sensor's frame in that of the object at ``T``, which has given way by ``border[0]`` along z."""
    return (points_mm - T[:3, 3] - [0, 0, border[0]]) @ T[:3, :3]


class Problem:
    """The equations of one load step. Anchors, penalty, the object's pose and the stress left of the past are held.

    Parameters
    ----------
    body : Body
    field : ObjectField
        The object that presses.
    friction : Friction
    compliance_mm_per_n : float
        How far the object gives way along z under a force.
    state : LoadState
        Where the step begins: how far each point has slid decides its coefficient of friction.
    anchor_mm : (p, 3) float
        Friction's anchors of all contact points in the object's frame.
    looked : (q,) int
        Contact points that the equations look at; the others are known to be free.
    penalty : float
        Contact pressure for a unit of penetration, MPa/mm.
    T : (4, 4) float
        The object's pose before it gives way.
    given : list of float arrays
        Stress left of the past, for each kind of elements (see ``Elements.add_forces``).
    """

    def __init__(
        self,
        body: Body,
        field: ObjectField,
        friction: Friction,
        compliance_mm_per_n: float,
        state: LoadState,
        *,
        anchor_mm: FloatArray,
        looked: IntArray,
        penalty: float,
        T: FloatArray,
        given: list[FloatArray],
    ) -> None:
        self.body, self.compliance, self._field = body, compliance_mm_per_n, field
        self.volume_force_n_per_mm3 = body.volume_force_n_per_mm3
        self._given, self.T = given, T
        self.looked, self.penalty = looked, penalty
        points = body.points
        self.controls, self.weights = points.controls[looked], points.weights[looked]
        self.lift = points.lift_mm[looked]
        self.anchor_mm = anchor_mm[looked]
        self.stiff = penalty * points.area_mm2[looked]
        self.bound_n = friction.shear_strength_mpa * points.area_mm2[looked]
        self._law = friction
        self.slid_mm = state.slid_mm[looked]
        self.friction = friction.after(self.slid_mm)

    def moved(self, T: FloatArray, anchor_mm: FloatArray, slid_mm: FloatArray) -> "Problem":
        """The same equations with the object at ``T`` (4, 4); anchors (q, 3) and slip (q,) are those of the points looked at."""
        other = copy(self)
        other.T, other.anchor_mm, other.slid_mm, other.friction = T, anchor_mm, slid_mm, self._law.after(slid_mm)
        return other

    def contact(self, at: FloatArray, soften: float = 1.0) -> ContactForces:
        """Contact with the points looked at in places (q, 3) of the object's frame."""
        return contact_forces(self._field, at, self.stiff, self.anchor_mm, self.friction, bound_n=self.bound_n, soften=soften)

    def balance(self, control: FloatArray, border: FloatArray) -> Balance | None:
        """The equations; None if an element is inside out."""
        body, volume = self.body, 0.0
        residual = np.zeros_like(control)
        elastic_nmm = 0.0
        for number, (kind, given) in enumerate(zip(body.kinds, self._given, strict=True)):
            elastic_nmm += kind.add_forces(control, given, residual, border[1] if number else 0.0)
        if not np.isfinite(elastic_nmm):
            return None
        if body.sealed:
            volume = self.volume(control, np.zeros_like(control))
            elastic_nmm -= border[1] * volume
        return self._with_contact(control, border, residual[body.free].ravel(), volume, elastic_nmm)

    def again(self, before: Balance, control: FloatArray, border: FloatArray) -> Balance:
        """The equations where only contact and friction differ from those whose balance ``before`` is, at the same state."""
        return self._with_contact(control, border, before.elastic, float(before.border_residual[1]), before.elastic_nmm)

    def _with_contact(self, control: FloatArray, border: FloatArray, elastic: FloatArray, volume_mm3: float, elastic_nmm: float) -> Balance:
        contact = self.contact(in_object(positions(self.controls, self.weights, self.lift, control), self.T, border))
        force = contact.force_n @ self.T[:3, :3].T
        pushed = np.zeros_like(control)
        spread_forces(self.controls, self.weights, force, pushed)
        border_residual = np.array([0.0, volume_mm3])
        if self.compliance:  # the skin pushes the object with -sum f
            border_residual[0] = border[0] / self.compliance + float(force[:, 2].sum())
        scale = max(float(np.linalg.norm(force, axis=1).sum()), FORCE_FLOOR_N)
        residual = elastic - pushed[self.body.free].ravel()
        return Balance(elastic, residual, border_residual, contact, force, scale, elastic_nmm, self.volume_force_n_per_mm3)

    def stiffness(self, control: FloatArray, border: FloatArray, kept: list[KeptStiffness], *, anew: bool) -> None:
        """Bring the elements' tangents to a state; ``anew``: leave none as it was."""
        for number, (kind, given, blocks) in enumerate(zip(self.body.kinds, self._given, kept, strict=True)):
            blocks.update(kind, control, given, border[1] if number else 0.0, anew=anew)

    def volume(self, control: FloatArray, out: FloatArray) -> float:
        """How much the gel's volume has grown, mm^3; adds its gradient to ``out``."""
        return sum(kind.add_volume(control, out) for kind in self.body.kinds[1:])
