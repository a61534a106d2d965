"""The style of all charts. Each chart is drawn once for each theme of the pages."""

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np
from cycler import cycler
from matplotlib import RcParams, colormaps, rc_context, rc_params_from_file
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from twin.report.table import number
from twin.report.themes import DARK, LIGHT, SERIES, Theme, dark_of
from twin.store import write_bytes

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
    """Draw a chart in the light theme to ``path``, and in the dark theme to `twin.report.themes.dark_of` this path. Returns the path.

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
