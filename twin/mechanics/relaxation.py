"""Viscoelastic rubber: stress that relaxes, and so lags behind and loses energy.

Finite linear viscoelasticity with a Prony series (Simo 1987; Simo & Hughes, "Computational Inelasticity",
ch. 10): the distortion part S of the second Piola-Kirchhoff stress is followed by Maxwell elements,

    S(t) -> (1 - sum g_i) S + sum H_i,    dH_i / dt + H_i / tau_i = g_i dS / dt

integrated over a step h by H_i' = e^(-h / tau_i) H_i + g_i e^(-h / 2 tau_i) (S' - S). Within a step that
is the elastic law times a factor plus a given stress, so each step still has an energy to minimise.
"""

from dataclasses import dataclass, replace

import numpy as np

from scenes.body import RelaxationTerm
from twin.mechanics.elements import Elements
from twin.types import FloatArray


@dataclass(frozen=True)
class History:
    """What one kind of elements remembers, in MPa.

    Attributes
    ----------
    stress : (m, 8, 3, 3) float
        S at the last state, and ``branches`` H (terms, m, 8, 3, 3).
    difference : (m,) float
        The same of the kappa_d part (see ``Elements.difference_stress``), and ``difference_branches`` (terms, m).
    """

    stress: FloatArray
    branches: FloatArray
    difference: FloatArray
    difference_branches: FloatArray

    @classmethod
    def at_rest(cls, kind: Elements, terms: tuple[RelaxationTerm, ...]) -> "History":
        """Nothing has happened for a long time."""
        count = len(kind.cells.weights_mm3) if terms else 0
        shape = (count, 8, 3, 3)
        return cls(np.zeros(shape), np.zeros((len(terms), *shape)), np.zeros(count), np.zeros((len(terms), count)))

    def before(self, kind: Elements, terms: tuple[RelaxationTerm, ...], step_s: float) -> tuple[Elements, FloatArray]:
        """The elements of a step of a duration, their law scaled, and the given stress (see ``Elements.add_forces``)."""
        if not terms:
            return kind, self.stress
        share, fade, late = _decay(terms, step_s)
        kept = (share * late).sum()
        law = kind.law.copy()
        law[[0, 1, 2, 3, 5]] *= 1 - share.sum() + kept
        changed = replace(kind, law=law, difference_mpa=fade @ self.difference_branches - kept * self.difference)
        return changed, np.einsum("t,tmqij->mqij", fade, self.branches) - kept * self.stress

    def after(self, kind: Elements, terms: tuple[RelaxationTerm, ...], step_s: float, control_mm: FloatArray) -> "History":
        """What is remembered after the step; ``kind`` with the unscaled law."""
        if not terms:
            return self
        share, fade, late = _decay(terms, step_s)
        stress = kind.distortion_stress(control_mm)
        difference = kind.difference_stress(control_mm)
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
