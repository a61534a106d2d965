"""A sweep that has been run, and what its rows say."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.preprocess.reference import nominal_reference
from twin.robustness.envelope import Curve, Envelope, curves_of, envelopes_of
from twin.robustness.sweep import Plan, run_sweep


@dataclass(frozen=True)
class Judgement:
    """Rows of a sweep, its curves and envelopes.

    Attributes
    ----------
    plan : Plan
    rows : list of dict
        As `run_sweep` gives them.
    curves : list of Curve
    envelopes : list of Envelope
    """

    plan: Plan
    rows: list[dict]
    curves: list[Curve]
    envelopes: list[Envelope]


def judge_sweep(plan: Plan, folder: Path, *, jobs: int, progress: Callable[[int, int], None]) -> Judgement:
    """Run a sweep, or what is left of it, and judge it."""
    rows = run_sweep(plan, folder, jobs=jobs, progress=progress)
    pitch_px = float(np.mean(nominal_reference(plan.source.spec, plan.source.form).spacing_px))
    curves = curves_of(rows, plan.cases, pitch_px)
    return Judgement(plan, rows, curves, envelopes_of(curves, plan.cases))
