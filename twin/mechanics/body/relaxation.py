"""Viscoelastic rubber: the stress relaxes with time, which causes hysteresis and loss of energy.

The model is finite linear viscoelasticity with a Prony series (Simo 1987; Simo & Hughes, "Computational Inelasticity",
ch. 10): Maxwell elements H_i follow the distortion part S of the second Piola-Kirchhoff stress,

    S(t) -> (1 - sum g_i) S + sum H_i,    dH_i / dt + H_i / tau_i = g_i dS / dt

They are integrated over a step h by H_i' = e^(-h / tau_i) H_i + g_i e^(-h / 2 tau_i) (S' - S). Within a step the stress is therefore the
elastic law times a factor, plus a given stress. So each step is still the minimisation of an energy.
"""

from dataclasses import dataclass, replace

import numpy as np

from scenes.body import RelaxationTerm
from twin.mechanics.body.elements import Elements
from twin.types import FloatArray


@dataclass(frozen=True)
class History:
    """Stress history of one kind of elements, MPa.

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

    def before(self, kind: Elements, terms: tuple[RelaxationTerm, ...], step_s: float) -> tuple[Elements, FloatArray]:
        """The elements with their law scaled for a step of duration ``step_s``, and the given stress (see ``Elements.add_forces``)."""
        if not terms:
            return kind, self.stress
        share, fade, late = _decay(terms, step_s)
        kept = (share * late).sum()
        law = kind.law.copy()
        law[[0, 1, 2, 3, 5]] *= 1 - share.sum() + kept
        changed = replace(kind, law=law, difference_mpa=fade @ self.difference_branches - kept * self.difference)
        return changed, np.einsum("t,tmqij->mqij", fade, self.branches) - kept * self.stress

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
