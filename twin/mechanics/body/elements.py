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
from math import prod

import numpy as np

from scenes.body import GelSpec, RelaxationTerm, SkinSpec
from twin.compiled import compiled
from twin.geometry.solid import Cells, Solid
from twin.mechanics.body.material import distortion_stress, first_part, law_coefficients
from twin.types import FloatArray

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # directions (i, k) of the stored stiffness blocks
FIRST, SECOND = np.array([*zip(*PAIRS, strict=True)])
_FAR_STRAIN = 1e9
"""Initial value of the entries of the stored F. No element has such an F, so all blocks are computed at the first update."""
_NO_FORCE, _NO_STRAIN, _NO_BLOCKS = np.zeros((0, 3)), np.zeros((0, 72)), np.zeros((0, 0, 0), np.float32)


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
        return self._evaluate(control_mm, pressure_mpa, out)

    def add_volume(self, control_mm: FloatArray, out: FloatArray) -> float:
        """Increase of the volume in mm^3. The method adds its gradient with respect to the controls, in mm^2, to ``out`` (n, 3)."""
        return Elements(self.cells, np.zeros(6))._evaluate(control_mm, 1.0, out)

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

    def stiffness(
        self, control_mm: FloatArray, pressure_mpa: float, out: FloatArray, *, at: FloatArray | None = None, strain: float = 0.0
    ) -> None:
        """Write the second derivative of each element's energy, N/mm, into ``out`` (m, 6, b, b), in the precision of ``out``.

        Block p couples direction ``PAIRS[p][0]`` of the first control with direction ``PAIRS[p][1]`` of the second; the other three blocks
        are transposes. With ``at`` (m, 72), only the blocks of the elements in which an entry of F differs from it by more than ``strain``
        are computed, and it receives their new F.
        """
        self._evaluate(control_mm, pressure_mpa, _NO_FORCE, out, np.full((len(out), 72), _FAR_STRAIN) if at is None else at, strain)

    def _evaluate(
        self,
        control_mm: FloatArray,
        pressure_mpa: float,
        force: FloatArray,
        out: FloatArray = _NO_BLOCKS,
        at: FloatArray = _NO_STRAIN,
        strain: float = 0.0,
    ) -> float:
        count, blocks = self.cells.controls.shape[1], out.reshape(len(out), prod(out.shape[1:-1]), out.shape[-1])
        f, rows, columns = np.empty((8, 3, 3)), *blocks.shape[1:]
        points = f, f.ravel(), np.empty((8, 3, 3)), np.empty(8), np.empty((8, 3, 3)), np.zeros((3, 3, 3)), np.empty((4, 3, 3))
        sums = np.empty((3, count)), np.zeros((2, 3, count)), np.zeros((30, rows), out.dtype), np.empty((30, columns), out.dtype)
        parts = self.cells, self.law, self.difference_mpa, self.stress
        return _evaluate(parts, np.ascontiguousarray(control_mm), pressure_mpa, force, (strain, at, blocks), (*points, *sums))


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
        self._at = np.empty((count, 72))
        self._made_of: tuple[Elements, float] | None = None

    def update(self, kind: Elements, control_mm: FloatArray, pressure_mpa: float, *, fresh: bool) -> None:
        """Update the blocks to a state; with ``fresh`` all of them are computed. The other arguments are as in ``Elements.stiffness``."""
        same = self._made_of is not None and self._made_of[0] is kind and self._made_of[1] == pressure_mpa
        if fresh or len(kind.stress) or not same:
            self._at[:] = _FAR_STRAIN
        self._made_of = kind, pressure_mpa
        kind.stiffness(control_mm, pressure_mpa, self.blocks, at=self._at, strain=self._kept_strain)


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
def _evaluate(
    parts: tuple[Cells, FloatArray, FloatArray, FloatArray],
    control: FloatArray,
    sealing: float,
    force: FloatArray,
    wanted: tuple[float, FloatArray, FloatArray],
    work: tuple[FloatArray, ...],
) -> float:
    """Add the gradient of the energy to ``force`` (n, 3) and return the energy, or write the stiffness blocks.

    ``wanted`` are the arguments strain, at and out of ``Elements.stiffness``; out (m, 6 b, b) without elements selects the forces.
    With g = F^-T, c = c01 J^(2/3), B = g g^T, C = g^T g and h = c B g, the stress is P = slope F + across g - 2 h, and its derivative

        dP[i, j] / dF[k, n] = bend F[i, j] F[k, n] + u[i, j] g[k, n] + g[i, j] u[k, n] + v[i, n] g[k, j] + g[i, n] v[k, j]
                              + 2 c B[i, k] C[j, n] + (i == k) (slope (j == n) + S[j, n])

    with combinations u and v of F, g and h. Forces and stiffness are one function, because most of its code serves both.
    """
    (elements, gradients, weights), law, extra, given = parts
    strain, at, blocks = wanted
    f, flat, g, det, stress, second, mixed, x, push, left, right = work
    count, energy, stiff = elements.shape[1], 0.0, len(blocks) > 0
    for m in range(len(elements)):
        for a in range(count):
            for i in range(3):
                x[i, a] = control[elements[m, a], i]
        for q in range(8):
            for j in range(3):
                f0, f1, f2 = 0.0, 0.0, 0.0
                for a in range(count):
                    slope = gradients[m, q, j, a]
                    f0 += x[0, a] * slope
                    f1 += x[1, a] * slope
                    f2 += x[2, a] * slope
                f[q, 0, j], f[q, 1, j], f[q, 2, j] = f0, f1, f2
        if stiff:
            most = 0.0
            for k in range(72):
                most = max(most, abs(flat[k] - at[m, k]))
            if most <= strain:
                continue
            for k in range(72):
                at[m, k] = flat[k]
        v0, v1, r0, r1 = 0.0, 0.0, 0.0, 0.0
        for q in range(8):
            for i in range(3):
                k, n = (i + 1) % 3, (i + 2) % 3
                for j in range(3):
                    a, o = (j + 1) % 3, (j + 2) % 3
                    g[q, i, j] = f[q, k, a] * f[q, n, o] - f[q, k, o] * f[q, n, a]
            d = f[q, 0, 0] * g[q, 0, 0] + f[q, 0, 1] * g[q, 0, 1] + f[q, 0, 2] * g[q, 0, 2]
            if d <= 0:
                return np.inf
            det[q] = d
            for i in range(3):
                for j in range(3):
                    g[q, i, j] /= d
            if q < 4:
                r0 += weights[m, q]
                v0 += weights[m, q] * d
            else:
                r1 += weights[m, q]
                v1 += weights[m, q] * d
        rest = r0 + r1
        mean, half = (v0 + v1) / rest - 1, (v0 / r0 - v1 / r1) / 2
        more = extra[m] if len(extra) else 0.0
        energy += rest * (law[4] / 2 * mean**2 + law[5] / 2 * half**2 + sealing * mean + more * half)
        lean0, lean1 = rest / (2 * r0), -rest / (2 * r1)
        for q in range(8):
            w, d = weights[m, q], det[q]
            pressure = (sealing + law[4] * mean + (law[5] * half + more) * (lean0 if q < 4 else lean1)) * d
            trace, scale, bulk, c01 = 0.0, d ** (-2 / 3), 0.0, 0.0
            for i in range(3):
                for j in range(3):
                    trace += f[q, i, j] ** 2
            stored, slope, bend = first_part(law, scale * trace - 3)
            slope, bend = 2 * scale * slope, 4 * scale * scale * bend
            if law[1] != 0:
                c01 = law[1] / scale
                for i in range(3):
                    for j in range(3):
                        b, c = 0.0, 0.0
                        for k in range(3):
                            b += g[q, i, k] * g[q, j, k]
                            c += g[q, k, i] * g[q, k, j]
                        second[0, i, j], second[1, i, j] = b, c
                for i in range(3):
                    bulk += c01 * second[0, i, i]
                    for j in range(3):
                        h = 0.0
                        for k in range(3):
                            h += second[0, i, k] * g[q, k, j]
                        second[2, i, j] = c01 * h
            if not stiff:
                energy += w * (stored + bulk - 3 * law[1])
                across = pressure - slope * trace / 3 + 2 / 3 * bulk
                for i in range(3):
                    for j in range(3):
                        stress[q, i, j] = slope * f[q, i, j] + across * g[q, i, j] - 2 * second[2, i, j]
                        if len(given):
                            total = f[q, i, 0] * given[m, q, 0, j] + f[q, i, 1] * given[m, q, 1, j] + f[q, i, 2] * given[m, q, 2, j]
                            stress[q, i, j] += total
                            energy += w * total * f[q, i, j] / 2
                continue
            along, across = -2 / 3 * slope - bend * trace / 3, (trace * (2 * slope + bend * trace) + 4 * bulk) / 18 + pressure / 2
            crossed = slope * trace / 6 - pressure / 2 - bulk / 3
            for i in range(3):
                for j in range(3):
                    mixed[0, i, j] = along * f[q, i, j] + across * g[q, i, j] - 4 / 3 * second[2, i, j]
                    mixed[1, i, j] = crossed * g[q, i, j] + 2 * second[2, i, j]
                    mixed[2, i, j] = slope if i == j else 0.0
                    if len(given):
                        mixed[2, i, j] += given[m, q, i, j]
                    stress[q, i, j] = d * g[q, i, j]
            for p in range(6):
                i, k = FIRST[p], SECOND[p]
                for n in range(3):
                    for j in range(3):
                        c = bend * f[q, i, j] * f[q, k, n] + mixed[0, i, j] * g[q, k, n] + g[q, i, j] * mixed[0, k, n]
                        c += mixed[1, i, n] * g[q, k, j] + g[q, i, n] * mixed[1, k, j] + 2 * c01 * second[0, i, k] * second[1, j, n]
                        mixed[3, n, j] = w * (c + mixed[2, j, n] if i == k else c)
                for n in range(3):
                    c0, c1, c2 = mixed[3, n, 0], mixed[3, n, 1], mixed[3, n, 2]
                    for a in range(count):
                        left[3 * q + n, count * p + a] = (
                            c0 * gradients[m, q, 0, a] + c1 * gradients[m, q, 1, a] + c2 * gradients[m, q, 2, a]
                        )
        for q in range(8):
            w, level = weights[m, q], q // 4
            s00, s01, s02 = w * stress[q, 0, 0], w * stress[q, 0, 1], w * stress[q, 0, 2]
            s10, s11, s12 = w * stress[q, 1, 0], w * stress[q, 1, 1], w * stress[q, 1, 2]
            s20, s21, s22 = w * stress[q, 2, 0], w * stress[q, 2, 1], w * stress[q, 2, 2]
            for a in range(count):
                g0, g1, g2 = gradients[m, q, 0, a], gradients[m, q, 1, a], gradients[m, q, 2, a]
                push[level, 0, a] += s00 * g0 + s01 * g1 + s02 * g2
                push[level, 1, a] += s10 * g0 + s11 * g1 + s12 * g2
                push[level, 2, a] += s20 * g0 + s21 * g1 + s22 * g2
        if stiff:
            m00, m01, m11 = law[4] + law[5] * lean0**2, law[4] + law[5] * lean0 * lean1, law[4] + law[5] * lean1**2
            for row in range(24):
                for a in range(count):
                    right[row, a] = gradients[m, row // 3, row % 3, a]
            for p in range(6):
                i, k = FIRST[p], SECOND[p]
                for a in range(count):
                    left[24 + k, count * p + a] = (m00 * push[0, i, a] + m01 * push[1, i, a]) / rest
                    left[27 + k, count * p + a] = (m01 * push[0, i, a] + m11 * push[1, i, a]) / rest
        for a in range(count):
            for i in range(3):
                if stiff:
                    right[24 + i, a], right[27 + i, a] = push[0, i, a], push[1, i, a]
                else:
                    force[elements[m, a], i] += push[0, i, a] + push[1, i, a]
                push[0, i, a] = push[1, i, a] = 0.0
        if stiff:
            np.dot(left.T, right, blocks[m])
    return energy
