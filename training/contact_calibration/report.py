"""Page, figures and table of a contact calibration."""

import json
from pathlib import Path

import numpy as np

from training.contact_calibration.fit import INDEPENDENT, ContactFit
from training.contact_calibration.simulate import Setup
from training.validation.model import MeasuredFrames
from twin.kinematics import rig_of
from twin.report.page import render_page
from twin.report.plots import draw_displacement, new_figure

DPI = 110
TOLD = 0.5  # share of the prior's variance that frames must remove before they count as telling a parameter
TRUSTED = 0.5
ALIKE = 0.9  # correlation from which on two parameters can hardly be told apart


def summary_of(setup: Setup, measured: MeasuredFrames, fit: ContactFit, held_out: tuple | None, held_frames: int) -> dict:
    """All figures, as ``calibration.json`` holds them."""
    parameters = []
    for k, parameter in enumerate(setup.parameters):
        start, value = (parameter.number(v[k]) for v in (fit.start, fit.value))
        sd = float(fit.sd[k] * parameter.slope(fit.value[k]))
        told = float(fit.told[k])
        parameters.append({"name": parameter.name, "start": start, "value": value, "sd": sd, "told": told, "known": told >= TOLD})
    pairs = [
        [setup.parameters[i].name, setup.parameters[k].name, float(fit.correlation[i, k])]
        for i in range(len(setup.parameters))
        for k in range(i)
        if abs(fit.correlation[i, k]) >= ALIKE
    ]
    frames = [
        {"image_name": name, "executed": float(executed), "trust": float(trust), "before_px": _number(before), "after_px": _number(after)}
        for name, executed, trust, before, after in zip(measured.names, fit.executed, fit.trust, fit.before_px, fit.after_px, strict=True)
    ]
    return {
        "sensor": setup.sensor.name,
        "experiment": setup.experiment.name,
        "parameters": parameters,
        "turn_sign": {"start": rig_of(setup.sensor).turn_sign, "value": fit.sensor.rig.turn_sign},
        "hardly_told_apart": pairs,
        "executed_share": fit.share,
        "fitted_px": {"before": float(np.nanmean(fit.before_px)), "after": float(np.nanmean(fit.after_px)), "frames": len(measured)},
        "held_out_px": {"before": held_out[0], "after": held_out[1], "frames": held_frames} if held_out else {},
        "distrusted": [frame["image_name"] for frame in frames if frame["trust"] < TRUSTED],
        "frames": frames,
        "independent_numbers_a_frame": INDEPENDENT,
        "problems": measured.problems,
    }


def write_calibration(folder: Path, measured: MeasuredFrames, moved: np.ndarray, fit: ContactFit, summary: dict) -> Path:
    """Write ``calibration.json``, pictures and ``index.html``; the page.

    Parameters
    ----------
    moved : (2, 2, M, N, 2) float
        Simulated displacements before and after the calibration; of each, after the tap and after the move.
    """
    (folder / "calibration.json").write_text(json.dumps(summary, indent=1) + "\n")
    solved = np.flatnonzero(np.isfinite(fit.after_px) & np.isfinite(fit.before_px) & (fit.trust >= TRUSTED))
    chosen = solved[np.argsort(fit.before_px[solved])[[len(solved) // 2, -1]]] if len(solved) else solved
    pictures = []
    for k in chosen:
        name = f"{Path(measured.names[k]).stem}.png"
        seen = np.isfinite(measured.pins_px[k, :, 0])
        figure, axes = new_figure(2, panel_inch=5.0)
        for ax, title, both, error in zip(axes, ("before", "after"), moved, (fit.before_px[k], fit.after_px[k]), strict=True):
            story = both[int(fit.executed[k] > 0.5), k]
            draw_displacement(ax, measured.pins_px[k][seen], (measured.no_contact_px + story)[seen], f"{title}: {error:.2f} px")
        figure.savefig(folder / name, dpi=DPI)
        pictures.append(name)
    page = folder / "index.html"
    page.write_text(render_page("training.contact_calibration", summary=summary, pictures=pictures))
    return page


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
