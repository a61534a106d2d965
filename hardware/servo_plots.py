"""Pictures of a followed surface, as in the paper's figure: trajectory, a zoom with its local smoothness, depth and angle."""

import numpy as np
from matplotlib.figure import Figure

from hardware.trajectory import LOCAL_N, Measures, Trajectory, local_slopes
from twin.report.charts import muted, new_figure
from twin.report.themes import BLUE, RED

ZOOM_MM = 12.0  # half the side of the zoom
TOOL, FELT = BLUE, RED


def trajectory_figure(path: Trajectory, measures: Measures, title: str, *, outline_mm: np.ndarray | None = None) -> Figure:
    """Four panels; with an outline (N, 2) in the base frame the true surface too."""
    figure, (whole, zoom, depth, angle) = new_figure(2, 2, panel_inch=4.6)
    figure.suptitle(
        f"{title}: S = {measures.smoothness:.3f}, path error {measures.path_error_mm:.2f} mm, "
        f"{measures.completed:.0%} of the way, contact lost {measures.lost_contacts:g} times"
    )
    for ax in (whole, zoom):
        if outline_mm is not None:
            ax.plot(*outline_mm.T, color=muted(), lw=3, alpha=0.5, label="object")
        ax.plot(*path.tool_mm.T, color=TOOL, lw=1, label="tool")
        ax.plot(*path.felt_mm.T, ".", color=FELT, ms=3, label="surface as felt")
        ax.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    whole.set_title("trajectory")
    whole.legend(loc="best", fontsize=8)
    slopes = local_slopes(path.tool_mm)
    if len(slopes) and np.isfinite(slopes).any():
        worst = int(np.nanargmax(slopes))
        x, y = path.tool_mm[worst + LOCAL_N // 2]
        zoom.set(xlim=(x - ZOOM_MM, x + ZOOM_MM), ylim=(y - ZOOM_MM, y + ZOOM_MM))
        zoom.set_title(f"roughest: local S {slopes[worst]:.3f} (mean {measures.local_smoothness:.3f})")
    steps = np.arange(len(path.depth_mm))
    for ax, estimated, true, name in (
        (depth, path.depth_mm, path.true_depth_mm, "depth, mm"),
        (angle, path.angle_deg, path.true_angle_deg, "angle from the normal, deg"),
    ):
        ax.plot(steps, true, color=muted(), lw=2, label="true")
        ax.plot(steps, estimated, color=FELT, lw=0.8, label="estimated")
        ax.set(xlabel="step", ylabel=name)
        ax.legend(fontsize=8)
    return figure


def comparison_figure(rows: list[tuple[str, str, Trajectory, np.ndarray]]) -> Figure:
    """Objects across, models down: (model, object, trajectory, outline) each."""
    models, objects = list(dict.fromkeys(row[0] for row in rows)), list(dict.fromkeys(row[1] for row in rows))
    figure, axes = new_figure(len(objects), len(models), panel_inch=3.2)
    for model, name, path, outline in rows:
        ax = axes[models.index(model) * len(objects) + objects.index(name)]
        ax.plot(*outline.T, color=muted(), lw=3, alpha=0.5)
        ax.plot(*path.tool_mm.T, color=TOOL, lw=0.9)
        ax.set(title=f"{name}, {model}", aspect="equal", xticks=[], yticks=[])
    return figure
