"""Simulation and rendering of one contact, and a folder with its files and its exact ground truth.

What draws charts is imported after the contact is pressed and rendered, while another process draws the skin.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from scenes import SensorSpec
from scenes.object import ObjectSpec
from twin.frames.images import write_image
from twin.mechanics.path import ContactPose
from twin.objects import build_field
from twin.optics.render import write_exr
from twin.pins.graph import make_graph
from twin.pins.pipeline import Pipeline
from twin.progress import Progress, silent, stage
from twin.report.page import force_interval
from twin.report.skin3d import SkinPainter, displaced_skin, write_surface
from twin.simulator import RenderedFrame, Simulator
from twin.store import made_by, write_json, write_npz, writes
from twin.types import ContactState, FloatArray, Form, Quality, ReadableResult

if TYPE_CHECKING:
    from twin.report.charts import ObservedFrame

FILES = ("frame.png", "frame.exr", "truth.npz", "truth.json", "skin.vtp", "skin.png", "panel.png")
"""Files of a contact, in the order in which they are written."""


class Pose(Protocol):
    """A dataclass of numbers that describe how an object is pressed, with the indentation among them."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def indent_mm(self) -> float:
        """Indentation from the first touch on."""


@dataclass(frozen=True, repr=False)
class RenderedContact(ReadableResult):
    """A simulated and rendered contact, and its files."""

    state: ContactState
    rendered: RenderedFrame
    look: "ObservedFrame"
    written: list[Path]
    stiffness_factor: float

    def lines(self) -> list[str]:
        """The result as lines of text: force with the 90 % interval of its size, contact area, visible caps, and what is found."""
        force = self.state.force_n.round(2) + 0.0  # 0.0 turns negative zeros into positive ones
        low, high = force_interval(self.state.force_n.tolist(), self.stiffness_factor)
        visible = self.rendered.truth.visible
        seen = self.look.observation
        found = f"the pipeline finds {seen.found} of {len(seen.pins_px)} pins in the picture"
        useless = f"note: the pipeline can't use the picture: {seen.reason}; 'twin check' shows where the specification is wrong"
        return [
            f"force {force[0]:+.2f} {force[1]:+.2f} {force[2]:+.2f} N (size with 90 %: {low:.2f} to {high:.2f} N), "
            f"contact area {self.state.area_mm2:.1f} mm2, {int(visible.sum())} of {len(visible)} caps visible",
            found if seen.valid else useless,
        ]


@writes(*FILES)
def render_contact(
    sensor: SensorSpec,
    obj: ObjectSpec,
    pose: ContactPose,
    out: Path,
    *,
    form: Form = Form.RAW,
    quality: Quality = "standard",
    seed: int = 0,
    progress: Progress = silent,
) -> RenderedContact:
    """Simulate the contact of an object and a sensor, render the camera's frame, and write both with their ground truth.

    Parameters
    ----------
    out : Path
        Output folder; it is created if missing.
    form : Form
        Form of the frame: the camera's own, or that of the sensor's recordings.
    quality : {"rasterised", "preview", "standard", "high"}
        Samples per pixel.
    seed : int
        Seed of the renderer and of the camera's noise.

    Raises
    ------
    FrameError
        If the sensor has no form of recordings.
    ContactError
        If the pose is out of reach or without contact, or if the solver does not converge.
    RenderError
        If the renderer does not work on this machine.
    """
    simulator = Simulator(sensor, quality=quality)
    simulator.check_form(form)
    with SkinPainter() as painter:
        with stage(progress, f"press {obj.name}") as step:
            state = simulator.press(obj, pose, progress=step)
        painter.draw_contact(simulator.solver.mesh, sensor.pins, state, build_field(obj))
        with stage(progress, "render"):
            rendered = simulator.render(state, form=form, seed=seed)
        with stage(progress, "pictures"):
            written, look = write_contact(out, simulator, obj, pose, state, rendered, painter)
    return RenderedContact(state, rendered, look, written, sensor.skin.stiffness_factor)


def write_contact(
    out: Path, simulator: Simulator, obj: ObjectSpec, pose: Pose, state: ContactState, rendered: RenderedFrame, painter: SkinPainter
) -> tuple[list[Path], "ObservedFrame"]:
    """Write all files of one contact into a folder. Returns the files, and what the pipeline sees in the picture.

    ``painter`` has begun to draw the contact.
    """
    from twin.report.charts import contact_panel, save_figure

    spec = simulator.spec
    write_image(out / "frame.png", rendered.frame.image)
    write_exr(out / "frame.exr", rendered.linear, simulator.renderer.choice)
    write_npz(out / "truth.npz", asdict(rendered.truth) | contact_arrays(state), compressed=True)
    record = contact_record(simulator, obj, pose, state, rendered)
    write_json(out / "truth.json", record | {"made_by": made_by(Simulator, inputs=[spec, obj, pose])})

    write_surface(out / "skin.vtp", displaced_skin(simulator.solver.mesh, state))
    look = look_at(simulator, rendered)
    painter.save(out / "skin.png")
    title = f"{spec.name} against {obj.name}, {pose.indent_mm:g} mm deep, {state.force_n[2]:.2f} N"
    save_figure(out / "panel.png", contact_panel(out / "skin.png", look, title), dpi=110)
    return [out / name for name in FILES], look


def contact_arrays(state: ContactState) -> dict[str, FloatArray]:
    """Arrays of a state with one row per contact point, by their names in ``truth.npz`` (see ``ContactState``)."""
    names = ("contact_mm", "point_area_mm2", "normal", "normal_n", "tangential_n", "slipping")
    return {f"contact_{name.removeprefix('contact_')}": getattr(state, name) for name in names}


def look_at(simulator: Simulator, rendered: RenderedFrame) -> "ObservedFrame":
    """Run the pipeline on a rendered frame. The graph without contact is that of the pins' true places at rest."""
    from twin.report.charts import ObservedFrame

    pipeline = Pipeline(simulator.spec, rendered.frame.form)
    pipeline(rendered.frame)  # first: it loads compiled code, which must not count in its times
    rest = make_graph(pipeline.graph, rendered.truth.rest_px, outmost=pipeline.reference.outmost)
    return ObservedFrame(rendered.frame, pipeline(rendered.frame), rest)


def contact_record(simulator: Simulator, obj: ObjectSpec, pose: Pose, state: ContactState, rendered: RenderedFrame) -> dict[str, object]:
    """The content of ``truth.json``: forces on the object in the sensor frame, the pose, and all resolved specifications."""
    return {
        "force_n": state.force_n.tolist(),
        "force_size_90_n": force_interval(state.force_n.tolist(), simulator.spec.skin.stiffness_factor),
        "torque_nmm": state.torque_nmm.tolist(),
        "area_mm2": state.area_mm2,
        "pose": asdict(pose),
        "T_sensor_object": state.T_sensor_object.tolist(),
        "form": str(rendered.frame.form),
        "elastic_nmm": state.elastic_nmm,
        "residual": state.residual,
        "seconds": {"render": rendered.seconds},
        **simulator.describe(),
        "sensor": simulator.spec.model_dump(mode="json"),
        "object": obj.model_dump(mode="json"),
    }
