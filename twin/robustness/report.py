"""A sweep's page and tables."""

import json
from pathlib import Path

import numpy as np

from twin.report.page import render_page
from twin.report.table import write_rows
from twin.robustness.envelope import SHORT, Curve, Envelope, Share, shares_of
from twin.robustness.judgement import Judgement
from twin.robustness.measures import MEASURES, POSE_MEASURES
from twin.robustness.plots import TITLES, plot_case, plot_shares
from twin.robustness.sweep import Cell, Plan, cells_of

TWICE = 2.0


def write_report(out: Path, judged: Judgement, *, source: str, notes: list[str], rendered: Judgement | None = None) -> list[Path]:
    """Write index.html, its plots, and the tables; their paths, the page first.

    Parameters
    ----------
    out : Path
    judged : Judgement
    source : str
        Name of the frames.
    notes : list of str
        For the page.
    rendered : Judgement, optional
        Of the same cases on rendered frames, to be shown beside real ones.
    """
    (out / "plots").mkdir(exist_ok=True)
    plan, envelopes = judged.plan, judged.envelopes
    cells, first = cells_of(plan), plan.detectors[0].name
    entries = [_entry(out, case, judged, rendered, cells) for case in plan.cases]
    entries.sort(key=lambda entry: entry["envelopes"][first].width)
    comparisons = [compare(envelopes, first, other.name) | {"nameless": other.method == "legacy"} for other in plan.detectors[1:]]
    shares = shares_of(envelopes, rendered.envelopes, first) if rendered else []
    if shares:
        plot_shares(out / "plots" / "real-on-rendered.png", shares)
    page = out / "index.html"
    page.write_text(
        render_page(
            "twin.robustness",
            spec=plan.source.spec,
            source=source,
            frames=len(plan.source.names()),
            pipelines=[*(d.name for d in plan.detectors), *plan.model_digests],
            first=first,
            entries=entries,
            comparisons=comparisons,
            shares=shares,
            short_below=SHORT,
            measures=MEASURES,
            pose_measures=POSE_MEASURES if plan.model_digests else (),
            detectors=plan.detectors,
            titles=TITLES,
            notes=notes,
        ),
        encoding="utf-8",
    )
    summary = out / "envelope.json"
    content = {"comparisons": comparisons, "envelope": [_row(e) for e in envelopes], "shares": [_share_row(s) for s in shares]}
    summary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    written = [
        page,
        summary,
        write_rows(out / "envelope.csv", [_row(e) for e in envelopes]),
        write_rows(out / "curves.csv", _curve_rows(plan, judged.curves)),
        write_rows(out / "frames.csv", [_flat(row) for row in judged.rows]),
    ]
    return [*written, write_rows(out / "real-on-rendered.csv", [_share_row(s) for s in shares])] if shares else written


def _entry(out: Path, case, judged: Judgement, rendered: Judgement | None, cells: list[Cell]) -> dict:
    """What the page says of one case."""
    own = {e.pipeline: e for e in judged.envelopes if e.case == case}
    plot = out / "plots" / f"{case.name}.png"
    plot_case(plot, case, judged.curves, rendered.curves if rendered else [])
    first = own[judged.plan.detectors[0].name]
    return {"case": case, "envelopes": own, "plot": f"plots/{plot.name}", "picture": _worst(out, cells, case, first)}


def compare(envelopes: list[Envelope], ours: str, theirs: str) -> dict:
    """In how many cases one pipeline's envelope is as wide as another's, and twice as wide; widths are severities, at most 1.

    Where neither fails within the range the two count as equally wide; ``narrower`` names the cases where ours is narrower.
    """
    pairs = [(e, next(o for o in envelopes if o.case == e.case and o.pipeline == theirs)) for e in envelopes if e.pipeline == ours]
    wider = [a.case.name for a, b in pairs if a.width >= b.width]
    twice = [a.case.name for a, b in pairs if a.width >= TWICE * b.width and a.width > 0]
    narrower = [a.case.name for a, b in pairs if a.width < b.width]
    return {"ours": ours, "theirs": theirs, "cases": len(pairs), "as_wide": len(wider), "twice": len(twice), "narrower": narrower}


def _worst(out: Path, cells: list[Cell], case, envelope: Envelope) -> dict | None:
    """The worst frame at the first severity beyond the envelope (else at the severest)."""
    own = [cell for cell in cells if cell.case == case]
    cell = next((c for c in own if c.severity >= envelope.severity and c.severity > 0), own[-1])
    file = f"pictures/{cell.file}.jpg"
    return {"file": file, "label": case.label(cell.severity)} if (out / file).is_file() else None


def _row(e: Envelope) -> dict:
    single = len(e.case.conditions) == 1
    value = e.case.conditions[0].value(e.width) if single else None
    unit = e.case.conditions[0].unit if single else ""
    return {
        "condition": e.case.name, "pipeline": e.pipeline, "severity": round(e.width, 4), "reached": bool(e.reached), "measure": e.measure,
        "value": value, "unit": unit,
    }  # fmt: skip


def _share_row(share: Share) -> dict:
    value = round(share.value, 3) if np.isfinite(share.value) else None
    return {
        "condition": share.real.case.name, "share": value, "short": share.short, "real": share.real.label,
        "rendered": share.rendered.label, "real_measure": share.real.measure, "rendered_measure": share.rendered.measure,
    }  # fmt: skip


def _curve_rows(plan: Plan, curves: list[Curve]) -> list[dict]:
    cases = {case.name: case for case in plan.cases}
    return [
        {"condition": c.case, "pipeline": c.pipeline, "measure": c.measure.name, "severity": s, "parameter": cases[c.case].label(s)}
        | {"mean": m, "low": low, "high": high, "limit": c.limit}
        for c in curves
        for s, m, low, high in zip(c.severity.tolist(), c.mean.tolist(), c.low.tolist(), c.high.tolist(), strict=True)
    ]


def _flat(row: dict) -> dict:
    keys = ("case", "severity", "frame", "pipeline", *(m.name for m in MEASURES), "reason", "pose")
    return {key: row.get(key, "") for key in keys}
