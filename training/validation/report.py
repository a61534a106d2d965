"""Page, table and figures of a comparison with real frames."""

import csv
import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from scenes.sensor import SensorSpec
from training.validation.compare import MEASURES, Comparison, table_of
from twin.report.page import render_page
from twin.report.plots import draw_displacement, new_figure

DPI = 110


def summary_of(found: Comparison, spec: SensorSpec) -> dict:
    """All figures, as ``validation.json`` holds them."""
    moved = np.linalg.norm(found.measured.pins_px - found.measured.no_contact_px, axis=-1)
    sought = np.isfinite(found.friction_error_px)
    friction = {}
    if sought.any():
        friction = {
            "frames": int(sought.sum()),
            "error_px": float(found.friction_error_px[sought].mean()),
            "error_with_common_friction_px": float(np.nanmean(found.error_px[sought])),
            "median": float(np.median(found.friction[sought])),
        }
    return {
        "sensor": spec.name,
        "form": str(found.measured.form),
        "frames": len(found.measured),
        "mean_displacement_px": float(np.nanmean(moved)),
        "table": table_of(found),
        "one_friction_a_frame": friction,
        "failed": found.failures,
        "problems": found.measured.problems,
    }


def write_validation(out: Path, found: Comparison, spec: SensorSpec, summary: dict) -> list[Path]:
    """Write ``index.html`` with its pictures, ``frames.csv`` and ``validation.json``; the paths."""
    table = out / "frames.csv"
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image_name", "executed", *MEASURES, "error_px", "own_friction", "error_own_friction_px", "failure"])
        for k, name in enumerate(found.measured.names):
            values = [found.by[key][k] for key in MEASURES]
            own = [found.error_px[k], found.friction[k], found.friction_error_px[k]]
            numbers = [f"{value:.6g}" if np.isfinite(value) else "" for value in (*values, *own)]
            writer.writerow([name, int(found.executed[k]), *numbers, found.failures.get(name, "")])
    figures = out / "validation.json"
    figures.write_text(json.dumps(summary, indent=1) + "\n")
    _draw_errors(found).savefig(out / "errors.png", dpi=DPI)
    _draw_worst(found).savefig(out / "frames.png", dpi=DPI)
    page = out / "index.html"
    page.write_text(render_page("training.validation", spec=spec, summary=summary, measures=MEASURES))
    return [page, table, figures]


def _draw_errors(found: Comparison) -> Figure:
    figure, axes = new_figure(len(MEASURES))
    for ax, (key, title) in zip(axes, MEASURES.items(), strict=True):
        for label, chosen, mark in (("executed", found.executed, "o"), ("not executed", ~found.executed, "x")):
            ax.plot(found.by[key][chosen], found.error_px[chosen], mark, markersize=4, label=label)
        ax.set(xlabel=title, ylabel="mean pin error, px", ylim=(0, None))
    axes[0].legend()
    return figure


def _draw_worst(found: Comparison) -> Figure:
    """Error of each pin in the median and in the worst frame."""
    order = np.argsort(np.where(np.isfinite(found.error_px), found.error_px, -1.0))[-np.isfinite(found.error_px).sum() :]
    figure, axes = new_figure(2, panel_inch=5.0)
    for ax, k, title in ((axes[0], order[len(order) // 2], "median frame"), (axes[1], order[-1], "worst frame")):
        measured, simulated = found.measured.pins_px[k], found.simulated_px[k]
        seen = np.isfinite(measured[:, 0])
        draw_displacement(ax, measured[seen], simulated[seen], f"{title}: real pin to simulated\n{found.measured.names[k]}")
    return figure
