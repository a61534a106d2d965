"""An audit's findings as files: a table of corrected labels, numbers, pictures and one page."""

import csv
import json
from html import escape
from pathlib import Path

import numpy as np

from training.audit import STORIES, Audit
from training.dataset import Dataset
from training.targets import corrected
from twin.report.plots import new_figure

NAMES = ("pose_2", "pose_6", "move_1", "move_6")
LARGE_MOVE = 1.0  # mm or deg: what smaller moves leave undecided changes nothing


def summary_of(audit: Audit, data: Dataset) -> dict:
    """The findings as numbers and lists of names."""
    names = data.pins.image_name
    large = np.abs(data.targets.raw[:, 2:]).max(axis=1) > LARGE_MOVE
    undone = audit.executed < 0.5
    second = np.sort(audit.chi2[:, :2], axis=1)
    lost = data.pins.lost.any(axis=1)
    return {
        "frames": len(data),
        "moves_not_executed": {"frames": int(undone.sum()), "of_large_moves": float(undone[large].mean()) if large.any() else None},
        "undecided": int(((audit.executed > 0.05) & (audit.executed < 0.95)).sum()),
        "median_chi2": {
            "better_story": float(np.nanmedian(second[:, 0])),
            "worse_story_large_moves": float(np.nanmedian(second[large, 1])),
        },
        "no_contact": names[audit.no_contact].tolist(),
        "wrong_sign": names[audit.wrong_sign].tolist(),
        "fit_no_story": names[audit.odd].tolist(),
        "same_pins_as_an_earlier_frame": names[audit.twins != np.arange(len(names))].tolist(),
        "frames_with_lost_pins": int(lost.sum()),
        "depth_mm_per_mm_of_move_not_executed": audit.depth_per_move,
        "drift": audit.drift,
        "reader": data.problems,
    }


def write_audit(out: Path, audit: Audit, data: Dataset, summary: dict) -> list[Path]:
    """``labels_corrected.csv``, ``audit.json``, ``audit.png`` and ``audit.html``."""
    labels = corrected(NAMES, data.targets.raw, audit.executed.round(), data.targets.raw[:, 2:], audit.depth_per_move)
    table = out / "labels_corrected.csv"
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image_name", "executed", *NAMES, *(f"chi2_{story.replace(' ', '_')}" for story in STORIES), "findings"])
        for k, name in enumerate(data.pins.image_name):
            flags = {"no contact": audit.no_contact, "wrong sign": audit.wrong_sign, "fits no story": audit.odd}
            said = [flag for flag, rows in flags.items() if rows[k]]
            if audit.twins[k] != k:
                said.append(f"same pins as {data.pins.image_name[audit.twins[k]]}")
            numbers = [f"{v:.6g}" for v in (*labels[k], *audit.chi2[k])]
            writer.writerow([name, f"{audit.executed[k]:.4g}", *numbers, "; ".join(said)])
    (out / "audit.json").write_text(json.dumps(summary, indent=1) + "\n")
    _draw(out / "audit.png", audit, data, labels)
    (out / "audit.html").write_text(_page(summary, data))
    return [table, out / "audit.json", out / "audit.png", out / "audit.html"]


def _draw(path: Path, audit: Audit, data: Dataset, labels: np.ndarray) -> None:
    raw = data.targets.raw
    figure, axes = new_figure(4, panel_inch=3.8)
    difference = audit.chi2[:, 1] - audit.chi2[:, 0]
    size = np.hypot(raw[:, 2], raw[:, 3])
    axes[0].plot(size, np.sign(difference) * np.log10(1 + np.abs(difference)), ".", markersize=2)
    axes[0].axhline(0, color="#888888", linewidth=0.6)
    axes[0].set(title="which story fits better", xlabel="size of the move, mm and deg", ylabel="log10 chi² for (+) executed")
    axes[1].plot(raw[:, 1], raw[:, 1] - labels[:, 1], ".", markersize=2)
    axes[1].set(title="angle label less what the pins say", xlabel="pose_6, deg", ylabel="deg")
    undone = audit.executed < 0.5
    width = max(len(raw) // 40, 1)
    share = np.convolve(undone, np.ones(width) / width, mode="valid")
    axes[2].plot(np.arange(len(share)) + width / 2, share)
    axes[2].set(title="moves not executed, along the table", xlabel="row", ylabel="share", ylim=(0, 1))
    rim = data.pins.nodes_px[:, data.pins.reference.outmost].mean(axis=1)
    axes[3].plot(rim - rim.mean(axis=0), ".", markersize=1.5, label=["x", "y"])
    axes[3].set(title="middle of the outmost pins, along the table", xlabel="row", ylabel="px")
    axes[3].legend(markerscale=5)
    figure.savefig(path, dpi=110)


def _page(summary: dict, data: Dataset) -> str:
    lists = ("no_contact", "wrong_sign", "fit_no_story", "same_pins_as_an_earlier_frame", "reader")
    rows = "".join(
        f"<tr><th>{escape(key.replace('_', ' '))}</th><td>{escape(_said(value, key in lists))}</td></tr>" for key, value in summary.items()
    )
    return (
        "<!doctype html><meta charset='utf-8'><title>Audit</title>"
        "<style>body{font:15px sans-serif;max-width:70em;margin:2em auto}th{text-align:left;vertical-align:top;padding-right:2em}"
        "img{width:100%}</style>"
        f"<h1>Audit of {escape(data.folder.name)}</h1><p>From pins and labels alone. Each frame is asked whether its pins fit "
        "the label with the shear move executed, or the state before it; labels_corrected.csv holds the answer. Laid beside "
        "the recording's targets.csv, it is what training with corrected labels uses.</p>"
        f"<table>{rows}</table><img src='audit.png' alt='evidence'>"
    )


def _said(value, counted: bool) -> str:
    if counted:
        return "none" if not value else f"{len(value)}: {', '.join(map(str, value[:8]))}{', ...' if len(value) > 8 else ''}"
    return json.dumps(value) if isinstance(value, dict) else str(value)
