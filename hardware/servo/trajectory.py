"""Evaluation of surface following: the trajectory, its measures, and its pictures.

The measures are the Tac-VGNN paper's smoothness S, and others that do not depend on the axes. The pictures are those of the paper's figure:
the trajectory, a zoom with its local smoothness, depth and angle.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hardware.rig.geometry import PlacedObject
from hardware.servo.loop import Reading, StepRecord, tangent_of
from twin.report.charts import muted_colour, new_figure
from twin.report.page import BLUE, RED, write_table
from twin.rig.arm_pose import matrix_of
from twin.rig.kinematics import Mounting

# Number of points in a window of the local smoothness.
LOCAL_N = 9
# Number of steps at the start that the errors leave out.
SETTLING_N = 5
# Half the side of the zoom, in mm.
ZOOM_MM = 12.0
# Colours of the tool's path and of the estimated surface.
TOOL, FELT = BLUE, RED


@dataclass(frozen=True)
class Trajectory:
    """A followed surface in M steps. The true values are NaN if the truth is not known.

    Attributes
    ----------
    tool_mm : (M, 2) float
        Position of the tool, x and y in the base frame.
    surface_mm : (M, 2) float
        Position of the surface by the estimates.
    depth_mm, angle_deg : (M,) float
        Estimated depth and angle.
    true_depth_mm, true_angle_deg, true_indent_mm : (M,) float
    off_mm : (M,) float
        Distance of ``surface_mm`` from the true surface.
    along_mm : (M,) float
        Distance along the object's outline to the touched place.
    """

    tool_mm: np.ndarray
    surface_mm: np.ndarray
    depth_mm: np.ndarray
    angle_deg: np.ndarray
    true_depth_mm: np.ndarray
    true_angle_deg: np.ndarray
    true_indent_mm: np.ndarray
    off_mm: np.ndarray
    along_mm: np.ndarray


@dataclass(frozen=True)
class Measures:
    """Measures of one trajectory. Those that need the truth are NaN without it.

    Attributes
    ----------
    steps : int
    smoothness : float
        The paper's S: mean of |dy / dx| over neighbouring points, without pairs of equal x. It depends on the axes.
    local_smoothness : float
        Mean of S over windows of points, each rotated so that its ends are on the x axis.
    path_error_mm : float
        Root mean square distance of the estimated surface from the true one.
    depth_error_mm, angle_error_deg : float
        Mean absolute error of the estimates.
    hold_depth_mm, hold_angle_deg : float
        Mean absolute difference of the true depth and angle from the reference.
    jerk : float
        Root mean square third difference of the tool's path, mm per step^3.
    completed : float
        Share of the wanted distance along the outline.
    lost_contacts : float
        Number of times that the sensor left the surface.
    """

    steps: int
    smoothness: float
    local_smoothness: float
    path_error_mm: float
    depth_error_mm: float
    angle_error_deg: float
    hold_depth_mm: float
    hold_angle_deg: float
    jerk: float
    completed: float
    lost_contacts: float


def trajectory_of(records: list[StepRecord], mounting: Mounting, placed: PlacedObject | None = None) -> Trajectory:
    """The trajectory of a loop's steps on fresh frames.

    Parameters
    ----------
    records : list of StepRecord
    mounting : Mounting
    placed : PlacedObject, optional
        The object, if its place is known; it gives the true values.
    """
    used = [record for record in records if record.fresh]
    poses = np.array([record.exposed_pose for record in used]).reshape(-1, 6)
    felt = np.array([surface_place(mounting, record) for record in used]).reshape(-1, 3)
    estimated = (np.array([getattr(record, key) for record in used]) for key in ("depth_mm", "angle_deg"))
    true = [np.full(len(used), np.nan)] * 5
    if placed is not None:
        touches = [placed.touch(pose) for pose in poses]
        true = [np.array([getattr(touch, key) for touch in touches]) for key in ("depth_mm", "angle_deg", "indent_mm")]
        true.append(np.array([abs(placed.distance_mm(place)) for place in felt]))
        places = np.array([touch.place_mm for touch in touches]).reshape(-1, 3)
        true.append(distance_along(placed.outline(), places[:, [0, 2]]))
    return Trajectory(poses[:, :2], felt[:, :2], *estimated, *true)


def surface_place(mounting: Mounting, record: StepRecord) -> np.ndarray:
    """The place (3,) of the surface from an estimate: the foot of the perpendicular from the dome's centre to the tangent."""
    if np.isnan(record.depth_mm):  # a policy estimates no surface
        return np.full(3, np.nan)
    tangent = tangent_of(mounting, record.exposed_pose, Reading(record.depth_mm, record.angle_deg))
    tool = matrix_of(record.exposed_pose)
    centre, inward = tool[:3, :3] @ mounting.centre_mm + tool[:3, 3], tangent[:3, :3] @ mounting.axis
    on_tangent = tangent[:3, :3] @ mounting.apex_mm + tangent[:3, 3]
    return centre + (inward @ (on_tangent - centre)) * inward


def measure(path: Trajectory, *, indent_mm: float, angle_deg: float, wanted_mm: float) -> Measures:
    """Measures of a trajectory, for a reference depth and angle and a wanted distance along the outline."""
    steps, tool, completed = len(path.depth_mm), path.tool_mm, float("nan")
    late = slice(min(SETTLING_N, max(steps - 1, 0)), None)

    def mean_abs(values: np.ndarray) -> float:
        return float(np.abs(values[late]).mean()) if len(values[late]) else float("nan")

    off = float(np.sqrt((path.off_mm[late] ** 2).mean())) if len(path.off_mm) else float("nan")
    errors = mean_abs(path.depth_mm - path.true_depth_mm), mean_abs(path.angle_deg - path.true_angle_deg)
    holds = mean_abs(path.true_depth_mm - indent_mm), mean_abs(path.true_angle_deg - angle_deg)
    if wanted_mm > 0:
        completed = float(np.clip(path.along_mm.max(initial=0.0) / wanted_mm, 0, 1))
    lost = lost_contacts(path.true_indent_mm)
    return Measures(steps, smoothness(tool), local_smoothness(tool), off, *errors, *holds, jerk(tool), completed, lost)


def smoothness(points_mm: np.ndarray) -> float:
    """Mean of |dy / dx| over neighbouring points (M, 2); pairs of equal x have no slope and are left out."""
    dx, dy = np.diff(points_mm, axis=0).T if len(points_mm) > 1 else np.zeros((2, 0))
    sloped = np.abs(dx) > 1e-9
    return float(np.abs(dy[sloped] / dx[sloped]).mean()) if sloped.any() else float("nan")


def local_slopes(points_mm: np.ndarray) -> np.ndarray:
    """Smoothness (M - LOCAL_N + 1,) of each window of points, rotated so that its ends are on the x axis."""
    slopes = []
    for window in (points_mm[k : k + LOCAL_N] for k in range(len(points_mm) - LOCAL_N + 1)):
        chord = window[-1] - window[0]
        along = chord / max(np.linalg.norm(chord), 1e-9)
        slopes.append(smoothness((window - window[0]) @ np.column_stack([along, [-along[1], along[0]]])))
    return np.array(slopes)


def local_smoothness(points_mm: np.ndarray) -> float:
    """Mean of ``local_slopes``; NaN for too few points."""
    slopes = local_slopes(points_mm)
    return float(np.nanmean(slopes)) if len(slopes) else float("nan")


def jerk(points_mm: np.ndarray) -> float:
    """Root mean square of the third differences of points (M, 2)."""
    third = np.diff(points_mm, n=3, axis=0)
    return float(np.sqrt((third**2).sum(axis=1).mean())) if len(third) else float("nan")


def lost_contacts(indent_mm: np.ndarray) -> float:
    """Number of times that the indentation (M,) falls to zero or less. The start counts as contact. NaN if the indentation is not known."""
    if np.isnan(indent_mm).any():
        return float("nan")
    off = np.concatenate([[False], indent_mm <= 0])
    return float((off[1:] & ~off[:-1]).sum())


def distance_along(outline_mm: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """Distance (M,) along an outline (N, 2) to the places nearest to points (M, 2). On a closed outline it continues past the end."""
    steps = np.linalg.norm(np.diff(outline_mm, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    nearest = np.array([np.argmin(np.linalg.norm(outline_mm - point, axis=1)) for point in points_mm], int)
    if np.allclose(outline_mm[0], outline_mm[-1]) and len(nearest):
        found = np.unwrap(way[nearest], period=way[-1])
        return found - way[-1] * np.round(found[0] / way[-1])
    return way[nearest]


def write_csv(path: Path, trajectory: Trajectory) -> Path:
    """Write the trajectory as a table, and return its path."""
    columns: dict[str, np.ndarray] = {}
    for name, values in vars(trajectory).items():
        stem = name.removesuffix("_mm")
        columns |= {name: values} if values.ndim == 1 else {f"{stem}_x_mm": values[:, 0], f"{stem}_y_mm": values[:, 1]}
    steps = range(len(trajectory.tool_mm))
    return write_table(path, [{"step": k} | {name: float(values[k]) for name, values in columns.items()} for k in steps])


def trajectory_figure(path: Trajectory, measures: Measures, title: str, *, outline_mm: np.ndarray) -> Figure:
    """Panels: the trajectory, its roughest part if there are enough steps for one, and depth and angle if they are known.

    The outline (N, 2) is in the base frame.
    """
    slopes = local_slopes(path.tool_mm)
    rough = bool(np.isfinite(slopes).any())
    both = (path.depth_mm, path.true_depth_mm, "depth, mm"), (path.angle_deg, path.true_angle_deg, "angle from the normal, deg")
    courses = [course for course in both if np.isfinite(course[:2]).any()]
    panels = 1 + rough + len(courses)
    figure, axes = new_figure(min(panels, 2), -(-panels // 2), panel_inch=4.6)
    figure.suptitle(title)
    for ax in axes[panels:]:
        ax.axis("off")
    for ax in axes[: 1 + rough]:
        ax.plot(*outline_mm.T, color=muted_colour(), lw=3, alpha=0.5, label="object")
        ax.plot(*path.tool_mm.T, color=TOOL, lw=1, label="tool")
        if np.isfinite(path.surface_mm).any():
            ax.plot(*path.surface_mm.T, ".", color=FELT, ms=3, label="estimated surface")
        ax.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    axes[0].set_title("trajectory")
    axes[0].legend(loc="best", fontsize=8)
    if rough:
        worst = int(np.nanargmax(slopes))
        x, y = path.tool_mm[worst + LOCAL_N // 2]
        axes[1].set(xlim=(x - ZOOM_MM, x + ZOOM_MM), ylim=(y - ZOOM_MM, y + ZOOM_MM))
        axes[1].set_title(f"roughest: local S {slopes[worst]:.3f} (mean {measures.local_smoothness:.3f})")
    for ax, (estimated, true, name) in zip(axes[1 + rough :], courses, strict=False):
        for values, colour, width, label in ((true, muted_colour(), 2, "true"), (estimated, FELT, None, "estimated")):
            if np.isfinite(values).any():
                ax.plot(values, color=colour, lw=width, label=label)
        ax.set(xlabel="step", ylabel=name)
        ax.legend(fontsize=8)
    return figure


def comparison_figure(rows: list[tuple[str, str, Trajectory, np.ndarray]]) -> Figure:
    """A figure with objects as columns and models as rows, from (model, object, trajectory, outline) each."""
    models, objects = list(dict.fromkeys(row[0] for row in rows)), list(dict.fromkeys(row[1] for row in rows))
    figure, axes = new_figure(len(objects), len(models), panel_inch=3.2)
    for model, name, path, outline in rows:
        ax = axes[models.index(model) * len(objects) + objects.index(name)]
        ax.plot(*outline.T, color=muted_colour(), lw=3, alpha=0.5)
        ax.plot(*path.tool_mm.T, color=TOOL, lw=0.9)
        ax.set(title=f"{name}, {model}", aspect="equal", xticks=[], yticks=[])
    return figure
