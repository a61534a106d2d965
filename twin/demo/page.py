"""The demo's page, with pictures and tables of its results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from twin.frames.images import write_image
from twin.report.charts import new_figure, write_chart
from twin.report.numbers import force_interval, number
from twin.report.page import Page, PagePicture, code, sentence
from twin.report.plots import (
    ObservedFrame,
    area_change_at,
    area_surface_figure,
    draw_area_change,
    draw_displacement,
    draw_frame,
    draw_graph,
    draw_pins,
)
from twin.report.table import Column
from twin.types import Form

if TYPE_CHECKING:
    from twin.demo.make_demo import ContactResult, DepthRow

# Commands that a reader of the page may try next, and what each shows.
NEXT = (
    ("twin studio", "a page on which you drag the object over the skin, and see picture, graph, forces and the estimated pose at once"),
    ("twin render --sensor ur5-331 --object ball-40 --indent-mm 2 --out out/ball", "a contact of your own; 'twin objects' names others"),
    ("twin servo --object can --steps 30 --out out/can", "the sensor follows a can, by the pose that a model reads from its frames"),
    ("twin new FRAMES --out mine.toml", "your own sensor, from a folder of its frames"),
    ("twin --help", "all commands; each one's help ends with an example"),
)


@dataclass(frozen=True)
class ContactContent:
    """The content of the page about one contact.

    Attributes
    ----------
    title, description : str
    pictures : dict of str to Path
        Pictures from `contact_pictures`, and ``skin``.
    raw_size : str
        Size of the raw frame.
    figures : list of (str, str)
        As `contact_figures` gives them.
    """

    title: str
    description: str
    pictures: dict[str, Path]
    raw_size: str
    figures: list[tuple[str, str]]


def contact_pictures(folder: Path, result: "ContactResult") -> dict[str, Path]:
    """Write the pictures of one contact, except the picture of the skin."""
    look, stem = result.look, f"{result.sensor}-{result.object_name}"
    graph, rest = look.graphs()
    written = {
        "raw": write_image(folder / f"{stem}-frame.png", result.raw.frame.image),
        "pins": write_chart(folder / f"{stem}-graph.png", lambda: _graph_figure(look)),
        "areas": write_chart(folder / f"{stem}-areas.png", lambda: _areas_figure(look)),
        "surfaces": write_chart(folder / f"{stem}-surfaces.png", lambda: area_surface_figure(rest, graph)),
    }
    if look.frame.form == Form.PROCESSED:
        written["recorded"] = write_image(folder / f"{stem}-recorded.png", look.frame.image)
    return written


def motion_figure(motions: list[tuple[str, ObservedFrame]]) -> Figure:
    """Displacement (top) and area change (bottom) for each motion, as in the paper's figure 1(d)."""
    figure, axes = new_figure(len(motions), 2, panel_inch=4.2)
    for column, (title, look) in enumerate(motions):
        graph, rest = look.graphs()
        draw_displacement(axes[column], rest.nodes_px, graph.nodes_px, title)
        draw_area_change(axes[column + len(motions)], graph, rest.area_px2, "")
    return figure


def contact_figures(result: "ContactResult", contact_px: np.ndarray) -> list[tuple[str, str]]:
    """Names and values of one contact's figures, as shown on the page."""
    look, force = result.look, result.state.force_n
    observation = look.observation
    ends = force_interval(force.tolist(), result.stiffness_factor)
    parts = ", ".join(number(float(part), decimals=2, signed=True) for part in force)
    return [
        ("pins found", f"{observation.found} of {len(observation.pins_px)}"),
        ("directed edges (Delaunay)", number(len(look.graphs()[0].edges))),
        ("force on the object, N", f"({parts})"),
        ("90 % interval of its size, N", " to ".join(number(each, decimals=2) for each in ends)),
        ("contact area, mm²", number(float(result.state.area_mm2), decimals=1)),
        ("cell area at the contact against no contact", f"{number(area_change_at(look, contact_px, count=12), decimals=1, signed=True)} %"),
        *((f"{name}, s", number(value, decimals=3)) for name, value in result.seconds.items()),
    ]


def write_page(
    path: Path,
    *,
    machine: str,
    contacts: Sequence[ContactContent],
    motions: Path,
    motion_sensor: str,
    tables: Mapping[str, Sequence["DepthRow"]],
    seconds: Mapping[str, float],
) -> Path:
    """Write the page with all pictures inside, and return its path.

    Parameters
    ----------
    path : Path
    machine : str
        Renderer and machine.
    contacts : sequence of ContactContent
    motions : Path
        Chart of `motion_figure`.
    motion_sensor : str
    tables : mapping of str to sequence of DepthRow
        By sensor.
    seconds : mapping of str to float
        Time of each stage.
    """
    page = Page("TacTip twin", "twin demo", topic="Demo")
    page.lead = sentence(
        "A skin pressed by finite elements, the view of the camera inside it path-traced, and the pins found in that picture by the same "
        "pipeline that runs on a real sensor. Everything on this page was computed by",
        code("make demo") + ".",
        machine,
    )
    for contact in contacts:
        _contact_section(page, contact)
    _motions_section(page, motions, motion_sensor)
    _tables_section(page, tables)
    _time_section(page, seconds)
    page.section(
        "What to try next", "The tutorials in docs/tutorials go through each of these; 'make docs' builds the whole documentation."
    )
    page.items([sentence(code(command) + ":", what + ".") for command, what in NEXT])
    return page.write(path, embed=True)


def _contact_section(page: Page, contact: ContactContent) -> None:
    at, title = contact.pictures, contact.title
    page.section(title, contact.description)
    shown = [
        PagePicture(
            at["skin"], f"{title}: deformed skin in 3D", "The skin, cut open, coloured by its displacement, with pins and object.", "photo"
        ),
        PagePicture(at["raw"], f"{title}: rendered camera frame", f"What the camera inside sees ({contact.raw_size}).", "frame"),
    ]
    if "recorded" in at:
        said = "The same frame in the form of this sensor's recordings: cropped, adaptively thresholded, resized."
        shown.append(PagePicture(at["recorded"], f"{title}: frame in the form of a recording", said, "frame"))
    page.figures(*shown, layout="row")
    page.figures(
        PagePicture(
            at["pins"],
            f"{title}: pins and Voronoi graph",
            "Pins found (green), graph edges (blue) and Voronoi cells (white); yellow crosses are spots that are not pins.",
        ),
        PagePicture(
            at["areas"], f"{title}: Voronoi area change", "Voronoi cell areas against no contact: cells grow where the dome flattens."
        ),
        layout="row",
    )
    page.figures(
        PagePicture(
            at["surfaces"],
            f"{title}: interpolated area surfaces",
            "Cell area interpolated over the image: no contact, contact, difference.",
        )
    )
    page.table([{"name": name, "value": value} for name, value in contact.figures], [Column("name", "figure"), Column("value", "value")])


def _motions_section(page: Page, motions: Path, sensor: str) -> None:
    page.section(
        "Three motions, three signatures",
        "Pressing (Z) spreads the pins outwards. Dragging along x or y carries them with the object until they slip.",
    )
    page.figures(
        PagePicture(
            motions,
            "Displacement of the pins and change of the Voronoi areas for motions along Z, X and Y",
            f"Pin displacement (top) and Voronoi area change (bottom) for motions along Z, X and Y, on {sensor}.",
        )
    )


def _tables_section(page: Page, tables: Mapping[str, Sequence["DepthRow"]]) -> None:
    page.section(
        "Against real recordings: displacement by depth",
        "Mean displacement of all pins on a flat plate, in pixels of the uncropped camera frame. Measured: the Tac-VGNN release's "
        "recordings, pure presses in 1 mm bins. Simulated: true cap positions at the middle of each bin, with nominal stiffness; the "
        "hexagonal sensor's camera distance and pin spacing were chosen with these figures in view. The differences are those of a skin "
        "that is not calibrated: 'twin calibrate contact' fits skin and arm to a recording, and docs/results says how small they are then.",
    )
    columns = [
        Column("indent_mm", "indentation", "mm", decimals=1),
        Column("measured_px", "measured", "px", decimals=1),
        Column("simulated_px", "simulated", "px", decimals=1),
        Column("contact_area_change_percent", "cell area at the contact", "%", decimals=1, signed=True),
        Column("force_n", "force", "N", decimals=2),
    ]
    for sensor, rows in tables.items():
        page.table([vars(row) for row in rows], columns, caption=sensor)


def _time_section(page: Page, seconds: Mapping[str, float]) -> None:
    page.section("Time")
    total = {"stage": "all", "seconds": sum(seconds.values())}
    stages = [{"stage": name, "seconds": value} for name, value in seconds.items()]
    page.table([*stages, total], [Column("stage", "stage"), Column("seconds", "time", "s", decimals=2)])


def _graph_figure(look: ObservedFrame) -> Figure:
    figure, (ax,) = new_figure(1, panel_inch=6)
    graph, rest = look.graphs()
    draw_frame(ax, look.frame.image, around_px=rest.nodes_px)
    draw_graph(ax, graph)
    draw_pins(ax, look.observation)
    return figure


def _areas_figure(look: ObservedFrame) -> Figure:
    figure, (ax,) = new_figure(1, panel_inch=6)
    graph, rest = look.graphs()
    draw_area_change(ax, graph, rest.area_px2, "")
    return figure
