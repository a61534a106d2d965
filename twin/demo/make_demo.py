"""The demo: all stages in their order, and a page that shows them."""

import os
import platform
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from scenes import load_object, load_sensor
from twin.camera.projection import project
from twin.demo.page import ContactContent, contact_figures, contact_pictures, motion_figure, write_page
from twin.demo.stages import CONTACTS, MEASURED_DISPLACEMENT_PX, MOTIONS, ContactResult, DepthRow, depth_table, run_contact
from twin.frames.forms import from_raw
from twin.objects import build_field
from twin.progress import Progress, silent, stage
from twin.report.charts import write_chart
from twin.report.skin3d import draw_contact_skin
from twin.simulator import Simulator
from twin.store import writes
from twin.types import Form, ReadableResult


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
