"""Pictures of the demo and the self-contained page that shows them."""

import base64
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from twin.demo.stages import ContactResult
from twin.recordings.images import write_image
from twin.report.panel import Look, area_change_at
from twin.report.plots import area_surface_figure, draw_area_change, draw_displacement, draw_frame, draw_graph, draw_pins, new_figure
from twin.types import Form

DPI = 110


def write_figure(path: Path, figure: Figure) -> Path:
    """Write a matplotlib figure as PNG."""
    figure.savefig(path, dpi=DPI)
    return path


def contact_pictures(folder: Path, result: ContactResult) -> dict[str, Path]:
    """Write the pictures of one contact; the skin's own picture is drawn elsewhere."""
    look, stem = result.look, f"{result.sensor}-{result.stimulus}"
    pins, (ax,) = new_figure(1, panel_inch=6)
    draw_frame(ax, look.frame.image, around_px=look.rest.graph.nodes_px)
    draw_graph(ax, look.observation.graph)
    draw_pins(ax, look.observation)
    areas, (ax,) = new_figure(1, panel_inch=6)
    draw_area_change(ax, look.observation.graph, look.rest.graph.area_px2, "")
    written = {
        "raw": write_image(folder / f"{stem}-frame.png", result.raw.frame.image),
        "pins": write_figure(folder / f"{stem}-graph.png", pins),
        "areas": write_figure(folder / f"{stem}-areas.png", areas),
        "surfaces": write_figure(folder / f"{stem}-surfaces.png", area_surface_figure(look.rest.graph, look.observation.graph)),
    }
    if look.frame.form is Form.RECORDING:
        written["recorded"] = write_image(folder / f"{stem}-recorded.png", look.frame.image)
    return written


def motion_figure(motions: list[tuple[str, Look]]) -> Figure:
    """Displacement (top) and area change (bottom) for each motion, as in the paper's figure 1(d)."""
    figure, axes = new_figure(len(motions), 2, panel_inch=4.2)
    for column, (title, look) in enumerate(motions):
        rest, graph = look.rest.graph, look.observation.graph
        draw_displacement(axes[column], rest.nodes_px, graph.nodes_px, title)
        draw_area_change(axes[column + len(motions)], graph, rest.area_px2, "")
    return figure


def contact_figures(result: ContactResult, contact_px: np.ndarray) -> list[tuple[str, str]]:
    """Names and values of one contact's figures, as shown on the page."""
    look, force = result.look, result.state.force_n
    observation = look.observation
    return [
        ("pins found", f"{observation.found} of {len(observation.pins_px)}"),
        ("directed edges (Delaunay)", f"{len(observation.graph.edges)}"),
        ("force on the object, N", f"({force[0]:+.2f}, {force[1]:+.2f}, {force[2]:+.2f})"),
        ("contact area, mm²", f"{result.state.area_mm2:.1f}"),
        ("cell area at the contact against no contact", f"{area_change_at(look, contact_px, count=12):+.1f} %"),
        *((f"{name}, s", f"{value:.3f}") for name, value in result.seconds.items()),
    ]


def embed(path: Path) -> str:
    """A picture as a data URI."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
