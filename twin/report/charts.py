"""The style of all charts, and drawings of pins, graphs and Voronoi areas on given axes.

Each chart is drawn once for each theme of the pages.
"""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cycler import cycler
from matplotlib import RcParams, colormaps, rc_context, rc_params_from_file
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.ticker import FuncFormatter
from mpl_toolkits.mplot3d import Axes3D
from scipy.interpolate import CloughTocher2DInterpolator

from twin.errors import FrameError
from twin.geometry.pins import usual_spacing
from twin.report.page import DARK, LIGHT, SERIES, Theme, dark_of, number
from twin.store import write_bytes
from twin.types import Frame, Observation, PinGraph

DPI = 140
# Number of colours of a colour map.
SHADES = 256
# Ratio of an axis' largest to its smallest value below which labels at powers of ten alone are too few.
FEW_DECADES = 100.0

_FORM = rc_params_from_file(Path(__file__).with_name("charts.mplstyle"), use_default_template=False)
"""The part of the style that is the same in all themes."""
_theme: ContextVar[Theme] = ContextVar("theme", default=LIGHT)


def new_figure(columns: int, rows: int = 1, *, panel_inch: float = 4.0, projection: str | None = None) -> tuple[Figure, np.ndarray]:
    """A figure of square panels in the current theme, without a window, and its axes as a flat array."""
    return sized_figure((columns * panel_inch, rows * panel_inch), columns, rows, projection=projection)


def sized_figure(
    size_inch: tuple[float, float], columns: int = 1, rows: int = 1, *, projection: str | None = None
) -> tuple[Figure, np.ndarray]:
    """A figure of a given width and height in the current theme, without a window, and its axes as a flat array."""
    with rc_context(_style(_theme.get())):
        figure = Figure(figsize=size_inch, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": projection})
    return figure, axes.ravel()


def write_chart(path: Path, draw: Callable[[], Figure], *, dpi: int = DPI) -> Path:
    """Draw a chart in the light theme to ``path``, and in the dark theme to `twin.report.page.dark_of` this path. Returns the path.

    Parameters
    ----------
    path : Path
        A PNG file.
    draw : callable
        Makes the figure with `new_figure` or `sized_figure`. It is called once for each theme.
    dpi : int
    """
    for theme, target in ((LIGHT, path), (DARK, dark_of(path))):
        with draw_in_theme(theme):
            save_figure(target, draw(), dpi=dpi)
    return path


def save_figure(path: Path, figure: Figure, *, dpi: int = DPI) -> Path:
    """Write a figure that is not part of a page as PNG, in the theme that it was made in, and return the path."""
    content = io.BytesIO()
    figure.savefig(content, dpi=dpi, format="png")
    return write_bytes(path, content.getvalue())


@contextmanager
def draw_in_theme(theme: Theme) -> Iterator[None]:
    """Context in which everything is drawn in the colours of a theme."""
    token = _theme.set(theme)
    try:
        with rc_context(_style(theme)):
            yield
    finally:
        _theme.reset(token)


def ink() -> str:
    """Colour of text in the current theme."""
    return _theme.get().ink


def muted_colour() -> str:
    """Colour of secondary elements in the current theme: limits, references, the true course."""
    return _theme.get().muted


def faint() -> str:
    """Colour of areas and rules in the background."""
    return _theme.get().line


def sequential() -> ListedColormap:
    """Viridis without the end that has too little contrast to the theme's background."""
    low, high = (0.0, 0.88) if _theme.get() == LIGHT else (0.2, 1.0)
    return ListedColormap(colormaps["viridis"](np.linspace(low, high, SHADES)))


def plain_log(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers. If there are few powers of ten, 2, 3 and 5 are also labelled."""

    def between(value: float, _: int | None) -> str:
        low, high = sorted(axis.get_view_interval())
        return number(value, 1) if high < FEW_DECADES * low and f"{value:.0e}"[0] in "235" else ""

    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 1)))
    axis.set_minor_formatter(FuncFormatter(between))


def _style(theme: Theme) -> RcParams:
    panes = {f"axes3d.{axis}axis.panecolor": theme.page for axis in "xyz"}
    colours = {
        "figure.facecolor": theme.surface,
        "savefig.facecolor": theme.surface,
        "axes.facecolor": theme.surface,
        "axes.edgecolor": theme.muted,
        "axes.labelcolor": theme.ink,
        "axes.titlecolor": theme.ink,
        "text.color": theme.ink,
        "xtick.color": theme.muted,
        "ytick.color": theme.muted,
        "xtick.labelcolor": theme.ink,
        "ytick.labelcolor": theme.ink,
        "grid.color": theme.line,
        "axes.prop_cycle": cycler(color=SERIES),
    }
    return RcParams(_FORM | panes | colours)


FOUND = "#19d3a2"
"""Colour of found pins and of nodes."""
LOST = "#ff5c5c"
"""Colour of the predicted places of lost pins."""
EXTRA = "#ffb000"
"""Colour of rejected blobs."""
EDGE = "#5ec8ff"
"""Colour of a graph's edges."""
BORDER = "#00000040"
"""Colour of a coloured cell's border, which is visible on any ground."""
FRAME_REACH = 0.6
"""Distance from the middle of the pins to each side of the shown part of a frame, as a share of the pins' extent."""
ENLARGEMENTS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Possible factors by which arrows are enlarged."""
LONG_PERCENTILE = 95
"""Percentile of the arrows' lengths that is used as the longest. Longer arrows may reach beyond the next pin."""
SURFACE_GRID = 80
"""Number of samples across an interpolated surface."""


def draw_frame(ax: Axes, image: np.ndarray, title: str = "", *, around_px: np.ndarray | None = None) -> None:
    """Draw a frame in pixels with y down. If points (N, 2) are given, only the part around them is drawn."""
    ax.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    if around_px is not None:
        height, width = image.shape[:2]
        center, reach = around_px.mean(axis=0), FRAME_REACH * np.ptp(around_px, axis=0).max()
        ax.set_xlim(max(center[0] - reach, -0.5), min(center[0] + reach, width - 0.5))
        ax.set_ylim(min(center[1] + reach, height - 0.5), max(center[1] - reach, -0.5))
    _without_frame(ax, title)


def draw_graph(ax: Axes, graph: PinGraph) -> None:
    """Draw the edges of a graph, and its cells if it has a tessellation."""
    once = graph.edges[graph.edges[:, 0] < graph.edges[:, 1]] if graph.kind != "knn" else graph.edges
    ax.add_collection(LineCollection(list(graph.nodes_px[once]), colors=EDGE, linewidths=0.7, alpha=0.85))
    if graph.cells:
        ax.add_collection(PolyCollection(graph.cells, facecolors="none", edgecolors="#ffffff", linewidths=0.5, alpha=0.6))


def draw_nodes(ax: Axes, graph: PinGraph) -> None:
    """Draw the nodes of a graph."""
    ax.plot(*graph.nodes_px.T, ".", color=FOUND, markersize=4)


def draw_pins(ax: Axes, observation: Observation) -> None:
    """Draw found pins, the predicted places of lost ones, and the rejected blobs."""
    ax.plot(*observation.pins_px.T, ".", color=FOUND, markersize=4)
    ax.plot(*observation.predicted_px.T, "x", color=LOST, markersize=6)
    if len(observation.extra_px):
        ax.plot(*observation.extra_px.T, "+", color=EXTRA, markersize=6)


def draw_area_change(ax: Axes, graph: PinGraph, rest_area_px2: np.ndarray, title: str, *, limit: float | None = None) -> None:
    """Draw Voronoi cells coloured by the relative change of their area from rest in percent, up to ``limit`` (default: the largest)."""
    change = 100 * (graph.area_px2 / rest_area_px2 - 1)
    limit = limit or max(5.0, float(np.nanpercentile(np.abs(change), 99)))
    cells = PolyCollection(graph.cells, array=change, cmap="RdBu_r", clim=(-limit, limit), edgecolors=BORDER, linewidths=0.4)
    ax.add_collection(cells)
    _pixel_axes(ax, graph.nodes_px, title)
    ax.figure.colorbar(cells, ax=ax, shrink=0.8, label="change of cell area, %")


def draw_displacement(ax: Axes, rest_px: np.ndarray, pins_px: np.ndarray, title: str, *, enlarged: float = 1.0) -> None:
    """Draw arrows from each pin's place at rest (N, 2) to its present place, ``enlarged`` by a factor. Colours show the true lengths."""
    moved = pins_px - rest_px
    length = np.hypot(*moved.T)
    ax.plot(*rest_px.T, ".", color=faint(), markersize=3)
    arrows = ax.quiver(*rest_px.T, *moved.T, length, angles="xy", scale_units="xy", scale=1 / enlarged, cmap=sequential(), width=0.004)
    _pixel_axes(ax, rest_px, title)
    ax.figure.colorbar(arrows, ax=ax, shrink=0.8, label="displacement, px" + (f" (arrows {enlarged:g} times)" if enlarged != 1 else ""))


def enlargement(rest_px: np.ndarray, pins_px: np.ndarray) -> float:
    """Factor to enlarge arrows between points (N, 2): the largest one with which a long arrow does not exceed the distance of two pins."""
    apart = usual_spacing(rest_px)
    longest = np.percentile(np.hypot(*(pins_px - rest_px).T), LONG_PERCENTILE)
    return max((factor for factor in ENLARGEMENTS if factor * longest <= apart), default=ENLARGEMENTS[0])


def draw_area_surface(ax: Axes3D, nodes_px: np.ndarray, value: np.ndarray, title: str, *, change: bool = False) -> None:
    """Draw a value of each pin as a smooth surface over the image plane (cubic interpolation; 3D axes). A ``change`` has two signs."""
    low, high = nodes_px.min(axis=0), nodes_px.max(axis=0)
    grid_x, grid_y = np.meshgrid(*[np.linspace(a, b, SURFACE_GRID) for a, b in zip(low, high, strict=True)])
    surface = CloughTocher2DInterpolator(nodes_px, value)(grid_x, grid_y)
    largest = float(np.nanmax(np.abs(value)))
    colours = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest} if change else {"cmap": sequential()}
    drawn = ax.plot_surface(grid_x, grid_y, surface, rcount=SURFACE_GRID, ccount=SURFACE_GRID, linewidth=0, **colours)
    ax.figure.colorbar(drawn, ax=ax, shrink=0.5, pad=0.12, label="px²")
    ax.set(xlabel="x, px", ylabel="y, px")
    ax.set_title(title, loc="center", y=0.97)
    ax.invert_yaxis()


def area_surface_figure(rest: PinGraph, contact: PinGraph) -> Figure:
    """The three surfaces of the paper's figure 4: no contact, contact, and their difference (px^2)."""
    figure, axes = new_figure(3, projection="3d")
    draw_area_surface(axes[0], rest.nodes_px, rest.area_px2, "no contact: cell area")
    draw_area_surface(axes[1], contact.nodes_px, contact.area_px2, "contact: cell area")
    draw_area_surface(axes[2], contact.nodes_px, contact.area_px2 - rest.area_px2, "change of cell area", change=True)
    return figure


@dataclass(frozen=True)
class ObservedFrame:
    """A frame with its observation, and the graph of the same sensor's pins without contact."""

    frame: Frame
    observation: Observation
    rest: PinGraph

    def graphs(self) -> tuple[PinGraph, PinGraph]:
        """The graphs of the frame and of the frame without contact.

        Raises
        ------
        FrameError
            The pipeline found no graph in the frame.
        """
        if self.observation.graph is None:
            raise FrameError(f"{self.frame.name}: no graph of its pins: {self.observation.reason}")
        return self.observation.graph, self.rest


def contact_panel(skin_picture: Path, look: ObservedFrame, title: str) -> Figure:
    """A figure with six panels of one contact. If the pipeline found no graph, the reason is shown instead."""
    figure, axes = new_figure(3, 2, panel_inch=4.4)
    figure.suptitle(title)
    axes[0].imshow(imread(skin_picture))
    axes[0].set(title="deformed skin, cut open", xticks=[], yticks=[])
    draw_frame(axes[1], look.frame.image, "what the camera sees")
    around_px = look.rest.nodes_px
    draw_frame(axes[2], look.frame.image, f"{look.observation.found} pins found", around_px=around_px)
    draw_pins(axes[2], look.observation)
    graph = look.observation.graph
    if graph is None:
        for ax in axes[3:]:
            ax.text(0.5, 0.5, look.observation.reason, ha="center", wrap=True)
            ax.set_axis_off()
        return figure
    draw_frame(axes[3], look.frame.image, f"Voronoi graph: {len(graph.edges)} directed edges", around_px=around_px)
    draw_graph(axes[3], graph)
    draw_area_change(axes[4], graph, look.rest.area_px2, "Voronoi areas against no contact")
    draw_displacement(axes[5], around_px, graph.nodes_px, "pin displacement")
    return figure


def area_change_at(look: ObservedFrame, center_px: np.ndarray, *, count: int) -> float:
    """Mean relative change (percent) of the Voronoi areas of the ``count`` pins nearest to a point."""
    graph, rest = look.graphs()
    near = np.argsort(np.hypot(*(graph.nodes_px - center_px).T))[:count]
    return float(100 * np.mean(graph.area_px2[near] / rest.area_px2[near] - 1))


def _without_frame(ax: Axes, title: str) -> None:
    """Remove ticks and frame of an axes, and set its title."""
    ax.set(title=title, xticks=[], yticks=[])
    ax.spines[:].set_visible(False)


def _pixel_axes(ax: Axes, points_px: np.ndarray, title: str) -> None:
    """Set the limits of an axes to pixels around points (N, 2), with y down."""
    low, high = np.nanmin(points_px, axis=0), np.nanmax(points_px, axis=0)
    margin = 0.08 * (high - low)
    ax.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(high[1] + margin[1], low[1] - margin[1]), aspect="equal")
    _without_frame(ax, title)
