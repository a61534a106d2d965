"""A sweep's charts."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from twin.report.charts import faint, muted, sized_figure
from twin.report.themes import BLUE, RED, SERIES
from twin.robustness.condition import Case
from twin.robustness.envelope import Curve, Share
from twin.robustness.measures import MEASURES, POSE_MEASURES

ACROSS = 3  # plots in a row: beside the picture of a frame more would be too small to read
SHOWN = ("valid", "recall", "precision", "centroid_px", "area_error", "edges", *(m.name for m in POSE_MEASURES))
TITLES = {m.name: m.title + (f", {m.unit}" if m.unit else "") for m in (*MEASURES, *POSE_MEASURES)}


def case_figure(case: Case, curves: Sequence[Curve], rendered: Sequence[Curve]) -> Figure:
    """Every measure against the parameter, with its band; of rendered frames beside real ones dashed and without."""
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
        ax.axhline(curve.limit, color=muted(), lw=1.0, ls=":")
        ax.set_title(TITLES[name], fontsize=9)
        ax.set_xlabel(f"{case.conditions[0].parameter} {case.conditions[0].unit}".strip() if single else "severity of both", fontsize=8)
        ax.tick_params(labelsize=7)
    figure.legend(drawn.values(), drawn.keys(), loc="outside lower center", ncols=len(drawn))
    return figure


def shares_figure(shares: Sequence[Share]) -> Figure:
    """Where real frames fail, as dots with intervals, on bars up to where rendered ones do; severities, one line a condition."""
    figure, (ax,) = sized_figure((9.0, 0.32 * len(shares) + 1.2))
    for y, share in enumerate(reversed(shares)):
        real, rendered = share.real, share.rendered
        ax.barh(y, rendered.width, color=faint(), height=0.7)
        ax.text(0.005, y, rendered.label, va="center", fontsize=7, color=muted())
        color = RED if share.short else BLUE
        low, high = (min(end, 1.0) for end in real.interval)
        ax.plot([low, high], [y, y], color=color, lw=2.5, alpha=0.4)
        ax.plot(real.width, y, "o" if real.reached else ">", color=color, ms=6)
    ax.set_yticks(range(len(shares)), [share.real.case.title for share in reversed(shares)], fontsize=8)
    ax.grid(axis="y", visible=False)
    ax.set_xlim(0, 1.03)
    ax.set_xlabel("severity at the first failure. Bar: rendered frames; dot: real ones; arrow: no failure within the range", fontsize=8)
    return figure
