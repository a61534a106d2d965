"""Page, figures and table of a contact calibration."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from twin.calibration.contact.fit import DETERMINED, INDEPENDENT, Z90, CalibrationSetup, ContactFit, FittedParameter
from twin.evaluation.labelled.model import MeasuredFrames
from twin.frames import distinct_stems
from twin.report.charts import draw_displacement, enlargement, new_figure, write_chart
from twin.report.page import Cell, Column, Page, PagePicture, number
from twin.rig.kinematics import rig_of
from twin.store import made_by, write_json

TRUSTED = 0.5
"""Trust below which a frame is listed as not trusted, and not drawn."""
ALIKE = 0.9
"""Absolute correlation above which two parameters are listed as hardly distinguishable."""


def summary_of(setup: CalibrationSetup, measured: MeasuredFrames, fit: ContactFit, held_out: tuple | None, held_frames: int) -> dict:
    """All figures, as ``calibration.json`` holds them."""
    names, alike = [parameter.name for parameter in setup.parameters], np.argwhere(np.tril(abs(fit.correlation) >= ALIKE, -1))
    pairs = [[names[i], names[k], float(fit.correlation[i, k])] for i, k in alike]
    frames: list[dict] = [
        {"image_name": name, "executed": float(executed), "trust": float(trust), "before_px": _number(before), "after_px": _number(after)}
        for name, executed, trust, before, after in zip(measured.names, fit.executed, fit.trust, fit.before_px, fit.after_px, strict=True)
    ]
    return {
        "sensor": setup.sensor.name,
        "experiment": setup.experiment.name,
        "parameters": describe_parameters(setup.parameters, fit.start, fit.value, fit.sd, fit.determined),
        "turn_sign": {"start": rig_of(setup.sensor).turn_sign, "value": rig_of(fit.sensor).turn_sign},
        "hardly_told_apart": pairs,
        "executed_share": fit.share,
        "fitted_px": {"before": float(np.nanmean(fit.before_px)), "after": float(np.nanmean(fit.after_px)), "frames": len(measured)},
        "held_out_px": {"before": held_out[0], "after": held_out[1], "frames": held_frames} if held_out else {},
        "warnings": warnings_of(fit, held_out, held_frames),
        "distrusted": [frame["image_name"] for frame in frames if frame["trust"] < TRUSTED],
        "frames": frames,
        "independent_numbers_a_frame": INDEPENDENT,
        "problems": measured.problems,
    }


def warnings_of(fit: ContactFit, held_out: tuple | None, held_frames: int) -> list[str]:
    """Warnings about everything that is worse than before the fit, or unknown; empty if there are none."""
    found, pairs = [], {"the fitted frames": (np.nanmean(fit.before_px), np.nanmean(fit.after_px))}
    if held_out:
        pairs[f"the {held_frames} held-out frames"] = held_out
    else:
        found.append("no held-out frame is left, so the error on other frames is not known; give more frames, or a smaller `num_labelled`")
    for on, (before, after) in pairs.items():
        if not after <= before:
            found.append(f"the fit ended worse than it began on {on}: {before:.2f} -> {after:.2f} px; look at the page before you use it")
    return found


def write_calibration(folder: Path, measured: MeasuredFrames, moved: np.ndarray, fit: ContactFit, summary: dict) -> Path:
    """Write ``calibration.json``, charts and ``index.html``, and return the page.

    Parameters
    ----------
    moved : (2, 2, M, N, 2) float
        Simulated displacements, px. Axes: before and after the calibration; after the tap and after the move; frame; pin; x and y.
    """
    figures = write_json(folder / "calibration.json", summary | {"made_by": made_by("twin.calibration.contact.fit")})
    solved = np.flatnonzero(np.isfinite(fit.after_px) & np.isfinite(fit.before_px) & (fit.trust >= TRUSTED))
    chosen = solved[np.argsort(fit.before_px[solved])[[len(solved) // 2, -1]]] if len(solved) else solved
    page = Page(f"Contact of {summary['sensor']}", "twin calibrate contact", topic="TacTip twin: contact calibration", lead=_lead(summary))
    page.notice(
        "Labels that are not trusted, because neither hypothesis fits",
        [", ".join(names)] if (names := summary["distrusted"]) else [],
        tone="bad",
    )
    page.notice("Warnings", summary["warnings"], tone="bad")
    page.notice("Notes", [summary["newtons"]["explanation"], *summary["problems"]])
    _parameters_section(page, summary)
    page.section("Frames")
    page.table(
        summary["frames"],
        [
            Column("image_name", "frame"),
            Column("executed", "move executed", "%", decimals=0, scale=100),
            Column("trust", "trust", "%", decimals=0, scale=100),
            Column("before_px", "before", "px", decimals=2),
            Column("after_px", "after", "px", decimals=2),
        ],
        caption="Mean pin error of each frame; a dash: its contact failed.",
    )
    page.section("Real pins to simulated ones")
    for k, name in zip(chosen, distinct_stems([measured.names[k] for k in chosen]), strict=True):
        chart = write_chart(folder / f"{name}.png", partial(_frame_figure, measured, moved, fit, int(k)))
        page.figures(PagePicture(chart, f"Pin errors of {name} before and after the calibration", measured.names[k]))
    page.download(figures, "all figures of this page")
    return page.write(folder / "index.html")


def _lead(summary: dict) -> str:
    fitted, held, others = summary["fitted_px"], summary["held_out_px"], ""
    before, after = (number(fitted[part], decimals=2) for part in ("before", "after"))
    if held:
        others = f"; on {held['frames']} held-out frames {number(held['before'], decimals=2)} and {number(held['after'], decimals=2)} px"
    return (
        f"Fitted to {fitted['frames']} labelled frames of {summary['experiment']}: mean pin error {before} px before, {after} px after"
        f"{others}. Each frame counts under its likelier hypothesis: move executed, or tap alone. Moves executed: "
        f"{100 * summary['executed_share']:.0f} %."
    )


def describe_parameters(
    parameters: Sequence[FittedParameter], start: np.ndarray, value: np.ndarray, sd: np.ndarray, determined: np.ndarray
) -> list[dict[str, Any]]:
    """Start, value, standard deviation, 90 % interval, and determined share of each parameter, from fitted quantities (P,)."""
    rows = []
    for k, p in enumerate(parameters):
        low, high = sorted(p.number(value[k] + z * sd[k]) for z in (-Z90, Z90))
        ends = {"sd": float(sd[k] * p.slope(value[k])), "low": low, "high": high}
        shares = {"told": float(determined[k]), "known": bool(determined[k] >= DETERMINED)}
        rows.append({"name": p.name, "start": p.number(start[k]), "value": p.number(value[k])} | ends | shares)
    return rows


def add_parameters(page: Page, parameters: list[dict], by: str, **spread: str) -> None:
    """Add a table of parameters (``describe_parameters``) to a page.

    ``by`` names what they were fitted to; ``spread`` holds the titles of the columns of their uncertainty by their keys.
    """
    texts = {"start": 4, "value": 4} | dict.fromkeys(spread, 2 if "sd" in spread else 3)
    page.table(
        [
            {key: number(p[key], digits) for key, digits in texts.items() if key in p}
            | {key: Cell(value, "" if p["known"] else "bad") for key, value in (("name", p["name"]), ("told", p["told"]))}
            for p in parameters
        ],
        [
            Column("name", "parameter"),
            *(Column(key, title, align="right") for key, title in ({"start": "start", "value": "fitted"} | spread).items()),
            Column("told", f"determined by the {by}", "%", decimals=0, scale=100),
        ],
    )


def _parameters_section(page: Page, summary: dict) -> None:
    page.section("Parameters")
    sign = {"name": "rig.turn_sign", "told": "", "known": True} | summary["turn_sign"]
    add_parameters(page, [*summary["parameters"], sign], "frames", sd="sd")
    page.text(
        "Determined by the frames: the share by which they reduce the prior uncertainty. A parameter that they do not determine (red) "
        f"stays near its start. The sd counts a frame's pins as {summary['independent_numbers_a_frame']:.0f} independent numbers, because "
        "all pins share the model's own errors."
    )
    if alike := summary["hardly_told_apart"]:
        said = "; ".join(f"{a} and {b} ({number(r, decimals=2, signed=True)})" for a, b, r in alike)
        page.text(f"Hardly distinguished: {said}.")


def _frame_figure(measured: MeasuredFrames, moved: np.ndarray, fit: ContactFit, k: int) -> Figure:
    seen = np.isfinite(measured.pins_px[k, :, 0])
    real = measured.pins_px[k][seen]
    hypotheses = [(measured.no_contact_px + both[int(fit.executed[k] > 0.5), k])[seen] for both in moved]
    enlarged = enlargement(real, hypotheses[0])
    figure, axes = new_figure(2, panel_inch=5.0)
    for ax, title, hypothesis, error in zip(axes, ("before", "after"), hypotheses, (fit.before_px[k], fit.after_px[k]), strict=True):
        draw_displacement(ax, real, hypothesis, f"{title}: {error:.2f} px", enlarged=enlarged)
    return figure


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
