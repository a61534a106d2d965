"""The demo: contacts through the whole chain, three motions and the depth table, in their order, and a page that shows them."""

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np

from scenes import load_object, load_sensor
from twin.camera.projection import project
from twin.demo.page import ContactContent, contact_figures, contact_pictures, motion_figure, write_page
from twin.frames.forms import form_named, from_raw
from twin.mechanics.path import ContactPose
from twin.objects import build_field
from twin.one_contact import look_at
from twin.pins.graph import make_graph
from twin.pins.labelling.reference import nominal_reference
from twin.progress import Progress, Step, silent, stage, unheard
from twin.report.charts import write_chart
from twin.report.plots import ObservedFrame
from twin.report.skin3d import draw_contact_skin
from twin.simulator import RenderedFrame, Simulator
from twin.store import writes
from twin.types import ContactState, Form, ReadableResult

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


@dataclass(frozen=True)
class ContactResult:
    """One contact through the whole chain."""

    sensor: str
    object_name: str
    pose: ContactPose
    state: ContactState
    raw: RenderedFrame
    look: ObservedFrame
    seconds: dict[str, float]
    stiffness_factor: float


def run_contact(simulator: Simulator, object_name: str, pose: ContactPose, form: Form, *, progress: Step = unheard) -> ContactResult:
    """Press, render, capture, detect, and build the graph, for one contact."""
    form, seconds = form_named(form), {}

    def clock(stage: str, work: Callable[[], Result]) -> Result:
        start = perf_counter()
        result = work()
        seconds[stage] = perf_counter() - start
        return result

    state = clock("press", lambda: simulator.press(load_object(object_name), pose, progress=progress))
    raw = clock("render", lambda: simulator.render(state))
    rendered = raw if form == Form.RAW else clock("capture", lambda: simulator.as_processed(raw, state))
    look = look_at(simulator, rendered)
    seconds["pins and graph"] = look.observation.ms["total"] / 1e3
    return ContactResult(simulator.spec.name, object_name, pose, state, raw, look, seconds, simulator.spec.skin.stiffness_factor)


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
    for number, (indent_mm, measured_px) in enumerate(zip(TABLE_INDENTS_MM, MEASURED_DISPLACEMENT_PX[sensor], strict=True)):
        state = simulator.press(load_object("plane"), ContactPose(indent_mm=indent_mm))
        caps_px = project(spec.view, state.caps_mm)
        areas = make_graph("voronoi", caps_px, outmost=outmost).area_px2
        change = 100 * float(np.mean(areas[middle] / rest_area_px2[middle]) - 1)
        moved = float(np.hypot(*(caps_px - rest_px).T).mean())
        rows.append(DepthRow(indent_mm, moved, measured_px, change, float(state.force_n[2])))
        progress((number + 1) / len(TABLE_INDENTS_MM))
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
    simulators: dict[str, Simulator] = {}
    contacts: list[ContactContent] = []
    seconds: dict[str, float] = {}
    notes: set[str] = set()
    for sensor, object_name, pose, form in CONTACTS:
        start = perf_counter()
        with bar(f"{sensor}: press the {object_name}, render, detect") as step:
            simulator = simulators[sensor] = Simulator(load_sensor(sensor))
            result = run_contact(simulator, object_name, pose, form, progress=step)
        seconds[f"{sensor} against {object_name}"] = perf_counter() - start
        with bar(f"{sensor}: pictures"):
            skin = pictures / f"{sensor}-{object_name}-skin.png"
            notes.add(
                draw_contact_skin(simulator.solver.mesh, simulator.spec.pins, result.state, build_field(load_object(object_name)), skin)
            )
            contacts.append(_contact_content(simulator, result, skin, pictures))

    motion_sensor = CONTACTS[0][0]
    start = perf_counter()
    looks = []
    with bar(f"{motion_sensor}: motions along Z, X and Y") as step:
        for number, (title, pose) in enumerate(MOTIONS):
            looks.append((title, run_contact(simulators[motion_sensor], "plane", pose, Form.RAW).look))
            step((number + 1) / len(MOTIONS))
        motions = write_chart(pictures / "motions.png", lambda: motion_figure(looks))
    seconds["motions"] = perf_counter() - start

    tables = {}
    start = perf_counter()
    for sensor in MEASURED_DISPLACEMENT_PX:
        with bar(f"{sensor}: displacement by depth") as step:
            tables[sensor] = depth_table(sensor, progress=step)
    seconds["displacement tables"] = perf_counter() - start

    renderer = simulators[motion_sensor].describe()["renderer"]
    machine = f"Rendered with Mitsuba variant {renderer['variant']} on {os.cpu_count()} cores ({platform.machine()}). " + " ".join(
        sorted(notes)
    )
    page = write_page(
        out / "index.html",
        machine=machine,
        contacts=contacts,
        motions=motions,
        motion_sensor=motion_sensor,
        tables=tables,
        seconds=seconds,
    )
    return Demo(tables, [page, *sorted(pictures.iterdir())])


def _contact_content(simulator: Simulator, result: ContactResult, skin: Path, pictures: Path) -> ContactContent:
    spec = simulator.spec
    written = contact_pictures(pictures, result)
    touched = result.state.contact_mm
    contact_mm = touched.mean(axis=0) if len(touched) else np.array([0, 0, spec.skin.apex_mm])
    contact_px = from_raw(spec.recording, result.look.frame.form, project(spec.view, contact_mm[None]))[0]
    height, width = result.raw.frame.image.shape[:2]
    return ContactContent(
        title=f"{spec.name} against {result.object_name}",
        description=f"{spec.description}. {load_object(result.object_name).description}, pressed in by {result.pose.indent_mm:g} mm.",
        pictures=written | {"skin": skin},
        raw_size=f"{width} x {height} px",
        figures=contact_figures(result, contact_px),
    )
