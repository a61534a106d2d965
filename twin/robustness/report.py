"""A sweep's page, tables and plots."""

import csv
import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.robustness.envelope import Curve, Envelope
from twin.robustness.measures import MEASURES, POSE_MEASURES
from twin.robustness.sweep import Cell, Plan, cells_of
from twin.views.page import render_page

DPI = 80
SHOWN = ("valid", "recall", "precision", "centroid_px", "area_error", "edges")  # measures that are plotted
TITLES = {m.name: m.title + (f", {m.unit}" if m.unit else "") for m in (*MEASURES, *POSE_MEASURES)}
TWICE = 2.0


def write_report(
    out: Path, plan: Plan, rows: list[dict], curves: list[Curve], envelopes: list[Envelope], *, source: str, notes: list[str]
) -> list[Path]:
    """Write index.html, its plots, and the tables; their paths, the page first."""
    (out / "plots").mkdir(exist_ok=True)
    cells = cells_of(plan)
    entries = []
    for case in plan.cases:
        own = [e for e in envelopes if e.case == case]
        plot = out / "plots" / f"{case.name}.png"
        _plot(plot, case, [c for c in curves if c.case == case.name])
        entries.append(
            {
                "case": case,
                "envelopes": {e.pipeline: e for e in own},
                "plot": f"plots/{plot.name}",
                "picture": _worst(out, cells, case, own[0]) if own else None,
            }
        )
    first = plan.detectors[0].name
    entries.sort(key=lambda entry: entry["envelopes"][first].width)
    comparisons = [compare(envelopes, first, other.name) | {"nameless": other.method == "legacy"} for other in plan.detectors[1:]]
    page = out / "index.html"
    page.write_text(
        render_page(
            "twin.robustness",
            spec=plan.source.spec,
            source=source,
            frames=len(plan.source.names()),
            pipelines=[*(d.name for d in plan.detectors), *plan.model_names],
            first=first,
            entries=entries,
            comparisons=comparisons,
            measures=MEASURES,
            pose_measures=POSE_MEASURES if plan.model_names else (),
            detectors=plan.detectors,
            titles=TITLES,
            notes=notes,
        ),
        encoding="utf-8",
    )
    summary = out / "envelope.json"
    summary.write_text(
        json.dumps({"comparisons": comparisons, "envelope": [_row(e) for e in envelopes]}, indent=2) + "\n", encoding="utf-8"
    )
    written = [
        page,
        summary,
        _table(out / "envelope.csv", [_row(e) for e in envelopes]),
        _table(out / "curves.csv", _curve_rows(plan, curves)),
    ]
    return [*written, _table(out / "frames.csv", [_flat(row) for row in rows])]


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


def _plot(path: Path, case, curves: list[Curve]) -> None:
    names = [name for name in SHOWN if any(c.measure.name == name for c in curves)]
    names += [m.name for m in POSE_MEASURES if any(c.measure.name == m.name for c in curves)]
    figure = Figure(figsize=(3.1 * len(names), 2.7), layout="constrained")
    single = len(case.conditions) == 1
    for ax, name in zip(np.atleast_1d(figure.subplots(1, len(names))), names, strict=True):
        for curve in (c for c in curves if c.measure.name == name):
            at = np.array([case.conditions[0].value(s) for s in curve.severity]) if single else curve.severity
            ax.plot(at, curve.mean, ".-", label=curve.pipeline, lw=1.2)
            ax.fill_between(at, curve.low, curve.high, alpha=0.2)
            limit = curve.limit
        ax.axhline(limit, color="0.4", lw=0.8, ls="--")
        ax.set_title(TITLES[name], fontsize=9)
        ax.set_xlabel(f"{case.conditions[0].parameter} {case.conditions[0].unit}".strip() if single else "severity of both", fontsize=8)
        ax.tick_params(labelsize=7)
    ax.legend(fontsize=7)
    figure.savefig(path, dpi=DPI)


def _row(e: Envelope) -> dict:
    single = len(e.case.conditions) == 1
    value = e.case.conditions[0].value(e.width) if single else None
    unit = e.case.conditions[0].unit if single else ""
    return {
        "condition": e.case.name, "pipeline": e.pipeline, "severity": round(e.width, 4), "reached": bool(e.reached), "measure": e.measure,
        "value": value, "unit": unit,
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


def _table(path: Path, rows: list[dict]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path
