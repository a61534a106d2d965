"""Curves and envelopes of a finished sweep: the severity of a condition at which a measure crosses its limit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.sweep import MEASURES, POSE_MEASURES, Measure, SweepSettings, run_sweep
from twin.pins.labelling.reference import nominal_reference

DRAWS = 400
"""Number of bootstrap samples of the frames."""
BAND = (5, 95)
"""Percentiles of these samples at the ends of the band: a 90 % interval."""
WIDEST = 1 / 3
"""Width of an interval, relative to the trained range, from which on it says nothing."""
NEAR = 0.1
"""Largest distance of the severities that are held and failed, as a share of the latter, that is not bisected."""
SHORT = 0.75
"""Share of the margin of rendered frames below which a real sensor counts as having lost margin. Chosen."""


@dataclass(frozen=True)
class Curve:
    """One measure of one pipeline under one case.

    Attributes
    ----------
    case, pipeline : str
    measure : Measure
    limit : float
    severity, mean, low, high : (S,) float
        Severity, mean and ends of the band, a 90 % bootstrap interval over the frames. NaN if the measure is undefined in all frames.
    crossing : float
        Severity at which the mean crosses the limit, by linear interpolation between the steps; inf if it does not.
    """

    case: str
    pipeline: str
    measure: Measure
    limit: float
    severity: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    crossing: float


@dataclass(frozen=True)
class Envelope:
    """The severity that one pipeline endures under one case.

    Attributes
    ----------
    case : Case
    pipeline : str
    severity : float
        Severity at which the first measure crosses its limit; inf if none does up to the last step.
    measure : str
        Name of that measure; "" if none.
    held, failed : float
        The last severity that is held, and the first that fails; inf if none does.
    looked : float
        Severity of the last step.
    interval : (2,) float
        Severities at which the ends of that measure's 90 % band cross the limit; inf if one does not.
    """

    case: DegradedCase
    pipeline: str
    severity: float
    measure: str
    held: float = 0.0
    failed: float = np.inf
    looked: float = 1.0
    interval: tuple[float, float] = (np.inf, np.inf)

    @property
    def reached(self) -> bool:
        """Whether the pipeline fails within the swept range."""
        return np.isfinite(self.severity)

    @property
    def width(self) -> float:
        """Severity, at most that of the last step. If the pipeline does not fail, it is a lower bound."""
        return min(self.severity, self.looked)

    @property
    def label(self) -> str:
        """The severities that are held and failed as text, in the parameter's unit."""
        if not self.reached:
            return f"held at {self.case.label(self.looked)}, the last step"
        return f"held at {self.case.label(self.held)}, failed at {self.case.label(self.failed)}" if self.failed > 0 else "fails undegraded"

    @property
    def middle(self) -> float | None:
        """The severity between those that are held and failed; None if they are within ``NEAR`` of each other, or none fails."""
        middle = round((self.held + self.failed) / 2, 3)
        return middle if self.held < middle < self.failed < np.inf and self.failed - self.held > NEAR * self.failed else None


@dataclass(frozen=True)
class Share:
    """The margin of a sensor's real frames compared with that of rendered frames."""

    real: Envelope
    rendered: Envelope

    @property
    def value(self) -> float:
        """Ratio of the severities. If one of them does not fail within the range, it is a bound."""
        if self.rendered.width > 0:
            return self.real.width / self.rendered.width
        return np.inf if self.real.width > 0 else 1.0

    @property
    def short(self) -> bool:
        """Whether the real sensor has significantly less margin than the rendered one."""
        return self.value < SHORT


@dataclass(frozen=True)
class SweepEvaluation:
    """A finished sweep with its curves and envelopes.

    Attributes
    ----------
    plan : Plan
    rows : list of dict
        As `run_sweep` gives them.
    curves : list of Curve
    envelopes : list of Envelope
    """

    plan: SweepSettings
    rows: list[dict]
    curves: list[Curve]
    envelopes: list[Envelope]


def evaluate_sweep(plan: SweepSettings, folder: Path, *, jobs: int, progress: Callable[[int, int], None]) -> SweepEvaluation:
    """Run or continue a sweep, and compute its curves and envelopes. Between the severities that are held and failed it is refined."""
    pitch_px = float(np.mean(nominal_reference(plan.source.spec, plan.source.form).spacing_px))
    while True:
        rows = run_sweep(plan, folder, jobs=jobs, progress=progress)
        curves = curves_of(rows, plan.cases, pitch_px)
        envelopes = envelopes_of(curves, plan.cases)
        further = plan.between | {(envelope.case.name, envelope.middle) for envelope in envelopes if envelope.middle is not None}
        if further == plan.between:
            return SweepEvaluation(plan, rows, curves, envelopes)
        plan = replace(plan, between=further)


def crossing(measure: Measure, limit: float, severity: np.ndarray, mean: np.ndarray) -> float:
    """Severity at which a mean first crosses its limit, by linear interpolation between steps; inf if it does not."""
    held, failed = bracket(measure, limit, severity, mean)
    if 0 < failed < np.inf:
        before, after = (float(mean[severity == at][0]) for at in (held, failed))
        return held + (failed - held) * (limit - before) / (after - before)
    return failed


def bracket(measure: Measure, limit: float, severity: np.ndarray, mean: np.ndarray) -> tuple[float, float]:
    """The last severity before a mean first crosses its limit, and the first after it: 0 and 0 if it always does, inf if it does not."""
    known = severity[np.isfinite(mean)]
    fails = [measure.exceeds(value, limit) for value in mean[np.isfinite(mean)]]
    if True not in fails:
        return float(known[-1]) if len(known) else 0.0, np.inf
    k = fails.index(True)
    return (float(known[k - 1]), float(known[k])) if k else (0.0, 0.0)


def curves_of(rows: list[dict], cases: tuple[DegradedCase, ...], pitch_px: float) -> list[Curve]:
    """Curves of all measures, pipelines and models from the rows of `run_sweep`."""
    table = _poses_against_nominal(rows)
    curves = []
    for case in cases:
        mine = [row for row in table if row["case"] == case.name]
        for pipeline in dict.fromkeys(row["pipeline"] for row in mine):
            own = [row for row in mine if row["pipeline"] == pipeline]
            for measure in POSE_MEASURES if "pose_valid" in own[0] else MEASURES:
                limit = measure.limit * pitch_px if measure.in_pitches else measure.limit
                curves.append(_curve(case.name, pipeline, measure, limit, own))
    return curves


def envelopes_of(curves: list[Curve], cases: tuple[DegradedCase, ...]) -> list[Envelope]:
    """The first crossing of each case and pipeline."""
    found = []
    for case in cases:
        for pipeline in dict.fromkeys(c.pipeline for c in curves if c.case == case.name):
            first = min((c for c in curves if c.case == case.name and c.pipeline == pipeline), key=lambda c: c.crossing)
            reached = np.isfinite(first.crossing)
            sooner, later = sorted(crossing(first.measure, first.limit, first.severity, edge) for edge in (first.low, first.high))
            held, failed = bracket(first.measure, first.limit, first.severity, first.mean)
            name, looked = first.measure.name if reached else "", float(first.severity.max())
            found.append(Envelope(case, pipeline, first.crossing, name, held, failed, looked, (sooner, later)))
    return found


def shares_of(real: list[Envelope], rendered: list[Envelope], pipeline: str) -> list[Share]:
    """Real envelopes of one pipeline with the rendered ones of the same cases. The smallest share comes first."""
    beside = {e.case.name: e for e in rendered if e.pipeline == pipeline}
    return sorted((Share(e, beside[e.case.name]) for e in real if e.pipeline == pipeline), key=lambda share: share.value)


def _curve(case: str, pipeline: str, measure: Measure, limit: float, rows: list[dict]) -> Curve:
    """The curve of one measure over the rows of one case and pipeline."""
    severities = np.array(sorted({row["severity"] for row in rows}))
    mean, low, high = (np.full(len(severities), np.nan) for _ in range(3))
    rng = np.random.default_rng(0)
    for k, severity in enumerate(severities):
        values = np.array([row[measure.name] for row in rows if row["severity"] == severity], float)
        values = values[np.isfinite(values)]
        if len(values):
            draws = values[rng.integers(0, len(values), (DRAWS, len(values)))].mean(axis=1)
            mean[k], (low[k], high[k]) = values.mean(), np.percentile(draws, BAND)
    return Curve(case, pipeline, measure, limit, severities, mean, low, high, crossing(measure, limit, severities, mean))


def _poses_against_nominal(rows: list[dict]) -> list[dict]:
    """Rows of models with their poses' errors, and whether the pose is confidently wrong.

    The error is the mean absolute difference of lengths and angles from those of the undegraded frame. A valid pose is confidently wrong if
    one of them differs by more than the interval and its width together, and no interval is wider than ``WIDEST`` of the trained range.
    Frames without contact have no pose, so all are NaN. A frame whose undegraded contact the model does not know counts for nothing,
    unless it knows none.
    """
    nominal = {(r["case"], r["pipeline"], r["frame"]): r["pose"] for r in rows if "pose" in r and r["severity"] == 0}
    known = {pipeline for (_, pipeline, _), first in nominal.items() if first["valid"] and first["touched"]}
    table = []
    for row in rows:
        if "pose" in row:
            first, now = nominal[row["case"], row["pipeline"], row["frame"]], row["pose"]
            truth, value, low, high = (np.array(each, float) for each in (first["value"], now["value"], now["low"], now["high"]))
            change, width = np.abs(value - truth), high - low
            narrow = now["valid"] and bool((width <= WIDEST * np.array(now["range"])).all())
            far = bool((np.maximum(low - truth, truth - high) > width).any())
            wrong = float(narrow and far) if now["touched"] and first["valid"] else np.nan
            counts = now["touched"] and (first["valid"] or row["pipeline"] not in known)
            row = row | {"pose_valid": float(now["valid"]) if counts else np.nan, "pose_wrong": wrong}
            for unit in ("mm", "deg"):
                of_unit = [c for c, u in zip(change, now["units"], strict=True) if u == unit and now["touched"]]
                row[f"pose_{unit}"] = float(np.mean(of_unit)) if of_unit else np.nan
        table.append(row)
    return table
