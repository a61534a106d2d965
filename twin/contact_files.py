"""The files of one rendered contact: frame, truth, skin, panel."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from scenes.object import ObjectSpec
from twin.mechanics.path import ContactPose
from twin.optics.files import write_exr
from twin.preprocess.pipeline import Pipeline
from twin.recordings.images import write_image
from twin.report.panel import Look, contact_panel
from twin.report.skin3d import displaced_skin, draw_contact_skin
from twin.simulator import Shot, Simulator
from twin.stimulus import build_stimulus
from twin.types import ContactState


def write_contact(out: Path, simulator: Simulator, stimulus: ObjectSpec, pose: ContactPose, state: ContactState, shot: Shot) -> list[Path]:
    """Write everything about one contact into a folder.

    Returns
    -------
    list of Path
        What was written.
    """
    spec = simulator.spec
    write_image(out / "frame.png", shot.frame.image)
    write_exr(out / "frame.exr", shot.linear, simulator.renderer.choice)
    np.savez_compressed(out / "truth.npz", **asdict(shot.truth), **contact_arrays(state))
    (out / "truth.json").write_text(json.dumps(contact_record(simulator, stimulus, pose, state, shot), indent=1) + "\n")

    mesh = simulator.solver.mesh
    displaced_skin(mesh, state).save(out / "skin.vtp")
    draw_contact_skin(mesh, spec.pins, state, build_stimulus(stimulus), out / "skin.png")
    look = look_at(simulator, shot)
    title = f"{spec.name} against {stimulus.name}, {pose.indent_mm:g} mm deep, {state.force_n[2]:.2f} N"
    contact_panel(out / "skin.png", look, title).savefig(out / "panel.png", dpi=110)
    names = ("frame.png", "frame.exr", "truth.npz", "truth.json", "skin.vtp", "skin.png", "panel.png")
    return [out / name for name in names]


def contact_arrays(state: ContactState) -> dict[str, np.ndarray]:
    """The contact, place by place (see ``ContactState``)."""
    names = ("contact_mm", "point_area_mm2", "normal", "normal_n", "tangential_n", "slipping")
    return {f"contact_{name.removeprefix('contact_')}": getattr(state, name) for name in names}


def look_at(simulator: Simulator, shot: Shot) -> Look:
    """Run the pipeline on a shot and on the same sensor's no-contact frame."""
    form = shot.frame.form
    pipeline = Pipeline(simulator.spec, form)
    rest = pipeline(simulator.shoot_rest(form).frame)  # first: it loads the compiled code, so that the shot's times are a frame's
    return Look(shot.frame, pipeline(shot.frame), rest)


def contact_record(simulator: Simulator, stimulus: ObjectSpec, pose: ContactPose, state: ContactState, shot: Shot) -> dict:
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
        "object": stimulus.model_dump(mode="json"),
    }
