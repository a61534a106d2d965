"""The files of one rendered contact: frame, truth, skin, panel."""

from dataclasses import asdict
from pathlib import Path

from scenes.object import ObjectSpec
from twin.mechanics.path import ContactPose
from twin.optics.files import write_exr
from twin.preprocess.pipeline import Pipeline
from twin.recordings.images import write_image
from twin.report.panel import Look, contact_panel
from twin.report.skin3d import displaced_skin, draw_contact_skin
from twin.simulator import Shot, Simulator
from twin.stimulus import build_field
from twin.store import made_by, write_json, write_npz
from twin.types import ContactState, FloatArray


def write_contact(out: Path, simulator: Simulator, touched: ObjectSpec, pose: ContactPose, state: ContactState, shot: Shot) -> list[Path]:
    """Write everything about one contact into a folder.

    Returns
    -------
    list of Path
        What was written.
    """
    spec = simulator.spec
    write_image(out / "frame.png", shot.frame.image)
    write_exr(out / "frame.exr", shot.linear, simulator.renderer.choice)
    write_npz(out / "truth.npz", asdict(shot.truth) | contact_arrays(state), compressed=True)
    record = contact_record(simulator, touched, pose, state, shot)
    write_json(out / "truth.json", record | {"made_by": made_by(Simulator, inputs=[spec, touched, pose])})

    mesh = simulator.solver.mesh
    displaced_skin(mesh, state).save(out / "skin.vtp")
    draw_contact_skin(mesh, spec.pins, state, build_field(touched), out / "skin.png")
    look = look_at(simulator, shot)
    title = f"{spec.name} against {touched.name}, {pose.indent_mm:g} mm deep, {state.force_n[2]:.2f} N"
    contact_panel(out / "skin.png", look, title).savefig(out / "panel.png", dpi=110)
    names = ("frame.png", "frame.exr", "truth.npz", "truth.json", "skin.vtp", "skin.png", "panel.png")
    return [out / name for name in names]


def contact_arrays(state: ContactState) -> dict[str, FloatArray]:
    """The contact, place by place (see ``ContactState``)."""
    names = ("contact_mm", "point_area_mm2", "normal", "normal_n", "tangential_n", "slipping")
    return {f"contact_{name.removeprefix('contact_')}": getattr(state, name) for name in names}


def look_at(simulator: Simulator, shot: Shot) -> Look:
    """Run the pipeline on a shot and on the same sensor's no-contact frame."""
    form = shot.frame.form
    pipeline = Pipeline(simulator.spec, form)
    rest = pipeline(simulator.shoot_rest(form).frame)  # first: it loads the compiled code, so that the shot's times are a frame's
    return Look(shot.frame, pipeline(shot.frame), rest)


def contact_record(simulator: Simulator, touched: ObjectSpec, pose: ContactPose, state: ContactState, shot: Shot) -> dict[str, object]:
    """What ``truth.json`` holds: forces on the object in the sensor frame, pose, everything resolved."""
    return {
        "force_n": state.force_n.tolist(),
        "torque_nmm": state.torque_nmm.tolist(),
        "area_mm2": state.area_mm2,
        "pose": asdict(pose),
        "T_sensor_object": state.T_sensor_object.tolist(),
        "form": str(shot.frame.form),
        "elastic_nmm": state.elastic_nmm,
        "residual": state.residual,
        "seconds": {"render": shot.seconds},
        **simulator.describe(),
        "sensor": simulator.spec.model_dump(mode="json"),
        "object": touched.model_dump(mode="json"),
    }
