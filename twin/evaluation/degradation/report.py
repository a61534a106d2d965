"""The page, charts and tables of a sweep."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.envelope import NEAR, SHORT, Curve, Envelope, Share, SweepEvaluation, shares_of
from twin.evaluation.degradation.sweep import MEASURES, POSE_MEASURES, SweepSettings, cells_of
from twin.pins import DetectorSpec
from twin.report.charts import faint, muted_colour, sized_figure, write_chart
from twin.report.page import BLUE, RED, SERIES, Column, Page, PagePicture, bad, good, link_to, sentence, strong, write_rows
from twin.report.page import Cell as Shown
from twin.store import made_by, write_json

ACROSS = 3
"""Number of plots in a row. More would be too small to read beside the picture of a frame."""
SHOWN = ("valid", "recall", "precision", "centroid_px", "area_error", "edges", *(m.name for m in POSE_MEASURES))
"""Measures in the chart of a condition, in their order."""
TITLES = {m.name: m.title + (f", {m.unit}" if m.unit else "") for m in (*MEASURES, *POSE_MEASURES)}
"""Title of each measure with its unit."""
TWICE = 2.0
"""Smallest ratio of widths at which an envelope counts as twice as wide."""
CASE_DPI = 90
"""Resolution of a condition's chart, dots per inch. It is low, because a page has dozens of them."""

REPORT_FILES = ("index.html", "plots", "envelope.json", "envelope.csv", "curves.csv", "frames.csv", "real-on-rendered.csv")
"""Parts of a report."""


def write_report(
    out: Path, evaluation: SweepEvaluation, *, source: str, notes: list[str], rendered: SweepEvaluation | None = None
) -> list[Path]:
    """Write index.html, its plots, and the tables. Returns their paths, the page first.

    Parameters
    ----------
    out : Path
    evaluation : Judgement
    source : str
        Name of the frames' folder, or a description of how they were made.
    notes : list of str
        Remarks for the page.
    rendered : Judgement, optional
        The same cases on rendered frames, which are shown with those on real frames.
    """
    (out / "plots").mkdir(exist_ok=True)
    plan, envelopes = evaluation.plan, evaluation.envelopes
    first = plan.detectors[0].name
    of_first = sorted((e for e in envelopes if e.pipeline == first), key=lambda e: e.width)
    comparisons = [compare(envelopes, first, other.name) | {"nameless": other.method == "legacy"} for other in plan.detectors[1:]]
    shares = shares_of(envelopes, rendered.envelopes, first) if rendered else []
    rows, margins, frames = [_row(e) for e in envelopes], [_share_row(s) for s in shares], [_flat(row) for row in evaluation.rows]
    figures = {"comparisons": comparisons, "envelope": rows, "shares": margins, "made_by": made_by("twin.evaluation.degradation.sweep")}
    tables = {"envelope": rows, "curves": _curve_rows(plan, evaluation.curves), "frames": frames, "real-on-rendered": margins}
    written = [write_json(out / "envelope.json", figures), *(write_rows(out / f"{name}.csv", of) for name, of in tables.items() if of)]
    page = Page(
        f"Robustness of {plan.source.spec.name}",
        "twin robustness",
        topic="TacTip twin: robustness",
        lead=f"{plan.source.spec.description}. How far may the sensor degrade before its pins are lost? Source: {source}, "
        f"{len(plan.source)} frames for each step. Every condition grows from nothing to severe while all else stays as it was.",
    )
    page.notice("Noted", notes)
    _pipelines_section(page, plan, comparisons)
    if shares:
        _shares_section(page, out, plan, shares)
    _limits_section(page, plan)
    _envelope_section(page, plan, envelopes, [e.case for e in of_first])
    _cases_section(page, out, evaluation, of_first, rendered.curves if rendered else [])
    for path in written:
        page.download(path)
    return [page.write(out / "index.html"), *written]


def case_figure(case: DegradedCase, curves: Sequence[Curve], rendered: Sequence[Curve]) -> Figure:
    """A chart of all measures against the parameter, with their bands. Curves of rendered frames are dashed and have no band."""
    curves, rendered = ([c for c in group if c.case == case.name] for group in (curves, rendered))
    names = [name for name in SHOWN if any(c.measure.name == name for c in curves)]
    pipelines = list(dict.fromkeys(c.pipeline for c in curves))
    rows, columns = -(-len(names) // ACROSS), min(ACROSS, len(names))
    figure, axes = sized_figure((3.1 * columns, 2.7 * rows), columns, rows)
    single, drawn = len(case.conditions) == 1, {}
    for ax in axes[len(names) :]:
        ax.axis("off")
    for ax, name in zip(axes, names, strict=False):
        for group, line, note in ((curves, ".-", ""), (rendered, "--", ", rendered")):
            for curve in (c for c in group if c.measure.name == name):
                at = np.array([case.conditions[0].value(s) for s in curve.severity]) if single else curve.severity
                color = SERIES[pipelines.index(curve.pipeline) % len(SERIES)]
                drawn[curve.pipeline + note] = ax.plot(at, curve.mean, line, color=color, lw=1.2)[0]
                if group is curves:
                    ax.fill_between(at, curve.low, curve.high, color=color, alpha=0.2)
        ax.axhline(curve.limit, color=muted_colour(), lw=1.0, ls=":")
        ax.set_title(TITLES[name], fontsize=9)
        ax.set_xlabel(f"{case.conditions[0].parameter} {case.conditions[0].unit}".strip() if single else "severity of both", fontsize=8)
        ax.tick_params(labelsize=7)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(drawn))
    return figure


def shares_figure(shares: Sequence[Share]) -> Figure:
    """A chart with a line for each condition: a dot with interval where real frames fail, and a bar up to where rendered frames fail."""
    figure, (ax,) = sized_figure((9.0, 0.32 * len(shares) + 1.2))
    for y, share in enumerate(reversed(shares)):
        real, rendered = share.real, share.rendered
        ax.barh(y, rendered.width, color=faint(), height=0.7)
        ax.text(0.005, y, rendered.label, va="center", fontsize=7, color=muted_colour())
        color = RED if share.short else BLUE
        low, high = (min(end, 1.0) for end in real.interval)
        ax.plot([low, high], [y, y], color=color, lw=2.5, alpha=0.4)
        ax.plot(real.width, y, "o" if real.reached else ">", color=color, ms=6)
    ax.set_yticks(range(len(shares)), [share.real.case.title for share in reversed(shares)], fontsize=8)
    ax.grid(axis="y", visible=False)
    ax.set_xlim(0, 1.03)
    ax.set_xlabel("severity between held and failed. Bar: rendered frames; dot: real ones; arrow: no failure within the range", fontsize=8)
    return figure


def _pipelines_section(page: Page, plan: SweepSettings, comparisons: list[dict]) -> None:
    page.section("Pipelines compared")
    page.items([_detector_text(detector) for detector in plan.detectors])
    for c in comparisons:
        page.text(
            sentence(
                f"The envelope of {c['ours']} is at least as wide as that of {c['theirs']} in",
                strong(f"{c['as_wide']} of {c['cases']}"),
                "conditions and at least twice as wide in",
                strong(c["twice"]) + ".",
                bad(f"Narrower in: {', '.join(c['narrower'])}.") if c["narrower"] else good("It is narrower in none."),
                f"Widths end with the range looked at: where {c['theirs']} does not fail within half of it, twice as wide cannot be shown.",
                f"{c['theirs']} throws a frame away that does not show exactly all pins: mostly that is how it fails first. It gives its "
                "pins no names, so it cannot fail by confusing them, and a turned camera does it no harm."
                if c["nameless"]
                else "",
            )
        )


def _detector_text(detector: DetectorSpec) -> str:
    told = "as the specification has it"
    if found := detector.evidence:
        told = f"tuned on {found.frames} frames ({found.sure}; all pins in {100 * found.exact_rate:.0f} %)"
    return f"{detector.name}: method {detector.method}, {told}"


def _shares_section(page: Page, out: Path, plan: SweepSettings, shares: list[Share]) -> None:
    name, first = plan.source.spec.name, plan.detectors[0].name
    short = [share.real.case.title for share in shares if share.short]
    page.section(
        "This sensor on the rendered envelope",
        sentence(
            f"The same conditions on {len(plan.source)} real frames and on frames that the twin draws of a sound {name}, with "
            f"pipeline {first}. A share below 1 is margin that this sensor has already lost; {SHORT:.2f} or more is what differs from "
            "sensor to sensor anyway.",
            bad(f"It is on the bad side in {len(short)} of {len(shares)}: {', '.join(short)}.")
            if short
            else good(f"It is on the bad side in none of {len(shares)}."),
        ),
    )
    chart = write_chart(out / "plots" / "real-on-rendered.png", lambda: shares_figure(shares))
    page.figures(PagePicture(chart, "Severities at which real frames fail, on those at which rendered frames do", width_px=900))
    rows = [
        {"condition": Shown(share.real.case.title, href=link_to(share.real.case.name)), "parameter": _parameters(share.real.case)}
        | {kind: Shown(of.label, note=TITLES.get(of.measure, "")) for kind, of in (("real", share.real), ("rendered", share.rendered))}
        | {"share": Shown(share.value, "bad" if share.short else "good")}
        for share in shares
    ]
    kinds = Column("real", "real frames"), Column("rendered", "rendered frames")
    page.table(rows, ["condition", "parameter", *kinds, Column("share", "share", decimals=2)])


def _limits_section(page: Page, plan: SweepSettings) -> None:
    page.section(
        "Limits",
        sentence(
            "A pipeline fails where the mean over the frames of one of these crosses its limit. Graphs are compared with those that the "
            "same method makes of the true pins.",
            "A pose's error is its change against the same model's answer for the frame that is not degraded; frames without contact, and "
            "contacts that the model does not know, do not count. A pose is confidently wrong if it lies farther outside its 90 % interval "
            "than the interval is wide, and the interval is not wider than a third of the trained range."
            if plan.model_digests
            else "",
        ),
    )
    rows = [
        {"measure": m.title, "limit": f"{'at least' if m.least else 'at most'} {m.limit} {'pitches' if m.in_pitches else m.unit}".strip()}
        for m in (*MEASURES, *(POSE_MEASURES if plan.model_digests else ()))
    ]
    page.table(rows, ["measure", "limit"])


def _envelope_section(page: Page, plan: SweepSettings, envelopes: list[Envelope], cases: list[DegradedCase]) -> None:
    pipelines = [*(d.name for d in plan.detectors), *plan.model_digests]
    page.section(
        "Envelope, least margin first",
        f"The parameter's last value that {pipelines[0]} and the others hold, the first at which they fail, and which measure fails first. "
        f"Between two steps the range was bisected until both values were within {100 * NEAR:.0f} %. The bar is the part of the range "
        "that is held.",
    )
    rows = [
        {"condition": Shown(case.title, href=link_to(case.name)), "parameter": _parameters(case)}
        | {f"of {e.pipeline}": Shown(e.label, note=TITLES.get(e.measure, ""), bar=e.width) for e in envelopes if e.case == case}
        for case in cases
    ]
    page.table(rows, ["condition", "parameter", *(Column(f"of {name}", name) for name in pipelines)])


def _cases_section(page: Page, out: Path, evaluation: SweepEvaluation, envelopes: list[Envelope], rendered: list[Curve]) -> None:
    """Charts of all cases, with the worst frames under the first pipeline, whose ``envelopes`` are given."""
    page.section(
        "Condition by condition",
        f"Mean over the frames with its 90 % interval; dotted: the limit{'; dashed: rendered frames' if rendered else ''}. The "
        f"picture is the worst frame of {envelopes[0].pipeline} just beyond its envelope: green circles are true pins that it found, red "
        "ones those it missed, dots what it takes for pins.",
    )
    cells = cells_of(evaluation.plan)
    for envelope in envelopes:
        case = envelope.case
        page.heading(case.title, anchor=case.name)
        plot = write_chart(out / "plots" / f"{case.name}.png", partial(case_figure, case, evaluation.curves, rendered), dpi=CASE_DPI)
        chart, own = PagePicture(plot, f"Measures against {_parameters(case)}"), [cell for cell in cells if cell.case == case]
        beyond = next((cell for cell in own if cell.severity >= envelope.severity and cell.severity > 0), own[-1])
        path = out / "pictures" / f"{beyond.file}.jpg"
        if path.is_file():
            worst = PagePicture(path, f"Worst frame under {case.title}", case.label(beyond.severity), "frame")
            page.figures(worst, chart, layout="beside")
        else:
            page.figures(chart)


def _parameters(case: DegradedCase) -> str:
    return ", ".join(condition.parameter for condition in case.conditions)


def compare(envelopes: list[Envelope], ours: str, theirs: str) -> dict:
    """Number of cases in which one pipeline's envelope is as wide as another's, and twice as wide. Widths are severities, at most 1.

    If neither fails within the range, they count as equally wide; ``narrower`` names the cases in which ours is narrower.
    """
    pairs = [(e, next(o for o in envelopes if o.case == e.case and o.pipeline == theirs)) for e in envelopes if e.pipeline == ours]
    wider = [a.case.name for a, b in pairs if a.width >= b.width]
    twice = [a.case.name for a, b in pairs if a.width >= TWICE * b.width and a.width > 0]
    narrower = [a.case.name for a, b in pairs if a.width < b.width]
    return {"ours": ours, "theirs": theirs, "cases": len(pairs), "as_wide": len(wider), "twice": len(twice), "narrower": narrower}


def _row(e: Envelope) -> dict:
    single, c = len(e.case.conditions) == 1, e.case.conditions[0]
    ends = {"value": e.width, "held": e.held, "failed": e.failed if e.reached else None}
    row = {"condition": e.case.name, "pipeline": e.pipeline, "severity": round(e.width, 4), "reached": bool(e.reached)}
    values = {key: c.value(end) if single and end is not None else None for key, end in ends.items()}
    return row | {"measure": e.measure} | values | {"unit": c.unit if single else ""}


def _share_row(share: Share) -> dict:
    value = round(share.value, 3) if np.isfinite(share.value) else None
    return {
        "condition": share.real.case.name, "share": value, "short": share.short, "real": share.real.label,
        "rendered": share.rendered.label, "real_measure": share.real.measure, "rendered_measure": share.rendered.measure,
    }  # fmt: skip


def _curve_rows(plan: SweepSettings, curves: list[Curve]) -> list[dict]:
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
