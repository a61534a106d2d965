"""Elements of skin and gel: energy, forces and stiffness of a nearly incompressible body.

Energy of an element, with F, J at 2x2x2 Gauss points of rest volume w and the law of ``material``:

    W = sum_q w_q [W_distortion(F_q) + S_q : C_q / 2] + V kappa / 2 mean^2 + V kappa_d / 2 difference^2

Each element has two levels through its depth, with the volume strains e = v / V - 1 (V = sum w and v = sum w J over the four points of a
level). ``mean`` is the strain of the whole element, and ``difference`` is half their difference. Because there is only one volume ratio per
level, the element has no volumetric locking (mean dilatation, Simo & Taylor 1985). ``S`` is a given stress: the stress from the past in a
viscoelastic body, and zero in an elastic one.

Gel: The splines are quadratic in all directions. A C1 spline has one coefficient per element in each direction, so an element has three
unknowns. Two volume ratios that are both nearly fixed would be too many constraints for these. Therefore the difference has a smaller
modulus: 1 / kappa_d = 1 / kappa + 1 / (9 mu). This is nearly kappa for a compressible gel, and it is bounded for an incompressible one. On
finer meshes the difference vanishes, and kappa_d has no influence.

Skin: The splines are quadratic along the skin and linear through it. When a linear layer is bent, it cannot become thinner where it is
stretched and thicker where it is compressed, so it would be too stiff. The thickness strain is therefore eliminated under the condition of
zero thickness stress, as in a plate. The bending energy is then that of plane stress, which determines the modulus of the difference:
kappa_d = 2 mu nu / (1 - nu) + 2 mu / 3. A homogeneous state has no difference, and its energy is exact.

Integration: Two Gauss points per direction are fewer than the quadratic splines need for exact integration. This removes membrane and shear
locking. No mode loses its stiffness, because the splines are C1.
"""

from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from scenes.body import GelSpec, RelaxationTerm, SkinSpec
from twin.compiled import compiled
from twin.geometry.solid import Cells, Solid
from twin.mechanics.body.material import distortion_stiffness, distortion_stress, first_piola, invariants, law_coefficients, second_stress
from twin.types import BoolArray, FloatArray, IntArray

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # directions (i, k) of the stored stiffness blocks
FIRST, SECOND = np.array([*zip(*PAIRS, strict=True)])
Parts: TypeAlias = tuple[Cells, FloatArray, FloatArray, FloatArray]
_FAR_STRAIN = 1e9
"""Initial value of the entries of the stored F. No element has such an F, so all blocks are computed at the first update."""


@dataclass(frozen=True)
class Elements:
    """Elements of one kind and their material.

    Attributes
    ----------
    cells : Cells
        m elements with b controls each.
    law : (6,) float
        See ``law_coefficients``.
    difference_mpa : (m,) or (0,) float
        Given stress that is conjugate to half the difference of the two levels' volume strains; empty for an elastic body.
    stress : (m, 8, 3, 3) or (0, 8, 3, 3) float
        Given stress S, MPa; empty for an elastic body.
    """

    cells: Cells
    law: FloatArray
    difference_mpa: FloatArray = field(default_factory=lambda: np.zeros(0))
    stress: FloatArray = field(default_factory=lambda: np.zeros((0, 8, 3, 3)))

    def add_forces(self, control_mm: FloatArray, out: FloatArray, pressure_mpa: float = 0.0) -> float:
        """Elastic energy in N mm. The method adds its gradient with respect to the controls, in N, to ``out`` (n, 3).

        ``pressure_mpa`` (positive: tension) adds its work on the change of volume. If an element is inside out, the energy is infinite and
        ``out`` is not valid.
        """
        return _forces(self._parts, np.ascontiguousarray(control_mm), pressure_mpa, out)

    def add_volume(self, control_mm: FloatArray, out: FloatArray) -> float:
        """Increase of the volume in mm^3. The method adds its gradient with respect to the controls, in mm^2, to ``out`` (n, 3)."""
        return _forces((self.cells, np.zeros(6), np.zeros(0), np.zeros((0, 8, 3, 3))), np.ascontiguousarray(control_mm), 1.0, out)

    @property
    def rest_volume_mm3(self) -> float:
        """Volume at rest, in the unit of ``add_volume``."""
        return float(self.cells.weights_mm3.sum())

    def relaxing_stress(self, control_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Second Piola-Kirchhoff stress of the law's distortion part at the Gauss points, (m, 8, 3, 3) in MPa, and the stress of the
        difference: kappa_d times half the difference of the levels' volume strains, (m,) in MPa.
        """
        controls, gradients, weights = self.cells
        f = np.einsum("mai,mqja->mqij", control_mm[controls], gradients, optimize=True)
        swelling = (weights * np.linalg.det(f)).reshape(-1, 2, 4).sum(axis=2) / weights.reshape(-1, 2, 4).sum(axis=2)
        return distortion_stress(self.law, f), self.law[5] * (swelling[:, 0] - swelling[:, 1]) / 2

    def stiffness(self, control_mm: FloatArray, pressure_mpa: float, out: FloatArray, *, which: IntArray | None = None) -> None:
        """Write the second derivative of each element's energy, N/mm, into ``out`` (m, 6, b, b), in the precision of ``out``.

        Block p couples direction ``PAIRS[p][0]`` of the first control with direction ``PAIRS[p][1]`` of the second; the other three blocks
        are transposes. With ``which`` (k,) int, only the blocks of these elements are computed.
        """
        which = np.arange(len(out)) if which is None else which
        _stiffness(self._parts, which, np.ascontiguousarray(control_mm), pressure_mpa, out)

    def find_changed(self, control_mm: FloatArray, at: FloatArray, strain: float) -> IntArray:
        """Elements (k,) in which an entry of F differs from ``at`` (m, 8, 3, 3) by more than ``strain``; ``at`` receives their new F."""
        return np.flatnonzero(_find_changed(self.cells, np.ascontiguousarray(control_mm), strain, at))

    @property
    def _parts(self) -> Parts:
        return self.cells, self.law, self.difference_mpa, self.stress


def soft_body(solid: Solid, skin: SkinSpec, gel: GelSpec) -> tuple[Elements, Elements, Elements]:
    """The elements of the skin, of the gel's top layer and of the gel below."""
    soft = law_coefficients(gel, layer=False)
    return Elements(solid.skin, law_coefficients(skin, layer=True)), Elements(solid.gel_top, soft), Elements(solid.gel_deep, soft)


class KeptStiffness:
    """Stiffness blocks of one kind of elements, computed again only where the body has changed. This halves the cost.

    The blocks form the tangent of Newton's method. An old tangent changes the number of iterations, and not the solution.

    Parameters
    ----------
    kind : Elements
    kept_strain : float
        The blocks of an element are used again as long as no entry of F has changed by more than this.

    Attributes
    ----------
    blocks : (m, 6, b, b) float
        In single precision (see ``Elements.stiffness``).
    """

    def __init__(self, kind: Elements, kept_strain: float) -> None:
        count, controls = kind.cells.controls.shape
        self._kept_strain = kept_strain
        self.blocks = np.empty((count, 6, controls, controls), np.float32)
        self._at = np.empty((count, 8, 3, 3))
        self._made_of: tuple[Elements, float] | None = None

    def update(self, kind: Elements, control_mm: FloatArray, pressure_mpa: float, *, fresh: bool) -> None:
        """Update the blocks to a state; with ``fresh`` all of them are computed. The other arguments are as in ``Elements.stiffness``."""
        same = self._made_of is not None and self._made_of[0] is kind and self._made_of[1] == pressure_mpa
        if fresh or len(kind.stress) or not same:
            self._at[:] = _FAR_STRAIN
        self._made_of = kind, pressure_mpa
        which = kind.find_changed(control_mm, self._at, self._kept_strain)
        kind.stiffness(control_mm, pressure_mpa, self.blocks, which=which)


@dataclass(frozen=True)
class History:
    """Stress history of one kind of elements, MPa: the stress relaxes with time, which causes hysteresis and loss of energy.

    The model is finite linear viscoelasticity with a Prony series (Simo 1987; Simo & Hughes, "Computational Inelasticity",
    ch. 10): Maxwell elements H_i follow the distortion part S of the second Piola-Kirchhoff stress,

        S(t) -> (1 - sum g_i) S + sum H_i,    dH_i / dt + H_i / tau_i = g_i dS / dt

    They are integrated over a step h by H_i' = e^(-h / tau_i) H_i + g_i e^(-h / 2 tau_i) (S' - S). Within a step the stress is therefore
    the elastic law times a factor, plus a given stress. So each step is still the minimisation of an energy.

    Attributes
    ----------
    stress : (m, 8, 3, 3) float
        S at the last state.
    branches : (terms, m, 8, 3, 3) float
        H at the last state.
    difference : (m,) float
        Stress of the kappa_d part at the last state (see ``Elements.relaxing_stress``).
    difference_branches : (terms, m) float
        Stress in the Maxwell elements of the kappa_d part.
    """

    stress: FloatArray
    branches: FloatArray
    difference: FloatArray
    difference_branches: FloatArray

    @classmethod
    def at_rest(cls, kind: Elements, terms: tuple[RelaxationTerm, ...]) -> "History":
        """The history of an undeformed body: all stresses are 0."""
        count = len(kind.cells.weights_mm3) if terms else 0
        shape = (count, 8, 3, 3)
        return cls(np.zeros(shape), np.zeros((len(terms), *shape)), np.zeros(count), np.zeros((len(terms), count)))

    def before(self, kind: Elements, terms: tuple[RelaxationTerm, ...], step_s: float) -> Elements:
        """The elements with their law scaled for a step of duration ``step_s``, and with the given stress."""
        if not terms:
            return kind
        share, fade, late = _decay(terms, step_s)
        kept = (share * late).sum()
        law = kind.law.copy()
        law[[0, 1, 2, 3, 5]] *= 1 - share.sum() + kept
        stress = np.einsum("t,tmqij->mqij", fade, self.branches) - kept * self.stress
        return replace(kind, law=law, difference_mpa=fade @ self.difference_branches - kept * self.difference, stress=stress)

    def after(self, kind: Elements, terms: tuple[RelaxationTerm, ...], step_s: float, control_mm: FloatArray) -> "History":
        """The history after a step that ended at ``control_mm`` (n, 3); ``kind`` has the unscaled law."""
        if not terms:
            return self
        share, fade, late = _decay(terms, step_s)
        stress, difference = kind.relaxing_stress(control_mm)
        grown = share * late
        return History(
            stress,
            fade[:, None, None, None, None] * self.branches + grown[:, None, None, None, None] * (stress - self.stress),
            difference,
            fade[:, None] * self.difference_branches + grown[:, None] * (difference - self.difference),
        )


def _decay(terms: tuple[RelaxationTerm, ...], step_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    share, time = np.array([[term.fraction, term.time_s] for term in terms]).T
    return share, np.exp(-step_s / time), np.exp(-step_s / (2 * time))


@compiled(fastmath=True)
def gather(control: FloatArray, which: IntArray, x: FloatArray) -> None:
    """Write the positions of the controls ``which`` (b,) into ``x`` (3, b)."""
    for a in range(len(which)):
        for i in range(3):
            x[i, a] = control[which[a], i]


@compiled(fastmath=True)
def deformation(x: FloatArray, slopes: FloatArray, f: FloatArray) -> None:
    """Write F at a place where the splines have ``slopes`` (3, b) into ``f`` (3, 3)."""
    for j in range(3):
        f0, f1, f2 = 0.0, 0.0, 0.0
        for a in range(x.shape[1]):
            slope = slopes[j, a]
            f0 += x[0, a] * slope
            f1 += x[1, a] * slope
            f2 += x[2, a] * slope
        f[0, j], f[1, j], f[2, j] = f0, f1, f2


@compiled(fastmath=True)
def _find_changed(cells: Cells, control: FloatArray, strain: float, at: FloatArray) -> BoolArray:
    elements, gradients, _ = cells
    x, f = np.zeros((3, elements.shape[1])), np.zeros((8, 3, 3))
    out = np.zeros(len(elements), np.bool_)
    for m in range(len(elements)):
        gather(control, elements[m], x)
        for q in range(8):
            deformation(x, gradients[m, q], f[q])
        last = at[m].ravel()
        new = f.ravel()
        most = 0.0
        for k in range(72):
            most = max(most, abs(new[k] - last[k]))
        if most > strain:
            out[m] = True
            for k in range(72):
                last[k] = new[k]
    return out


@compiled(fastmath=True)
def _push(grad: FloatArray, weights: FloatArray, stress: FloatArray, out: FloatArray) -> None:
    """Write the nodal forces of the first Piola-Kirchhoff stress at the Gauss points into ``out`` (3, b), one column per control."""
    out[:] = 0.0
    for q in range(8):
        w = weights[q]
        s00, s01, s02 = w * stress[q, 0, 0], w * stress[q, 0, 1], w * stress[q, 0, 2]
        s10, s11, s12 = w * stress[q, 1, 0], w * stress[q, 1, 1], w * stress[q, 1, 2]
        s20, s21, s22 = w * stress[q, 2, 0], w * stress[q, 2, 1], w * stress[q, 2, 2]
        for a in range(out.shape[1]):
            g0, g1, g2 = grad[q, 0, a], grad[q, 1, a], grad[q, 2, a]
            out[0, a] += s00 * g0 + s01 * g1 + s02 * g2
            out[1, a] += s10 * g0 + s11 * g1 + s12 * g2
            out[2, a] += s20 * g0 + s21 * g1 + s22 * g2


@compiled(fastmath=True)
def _kinematics(
    x: FloatArray, grad: FloatArray, weights: FloatArray, f: FloatArray, det: FloatArray, g: FloatArray
) -> tuple[float, float, float, float]:
    """Write F, det F and F^-T at all points; returns the volumes of the levels, at rest and deformed.

    The first volume is negative if the element is inside out.
    """
    v0, v1, r0, r1 = 0.0, 0.0, 0.0, 0.0
    for q in range(8):
        deformation(x, grad[q], f[q])
    for q in range(8):
        det[q] = invariants(f[q], g[q])
        if det[q] <= 0:
            return -1.0, 0.0, 0.0, 0.0
        if q < 4:
            r0 += weights[q]
            v0 += weights[q] * det[q]
        else:
            r1 += weights[q]
            v1 += weights[q] * det[q]
    return r0, r1, v0, v1


@compiled(fastmath=True)
def _add_prescribed(given: FloatArray, f: FloatArray, weights: FloatArray, stress: FloatArray) -> float:
    """Add a given second Piola-Kirchhoff stress to the first Piola-Kirchhoff stress at all points; returns its energy."""
    energy = 0.0
    for q in range(8):
        for i in range(3):
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += f[q, i, k] * given[q, k, j]
                stress[q, i, j] += total
                energy += weights[q] * total * f[q, i, j] / 2
    return energy


@compiled(fastmath=True)
def _forces(parts: Parts, control: FloatArray, sealing: float, out: FloatArray) -> float:
    (elements, gradients, weights), law, extra, given = parts
    count = elements.shape[1]
    x, push = np.zeros((3, count)), np.zeros((3, count))
    f, g, stress = np.zeros((8, 3, 3)), np.zeros((8, 3, 3)), np.zeros((8, 3, 3))
    det = np.zeros(8)
    energy = 0.0
    for m in range(len(elements)):
        gather(control, elements[m], x)
        r0, r1, v0, v1 = _kinematics(x, gradients[m], weights[m], f, det, g)
        if r0 < 0:
            return np.inf
        rest = r0 + r1
        mean, half = (v0 + v1) / rest - 1, (v0 / r0 - v1 / r1) / 2
        more = extra[m] if len(extra) else 0.0
        energy += rest * (law[4] / 2 * mean**2 + law[5] / 2 * half**2 + sealing * mean + more * half)
        pressure, lean = sealing + law[4] * mean, (law[5] * half + more) * rest / 2
        for q in range(8):
            push_out = pressure + (lean / r0 if q < 4 else -lean / r1)
            energy += weights[m, q] * first_piola(law, f[q], det[q], g[q], push_out, stress[q])
        if law[1] != 0:
            for q in range(8):
                energy += weights[m, q] * second_stress(law[1], f[q], det[q], g[q], stress[q])
        if len(given):
            energy += _add_prescribed(given[m], f, weights[m], stress)
        _push(gradients[m], weights[m], stress, push)
        for a in range(count):
            for i in range(3):
                out[elements[m, a], i] += push[i, a]
    return energy


@compiled(fastmath=True)
def _stiffness(parts: Parts, which: IntArray, control: FloatArray, sealing: float, out: FloatArray) -> None:
    (elements, gradients, weights), law, extra, given = parts
    count = elements.shape[1]
    x = np.zeros((3, count))
    f, g = np.zeros((8, 3, 3)), np.zeros((8, 3, 3))
    det = np.zeros(8)
    tangent = np.zeros((3, 3, 3, 3))
    left, right = np.zeros((24, 6 * count), out.dtype), np.zeros((24, count), out.dtype)
    swell, product = np.zeros((2, 3, count), out.dtype), np.zeros((6 * count, count), out.dtype)
    scale = np.zeros(2, out.dtype)
    for m in which:
        gather(control, elements[m], x)
        grad = gradients[m].reshape(24, count)
        r0, r1, v0, v1 = _kinematics(x, gradients[m], weights[m], f, det, g)
        rest = r0 + r1
        mean, half = (v0 + v1) / rest - 1, (v0 / r0 - v1 / r1) / 2
        more = extra[m] if len(extra) else 0.0
        swell[:] = 0.0
        for q in range(8):
            w = weights[m, q]
            lean = rest / (2 * r0) if q < 4 else -rest / (2 * r1)
            push = (sealing + law[4] * mean + (law[5] * half + more) * lean) * det[q]
            distortion_stiffness(law, f[q], det[q], g[q], tangent)
            for p in range(6):
                i, k = FIRST[p], SECOND[p]
                for n in range(3):
                    c0 = w * (tangent[i, 0, k, n] + push * (g[q, i, 0] * g[q, k, n] - g[q, i, n] * g[q, k, 0]))
                    c1 = w * (tangent[i, 1, k, n] + push * (g[q, i, 1] * g[q, k, n] - g[q, i, n] * g[q, k, 1]))
                    c2 = w * (tangent[i, 2, k, n] + push * (g[q, i, 2] * g[q, k, n] - g[q, i, n] * g[q, k, 2]))
                    if len(given) and i == k:
                        c0 += w * given[m, q, 0, n]
                        c1 += w * given[m, q, 1, n]
                        c2 += w * given[m, q, 2, n]
                    row = left[3 * q + n]
                    for a in range(count):
                        row[count * p + a] = c0 * grad[3 * q, a] + c1 * grad[3 * q + 1, a] + c2 * grad[3 * q + 2, a]
            for i in range(3):
                s0, s1, s2 = w * det[q] * g[q, i, 0], w * det[q] * g[q, i, 1], w * det[q] * g[q, i, 2]
                for a in range(count):
                    s = s0 * grad[3 * q, a] + s1 * grad[3 * q + 1, a] + s2 * grad[3 * q + 2, a]
                    swell[0, i, a] += s
                    swell[1, i, a] += s * lean
        for row_number in range(24):
            for a in range(count):
                right[row_number, a] = grad[row_number, a]
        np.dot(left.T, right, product)
        scale[0], scale[1] = law[4] / rest, law[5] / rest
        for p in range(6):
            for a in range(count):
                size, lean_size = scale[0] * swell[0, FIRST[p], a], scale[1] * swell[1, FIRST[p], a]
                for b in range(count):
                    out[m, p, a, b] = product[count * p + a, b] + size * swell[0, SECOND[p], b] + lean_size * swell[1, SECOND[p], b]
