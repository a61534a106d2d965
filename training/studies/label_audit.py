"""Audit of a recording: a test of whether its labels agree with its pins. The results are tables, numbers, a picture and a page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scenes import SensorSpec
from training.data.audit import HYPOTHESES, Audit, audit_labels
from training.data.dataset import Dataset, load_dataset
from training.data.targets import CONTACT, UNITS, unit_of
from twin.errors import FrameError
from twin.progress import Progress, silent, stage
from twin.report.charts import muted_colour, new_figure, write_chart
from twin.report.page import Column, Page, PagePicture, number, write_table
from twin.rig.labels import as_executed
from twin.store import made_by, write_json, writes
from twin.types import Form, ReadableResult

# Columns of a table that an audit reads.
NAMES = tuple(f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, len(UNITS) + 1))
# Findings that are lists of frames.
LISTS = ("no_contact", "wrong_sign", "fit_no_story", "same_pins_as_an_earlier_frame")
# Number of frames of each list that are named on the terminal.
SAID = 3
# Number of frames of each list that are named on the page; audit.json names all.
NAMED = 8
# Move, mm or deg, above which a move is large. Some figures use large moves alone, because a small move hardly changes the pins.
LARGE_MOVE = 1.0


@dataclass(frozen=True, repr=False)
class LabelAudit(ReadableResult):
    """The result of an audit, and its files.

    Attributes
    ----------
    audit : Audit
    summary : dict
        Content of ``audit.json``.
    frames : int
    written : list of Path
    """

    audit: Audit
    summary: dict[str, Any]
    frames: int
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        if self.audit.not_assessed:
            lines = [f"{self.audit.not_assessed} (frames: {self.frames})", "no labels_corrected.csv: the labels are not assessed"]
        else:
            undone, undecided = self.summary["moves_not_executed"], self.summary["undecided"]
            lines = [f"frames: {self.frames}; in {undone['frames']} the move was not executed; {undecided} undecided"]
        for key in (*LISTS, "reader"):
            if names := self.summary[key]:
                lines.append(f"{key.replace('_', ' ')}: {len(names)} ({_some(names, SAID)})")
        if self.audit.not_assessed:
            return lines
        drift = self.audit.drift["r2_of_row_number_beyond_labels"]
        return [
            *lines,
            f"depth beyond the label where not executed: {self.audit.depth_per_move:+.4f} mm for each mm of shear (move_1)",
            f"drift, row number explained by the outmost pins beyond the labels: R^2 {drift:.2f}",
        ]


@writes("labels_corrected.csv", "audit.json", "audit.png", "audit-dark.png", "audit.html")
def audit_recording(data: Path, sensor: SensorSpec, out: Path, *, form: Form | None = None, progress: Progress = silent) -> LabelAudit:
    """Audit the labels of a recording of one object, and write the result to a folder.

    A recording with too few frames is not evaluated. The result states this (``Audit.not_assessed``), and no corrected labels are written.

    Raises
    ------
    FrameError
        No label pose_1..6 of the recording varies.
    """
    with stage(progress, "frames") as step:
        found = load_dataset(data, sensor, CONTACT, form=form, progress=step)
    if not any(name.startswith("pose_") for name in found.targets.names):
        raise FrameError(f"{data}: none of pose_1..6 varies ({', '.join(found.targets.names)} do), so there is nothing to audit")
    made = audit_labels(found.pins, *_pose_and_move(found))
    summary = summary_of(made, found)
    return LabelAudit(made, summary, len(found), write_audit(out, made, found, summary))


def _pose_and_move(data: Dataset) -> np.ndarray:
    """(2, M, 6) ``pose_1..6`` and ``move_1..6``; 0 where the data set has none."""
    columns = dict(zip(data.targets.names, data.targets.raw.T, strict=True))
    none = np.zeros(len(data))
    return np.array([columns.get(name, none) for name in NAMES]).reshape(2, len(UNITS), len(data)).swapaxes(1, 2)


def _correct_moves(data: Dataset, executed: np.ndarray, depth_per_move: float) -> dict[str, np.ndarray]:
    """The varying labels without moves that were not executed (M,), by their names."""
    pose, move = _pose_and_move(data)
    before, made = as_executed(pose, move, executed)
    depth = max((k for k in range(3) if f"pose_{k + 1}" in data.targets.names), default=None)
    if depth is not None:
        before[:, depth] += depth_per_move * (1 - executed) * move[:, 0]
    every = dict(zip(NAMES, np.hstack([before, made]).T, strict=True))
    return {name: every[name] for name in data.targets.names if name in every}


def summary_of(audit: Audit, data: Dataset) -> dict:
    """The findings as numbers and lists of frame names."""
    names = data.pins.image_name
    lost = data.pins.lost.any(axis=1)
    listed = zip(LISTS, (audit.no_contact, audit.wrong_sign, audit.odd, audit.duplicates != np.arange(len(names))), strict=True)
    found: dict[str, Any] = {"frames": len(data)} | ({"not_told": audit.not_assessed} if audit.not_assessed else _moves(audit, data))
    found |= {key: names[those].tolist() for key, those in listed} | {"frames_with_lost_pins": int(lost.sum())}
    if not audit.not_assessed:
        found |= {"depth_mm_per_mm_of_move_not_executed": audit.depth_per_move, "drift": audit.drift}
    return found | {"reader": data.problems}


def _moves(audit: Audit, data: Dataset) -> dict:
    large = np.abs(_pose_and_move(data)[1]).max(axis=1) > LARGE_MOVE
    undone = audit.executed < 0.5
    second = np.sort(audit.chi2[:, :2], axis=1)
    moves = {"frames": int(undone.sum()), "of_large_moves": float(undone[large].mean()) if large.any() else None}
    worse = float(np.nanmedian(second[large, 1])) if large.any() else None
    chi2 = {"better_story": float(np.nanmedian(second[:, 0])), "worse_story_large_moves": worse}
    undecided = int(((audit.executed > 0.05) & (audit.executed < 0.95)).sum())
    return {"moves_not_executed": moves, "undecided": undecided, "median_chi2": chi2}


def write_audit(out: Path, audit: Audit, data: Dataset, summary: dict) -> list[Path]:
    """Write ``labels_corrected.csv``, ``audit.json``, ``audit.png`` and ``audit.html``, and return their paths.

    If there are too few frames, neither corrected labels nor a picture are written.
    """
    numbers = write_json(out / "audit.json", summary | {"made_by": made_by("training.data.audit")})
    page = Page(
        f"Audit of {data.folder.name}",
        "twin audit",
        topic="TacTip twin: audit",
        lead="From pins and labels alone. For each frame the audit decides whether its pins fit the label with the shear move executed, "
        "or the state before the move. labels_corrected.csv contains the result. Put it beside the recording's targets.csv to "
        "train with corrected labels.",
    )
    page.notice("Not assessed, and no corrected labels written", [audit.not_assessed] if audit.not_assessed else [], tone="bad")
    page.notice("Notes on the recording", summary["reader"])
    tables, charts = list[Path](), list[Path]()
    if not audit.not_assessed:
        labels = _correct_moves(data, audit.executed.round(), audit.depth_per_move)
        tables = [write_table(out / "labels_corrected.csv", _label_rows(audit, data, labels))]
        charts = [write_chart(out / "audit.png", lambda: _evidence_figure(audit, data, labels))]
        shown = "Evidence for the findings: which hypothesis fits each frame, corrections of the angle, moves along the table, drift"
        page.figures(PagePicture(charts[0], shown))
    page.section("Findings")
    page.table(_findings(summary), [Column("finding", "finding"), Column("value", "value", align="right")])
    page.section("Frames that stand out")
    page.table(
        [{"finding": key.replace("_", " "), "count": len(summary[key]), "frames": _some(summary[key], NAMED)} for key in LISTS],
        [Column("finding", "finding"), Column("count", "frames"), Column("frames", "which")],
    )
    for table in tables:
        page.download(table, "corrected labels, and the findings of each frame")
    page.download(numbers, "all findings, with the names of all frames")
    return [*tables, numbers, *charts, page.write(out / "audit.html")]


def _findings(group: dict, within: str = "") -> list[dict]:
    """The findings that are numbers, one in each row. A finding within a group is named with the group's name first."""
    rows = []
    for key, value in group.items():
        name = f"{within}{key.replace('_', ' ')}"
        if isinstance(value, dict):
            rows += _findings(value, f"{name}: ")
        elif key not in (*LISTS, "reader", "not_told"):
            rows.append({"finding": name, "value": number(value)})
    return rows


def _some(names: list[str], most: int) -> str:
    return f"{', '.join(names[:most])}{', ...' if len(names) > most else ''}" or "none"


def _label_rows(audit: Audit, data: Dataset, labels: dict[str, np.ndarray]) -> list[dict[str, object]]:
    columns = labels | {f"chi2_{story.replace(' ', '_')}": audit.chi2[:, k] for k, story in enumerate(HYPOTHESES)}
    flags = {"no contact": audit.no_contact, "wrong sign": audit.wrong_sign, "fits no hypothesis": audit.odd}
    rows = []
    for k, name in enumerate(data.pins.image_name):
        said = [flag for flag, found in flags.items() if found[k]]
        if audit.duplicates[k] != k:
            said.append(f"same pins as {data.pins.image_name[audit.duplicates[k]]}")
        numbers = {key: float(values[k]) for key, values in columns.items()}
        rows.append({"image_name": name, "executed": f"{audit.executed[k]:.4g}"} | numbers | {"findings": "; ".join(said)})
    return rows


def _evidence_figure(audit: Audit, data: Dataset, labels: dict[str, np.ndarray]) -> Figure:
    raw = dict(zip(data.targets.names, data.targets.raw.T, strict=True))
    shown = [name for name in labels if name.startswith("pose_")][-1]
    figure, axes = new_figure(2, 2, panel_inch=4.4)
    difference = audit.chi2[:, 1] - audit.chi2[:, 0]
    size = np.linalg.norm(_pose_and_move(data)[1], axis=1)
    axes[0].plot(size, np.sign(difference) * np.log10(1 + np.abs(difference)), ".", markersize=2)
    axes[0].axhline(0, color=muted_colour(), linewidth=0.8)
    axes[0].set(title="which hypothesis fits better", xlabel="size of the move, mm and deg", ylabel="log10 chi² for (+) executed")
    axes[1].plot(raw[shown], raw[shown] - labels[shown], ".", markersize=2)
    axes[1].set(title=f"{shown}: label minus estimate from the pins", xlabel=f"{shown}, {unit_of(shown)}", ylabel=unit_of(shown))
    undone = audit.executed < 0.5
    width = max(len(data) // 40, 1)
    share = np.convolve(undone, np.ones(width) / width, mode="valid")
    axes[2].plot(np.arange(len(share)) + width / 2, share)
    axes[2].set(title="moves not executed, along the table", xlabel="row", ylabel="share", ylim=(0, 1))
    rim = data.pins.nodes_px[:, data.pins.reference.outmost].mean(axis=1)
    axes[3].plot(rim - rim.mean(axis=0), ".", markersize=1.5, label=["x", "y"])
    axes[3].set(title="middle of the outmost pins, along the table", xlabel="row", ylabel="px")
    axes[3].legend(markerscale=5)
    return figure
