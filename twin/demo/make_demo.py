"""The demo: contacts through the whole chain, three motions and the depth table, in their order, and a page that shows them."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure

from scenes import ObjectSpec, SensorSpec, load_object, load_sensor
from twin.camera.projection import project, project_in_form
from twin.frames.forms import form_named
from twin.frames.images import write_image
from twin.mechanics.path import ContactPose
from twin.objects import build_field
from twin.one_contact import look_at
from twin.pins.graph import make_graph
from twin.pins.labelling.reference import nominal_reference
from twin.progress import Progress, Step, report_each, silent, stage, unheard
from twin.report import charts
from twin.report.charts import new_figure, write_chart
from twin.report.page import Column, Page, PagePicture, code, force_interval, number, sentence
from twin.report.skin3d import draw_contact_skin
from twin.simulator import RenderedFrame, Simulator
from twin.store import writes
from twin.types import ContactState, Form, ImageArray, ReadableResult

Result = TypeVar("Result")

# Contacts of the demo: sensor, object, pose, and the form of the frames in which the pins are found.
CONTACTS = (
    ("ur5-331", "edge", ContactPose(indent_mm=3.5), Form.RAW),
    ("mg400-331", "plane", ContactPose(indent_mm=4.0, tilt_deg=(0.0, 8.0)), Form.PROCESSED),
    ("mg400-127", "sphere", ContactPose(indent_mm=4.0, offset_mm=(3.0, -2.0)), Form.PROCESSED),
)
# The three motions of the paper's figure 1(d).
MOTIONS = (
    ("Z: pressed 4 mm", ContactPose(indent_mm=4.0)),
    ("X: then dragged 3 mm along x", ContactPose(indent_mm=4.0, shear_mm=(3.0, 0.0))),
    ("Y: then dragged 3 mm along y", ContactPose(indent_mm=4.0, shear_mm=(0.0, 3.0))),
)
# Mean pin displacement of pure presses in the Tac-VGNN release's recordings (Apache-2.0), px of the uncropped camera frame, for pose_2 in
# four 1 mm bins from -4 to 0. The indentation is about pose_2 + 5 mm.
MEASURED_DISPLACEMENT_PX = {"mg400-331": (1.9, 3.4, 5.0, 7.5), "mg400-127": (2.2, 3.8, 6.0, 8.9)}
# Middles of these bins as indentations, mm.
TABLE_INDENTS_MM = (1.5, 2.5, 3.5, 4.5)
# Commands that a reader of the page may try next, and what each shows.
NEXT = (
    ("twin studio", "a page on which you drag the object over the skin, and see picture, graph, forces and the estimated pose at once"),
    ("twin render --sensor ur5-331 --object ball-40 --indent-mm 2 --out out/ball", "a contact of your own; 'twin objects' names others"),
    ("twin servo --object can --steps 30 --out out/can", "the sensor follows a can, by the pose that a model reads from its frames"),
    ("twin new FRAMES --out mine.toml", "your own sensor, from a folder of its frames"),
    ("twin --help", "all commands; each one's help ends with an example"),
)


@dataclass(frozen=True)
class ContactResult:
    """One contact through the whole chain."""

    sensor: SensorSpec
    obj: ObjectSpec
    pose: ContactPose
    state: ContactState
    raw: RenderedFrame
    look: charts.ObservedFrame
    seconds: dict[str, float]


def run_contact(simulator: Simulator, obj: ObjectSpec, pose: ContactPose, form: Form, *, progress: Step = unheard) -> ContactResult:
    """Press, render, capture, detect, and build the graph, for one contact."""
    form, seconds = form_named(form), {}

    def clock(stage: str, work: Callable[[], Result]) -> Result:
        start = perf_counter()
        result = work()
        seconds[stage] = perf_counter() - start
        return result

    state = clock("press", lambda: simulator.press(obj, pose, progress=progress))
    raw = clock("render", lambda: simulator.render(state))
    rendered = raw if form == Form.RAW else clock("capture", lambda: simulator.as_processed(raw, state))
    look = look_at(simulator, rendered)
    seconds["pins and graph"] = look.observation.ms["total"] / 1e3
    return ContactResult(simulator.spec, obj, pose, state, raw, look, seconds)


@dataclass(frozen=True)
class DepthRow:
    """One depth of the table: mean displacement of all pins and growth of the cells at the contact."""

    indent_mm: float
    simulated_px: float
    measured_px: float
    contact_area_change_percent: float
    force_n: float


def depth_table(sensor: str, *, progress: Step = unheard) -> list[DepthRow]:
    """Press a plane to the four depths of the recordings' table (true caps, no rendering)."""
    spec = load_sensor(sensor)
    simulator = Simulator(spec)
    rest_px = project(spec.view, simulator.rest.caps_mm)
    outmost = nominal_reference(spec, Form.RAW).outmost
    rest_area_px2 = make_graph("voronoi", rest_px, outmost=outmost).area_px2
    middle = np.argsort(np.hypot(*(rest_px - rest_px[0]).T))[: spec.pins.count // 8]
    rows = []
    pairs = list(zip(TABLE_INDENTS_MM, MEASURED_DISPLACEMENT_PX[sensor], strict=True))
    for indent_mm, measured_px in report_each(pairs, progress):
        state = simulator.press(load_object("plane"), ContactPose(indent_mm=indent_mm))
        caps_px = project(spec.view, state.caps_mm)
        areas = make_graph("voronoi", caps_px, outmost=outmost).area_px2
        change = 100 * float(np.mean(areas[middle] / rest_area_px2[middle]) - 1)
        moved = float(np.hypot(*(caps_px - rest_px).T).mean())
        rows.append(DepthRow(indent_mm, moved, measured_px, change, float(state.force_n[2])))
    return rows


@dataclass(frozen=True, repr=False)
class Demo(ReadableResult):
    """The result of the demo.

    Attributes
    ----------
    tables : dict of str to list of DepthRow
        Displacement by depth, by the sensor's name.
    written : list of Path
        The files, the page first.
    """

    tables: dict[str, list[DepthRow]]
    written: list[Path]

    def lines(self) -> list[str]:
        """The tables as lines of text."""
        lines = []
        for sensor, rows in self.tables.items():
            lines += [
                f"{sensor}: mean pin displacement, px (measured on the Tac-VGNN recordings / simulated)",
                "  indentation, mm  " + "".join(f"{row.indent_mm:8.1f}" for row in rows),
                "  measured, px     " + "".join(f"{row.measured_px:8.1f}" for row in rows),
                "  simulated, px    " + "".join(f"{row.simulated_px:8.1f}" for row in rows),
                "  area at contact %" + "".join(f"{row.contact_area_change_percent:+8.1f}" for row in rows),
            ]
        return [*lines, f"open {self.written[0]} in a browser"]


@writes("index.html", "pictures")
def run_demo(out: Path, *, progress: Progress = silent) -> Demo:
    """Run the whole demo into a folder."""
    bar = partial(stage, progress)
    pictures = out / "pictures"
    pictures.mkdir(exist_ok=True)
    page = Page("TacTip twin", "twin demo", topic="Demo")
    simulators: dict[str, Simulator] = {}
    seconds: dict[str, float] = {}
    notes: set[str] = set()
    for sensor, object_name, pose, form in CONTACTS:
        start = perf_counter()
        with bar(f"{sensor}: press the {object_name}, render, detect") as step:
            simulator = simulators[sensor] = Simulator(load_sensor(sensor))
            result = run_contact(simulator, load_object(object_name), pose, form, progress=step)
        seconds[f"{sensor} against {object_name}"] = perf_counter() - start
        with bar(f"{sensor}: pictures"):
            skin = pictures / f"{sensor}-{object_name}-skin.png"
            notes.add(draw_contact_skin(simulator.solver.mesh, simulator.spec.pins, result.state, build_field(result.obj), skin))
            add_contact(page, result, skin)

    motion_sensor = CONTACTS[0][0]
    start = perf_counter()
    with bar(f"{motion_sensor}: motions along Z, X and Y") as step:
        moved = report_each(MOTIONS, step)
        looks = [(title, run_contact(simulators[motion_sensor], load_object("plane"), pose, Form.RAW).look) for title, pose in moved]
        add_motions(page, write_chart(pictures / "motions.png", lambda: motion_figure(looks)))
    seconds["motions"] = perf_counter() - start

    tables = {}
    start = perf_counter()
    for sensor in MEASURED_DISPLACEMENT_PX:
        with bar(f"{sensor}: displacement by depth") as step:
            tables[sensor] = depth_table(sensor, progress=step)
    seconds["displacement tables"] = perf_counter() - start
    add_tables(page, tables)

    renderer = simulators[motion_sensor].describe()["renderer"]
    machine = f"Rendered with Mitsuba variant {renderer['variant']} on {os.cpu_count()} cores ({platform.machine()})."
    written = write_page(out / "index.html", page, " ".join([machine, *sorted(notes)]), seconds)
    return Demo(tables, [written, *sorted(pictures.iterdir())])


def motion_figure(motions: list[tuple[str, charts.ObservedFrame]]) -> Figure:
    """Displacement (top) and area change (bottom) for each motion, as in the paper's figure 1(d)."""
    figure, axes = new_figure(len(motions), 2, panel_inch=4.2)
    for column, (title, look) in enumerate(motions):
        graph, rest = look.graphs()
        charts.draw_displacement(axes[column], rest.nodes_px, graph.nodes_px, title)
        charts.draw_area_change(axes[column + len(motions)], graph, rest.area_px2, "")
    return figure


def contact_figures(result: ContactResult) -> list[tuple[str, str]]:
    """Names and values of one contact's figures, as shown on the page."""
    look, spec, force, touched = result.look, result.sensor, result.state.force_n, result.state.contact_mm
    observation = look.observation
    ends = force_interval(force.tolist(), spec.skin.stiffness_factor)
    contact_mm = touched.mean(axis=0) if len(touched) else np.array([0, 0, spec.skin.apex_mm])
    grown = charts.area_change_at(look, project_in_form(spec, look.frame.form, contact_mm[None])[0], count=12)
    parts = ", ".join(number(float(part), decimals=2, signed=True) for part in force)
    return [
        ("pins found", f"{observation.found} of {len(observation.pins_px)}"),
        ("directed edges (Delaunay)", number(len(look.graphs()[0].edges))),
        ("force on the object, N", f"({parts})"),
        ("90 % interval of its size, N", " to ".join(number(each, decimals=2) for each in ends)),
        ("contact area, mm²", number(float(result.state.area_mm2), decimals=1)),
        ("cell area at the contact against no contact", f"{number(grown, decimals=1, signed=True)} %"),
        *((f"{name}, s", number(value, decimals=3)) for name, value in result.seconds.items()),
    ]


def write_page(path: Path, page: Page, machine: str, seconds: dict[str, float]) -> Path:
    """Add the lead, the time of each stage and what to try next to the page. It is written with all pictures inside."""
    page.lead = sentence(
        "A skin pressed by finite elements, the view of the camera inside it path-traced, and the pins found in that picture by the same "
        "pipeline that runs on a real sensor. Everything on this page was computed by",
        code("make demo") + ".",
        machine,
    )
    page.section("Time")
    stages = [{"stage": name, "seconds": value} for name, value in (seconds | {"all": sum(seconds.values())}).items()]
    page.table(stages, [Column("stage", "stage"), Column("seconds", "time", "s", decimals=2)])
    page.section("What to try next", "The tutorials in docs/tutorials go through each of these; 'make docs' builds all documents.")
    page.items([sentence(code(command) + ":", what + ".") for command, what in NEXT])
    return page.write(path, embed=True)


def add_contact(page: Page, result: ContactResult, skin: Path) -> None:
    """Add a section about a contact. Its pictures are written beside that of the skin."""
    look, spec, stem = result.look, result.sensor, f"{result.sensor.name}-{result.obj.name}"
    title = f"{spec.name} against {result.obj.name}"
    height, width = result.raw.frame.image.shape[:2]
    graph, rest = look.graphs()

    def frame(name: str, image: ImageArray, shown: str, said: str) -> PagePicture:
        return PagePicture(write_image(skin.parent / f"{stem}-{name}.png", image), f"{title}: {shown}", said, "frame")

    def chart(name: str, make: Callable[[], Figure], shown: str, said: str) -> PagePicture:
        return PagePicture(write_chart(skin.parent / f"{stem}-{name}.png", make), f"{title}: {shown}", said)

    def graph_figure() -> Figure:
        figure, (ax,) = new_figure(1, panel_inch=6)
        charts.draw_frame(ax, look.frame.image, around_px=rest.nodes_px)
        charts.draw_graph(ax, graph)
        charts.draw_pins(ax, look.observation)
        return figure

    def areas_figure() -> Figure:
        figure, (ax,) = new_figure(1, panel_inch=6)
        charts.draw_area_change(ax, graph, rest.area_px2, "")
        return figure

    page.section(title, f"{spec.description}. {result.obj.description}, pressed in by {result.pose.indent_mm:g} mm.")
    said = "The skin, cut open, coloured by its displacement, with pins and object."
    shown = [PagePicture(skin, f"{title}: deformed skin in 3D", said, "photo")]
    shown.append(frame("frame", result.raw.frame.image, "rendered camera frame", f"What the camera inside sees ({width} x {height} px)."))
    if look.frame.form == Form.PROCESSED:
        said = "The same frame in the form of this sensor's recordings: cropped, adaptively thresholded, resized."
        shown.append(frame("recorded", look.frame.image, "frame in the form of a recording", said))
    page.figures(*shown, layout="row")
    found = "Pins found (green), graph edges (blue) and Voronoi cells (white); yellow crosses are spots that are not pins."
    change = "Voronoi cell areas against no contact: cells grow where the dome flattens."
    surfaces = "Cell area interpolated over the image: no contact, contact, difference."
    pins = chart("graph", graph_figure, "pins and Voronoi graph", found)
    page.figures(pins, chart("areas", areas_figure, "Voronoi area change", change), layout="row")
    page.figures(chart("surfaces", lambda: charts.area_surface_figure(rest, graph), "interpolated area surfaces", surfaces))
    rows = [{"name": name, "value": value} for name, value in contact_figures(result)]
    page.table(rows, [Column("name", "figure"), Column("value", "value")])


def add_motions(page: Page, motions: Path) -> None:
    """Add the chart of `motion_figure`."""
    lead = "Pressing (Z) spreads the pins outwards. Dragging along x or y carries them with the object until they slip."
    page.section("Three motions, three signatures", lead)
    shown = "Displacement of the pins and change of the Voronoi areas for motions along Z, X and Y"
    said = f"Pin displacement (top) and Voronoi area change (bottom) for motions along Z, X and Y, on {CONTACTS[0][0]}."
    page.figures(PagePicture(motions, shown, said))


def add_tables(page: Page, tables: Mapping[str, Sequence[DepthRow]]) -> None:
    """Add the displacements by depth, by the sensor's name."""
    page.section(
        "Against real recordings: displacement by depth",
        "Mean displacement of all pins on a flat plate, in pixels of the uncropped camera frame. Measured: the Tac-VGNN release's "
        "recordings, pure presses in 1 mm bins. Simulated: true cap positions at the middle of each bin, with nominal stiffness; the "
        "hexagonal sensor's camera distance and pin spacing were chosen with these figures in view.",
        "The columns differ because they are not the same contacts. A bin of the recordings has presses tilted by up to 20 deg, at every "
        "depth of the bin, and its depths count from the arm's zero. The simulated contact is one straight press, at the nominal zero. "
        "'twin validate' simulates each recorded frame instead, with its own depth and tilt and the zero that was fitted to the arm. Then "
        "a pin is less than half a pixel from the recorded one on average (docs/results/pins.md).",
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
