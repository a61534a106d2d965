"""Page, table and figures of a comparison with real frames."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.evaluation.labelled.model import MEASURES, Comparison, table_of
from twin.report.charts import draw_displacement, enlargement, new_figure, write_chart
from twin.report.page import Column, Page, PagePicture, number, write_table
from twin.store import made_by, write_json


def summary_of(found: Comparison, sensor: str) -> dict:
    """All figures of a comparison, as ``validation.json`` holds them; ``sensor`` is the sensor's name."""
    moved = np.linalg.norm(found.measured.pins_px - found.measured.no_contact_px, axis=-1)
    sought, friction = np.isfinite(found.friction_error_px), {}
    if sought.any():
        friction = {"frames": int(sought.sum()), "error_px": float(found.friction_error_px[sought].mean())}
        friction["error_with_common_friction_px"] = float(np.nanmean(found.error_px[sought]))
        friction["median"] = float(np.median(found.friction[sought]))
    return {
        "sensor": sensor,
        "form": str(found.measured.form),
        "frames": len(found.measured),
        "mean_displacement_px": float(np.nanmean(moved)),
        "table": table_of(found),
        "one_friction_a_frame": friction,
        "failed": found.failures,
        "problems": found.measured.problems,
    }


def write_validation(out: Path, found: Comparison, description: str, summary: dict) -> list[Path]:
    """Write ``index.html`` with its charts, ``frames.csv`` and ``validation.json``.

    Parameters
    ----------
    out : Path
        Existing folder.
    found : Comparison
    description : str
        Description of the sensor, with which the page begins.
    summary : dict
        As ``summary_of`` gives it.

    Returns
    -------
    list of Path
        The files, the page first.
    """
    table = write_table(out / "frames.csv", _frame_rows(found))
    figures = write_json(out / "validation.json", summary | {"made_by": made_by("twin.evaluation.labelled.model")})
    errors = write_chart(out / "errors.png", lambda: _draw_errors(found))
    frames = write_chart(out / "frames.png", lambda: _draw_worst(found))
    page = Page(
        f"Pins of {summary['sensor']} against real frames",
        "twin validate",
        topic="TacTip twin: validation",
        lead=f"{description}. Each frame's contact is simulated along the arm's own way, from its label alone, and the simulated "
        "displacement is added to the recorded no-contact pins. Error: mean over pins and frames, px of the "
        f"{summary['form']} frames. {summary['frames']} frames, in which pins move by "
        f"{number(summary['mean_displacement_px'], decimals=2)} px on average.",
    )
    page.notice("Contacts that failed", [f"{name}: {reason}" for name, reason in summary["failed"].items()], tone="bad")
    page.notice("Noted", summary["problems"])
    page.section("With nothing free")
    columns = [Column("group", "frames whose move was"), Column("frames", "frames"), Column("error_px", "error", "px", decimals=2)]
    page.table(summary["table"], columns)
    for key, title in MEASURES.items():
        _binned_table(page, summary["table"], key, title)
    page.figures(PagePicture(errors, "Error of each frame by depth, turn and shear"))
    if own := summary["one_friction_a_frame"]:
        page.section(
            "With one friction a frame",
            f"{own['frames']} frames with an executed move: {number(own['error_px'], decimals=2)} px, each with the friction that suits it "
            f"best (median {number(own['median'], 2)}); the same frames with the common friction: "
            f"{number(own['error_with_common_friction_px'], decimals=2)} px.",
        )
    page.section("Pin by pin")
    page.figures(PagePicture(frames, "Error of each pin in the median and in the worst frame"))
    page.download(table, "error of each frame")
    page.download(figures, "all figures of this page")
    return [page.write(out / "index.html"), table, figures]


def _binned_table(page: Page, rows: list[dict], key: str, title: str) -> None:
    binned = [row for row in rows if key in row["by"]]
    if not binned:
        return
    name, _, unit = title.partition(", ")
    ranges = [f"{number(low, decimals=1)} to {number(high, decimals=1)}" for low, high in pairwise(binned[0]["by"][key]["edges"])]
    bins = [Column(f"bin_{k}", text, unit, decimals=2) for k, text in enumerate(ranges)]
    shown = [{"group": row["group"]} | {f"bin_{k}": mean for k, mean in enumerate(row["by"][key]["means"])} for row in binned]
    page.table(shown, [Column("group", "error in px"), *bins], caption=f"By {name}")


def _frame_rows(found: Comparison) -> list[dict[str, object]]:
    numbers = found.by | {"error_px": found.error_px, "own_friction": found.friction, "error_own_friction_px": found.friction_error_px}
    rows: list[dict[str, object]] = []
    for k, name in enumerate(found.measured.names):
        known = {key: values[k] if np.isfinite(values[k]) else None for key, values in numbers.items()}
        rows.append({"image_name": name, "executed": int(found.executed[k]), **known, "failure": found.failures.get(name, "")})
    return rows


def _draw_errors(found: Comparison) -> Figure:
    figure, axes = new_figure(len(MEASURES))
    for ax, (key, title) in zip(axes, MEASURES.items(), strict=True):
        for label, chosen, mark in (("executed", found.executed, "o"), ("not executed", ~found.executed, "x")):
            ax.plot(found.by[key][chosen], found.error_px[chosen], mark, markersize=4, label=label)
        ax.set(xlabel=title, ylabel="mean pin error, px", ylim=(0, None))
    axes[0].legend()
    return figure


def _draw_worst(found: Comparison) -> Figure:
    """Draw the error of each pin in the frame with the median error and in the worst frame."""
    order = np.argsort(np.where(np.isfinite(found.error_px), found.error_px, -1.0))[-np.isfinite(found.error_px).sum() :]
    figure, axes = new_figure(2, panel_inch=5.0)
    for ax, k, title in ((axes[0], order[len(order) // 2], "median frame"), (axes[1], order[-1], "worst frame")):
        seen = np.isfinite(found.measured.pins_px[k, :, 0])
        real, made = found.measured.pins_px[k, seen], found.simulated_px[k, seen]
        text = f"{title}: real pin to simulated\n{found.measured.names[k]}"
        draw_displacement(ax, real, made, text, enlarged=enlargement(real, made))
    return figure
