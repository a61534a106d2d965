"""Makes one contact of a data set: a worker process computes its pictures and its truth from its number."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from training.generation.config import DatasetError, Draw, GenerationConfig, draw_contact
from twin.camera.truth import cap_truth
from twin.errors import ContactError, MeshError
from twin.frames.forms import gray_levels
from twin.geometry.solid import Resolution
from twin.mechanics.skin_map import skin_map
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Shading
from twin.optics.variants.variant import one_thread
from twin.rig.contact import RigContact
from twin.rig.labels import ArmLabel
from twin.simulator import Simulator
from twin.types import ContactState

# Most draws for one contact before the data set is given up.
MOST_ATTEMPTS = 20
# Index of the frame without contact.
REST = -1


@dataclass(frozen=True)
class Outcome:
    """The result of one contact.

    Attributes
    ----------
    index : int
        Index of the contact; ``REST`` for the frame without contact.
    images : list of bytes
        PNG of each of the S states; empty if the configuration has no pictures.
    arrays : dict of str to (S, ...) array
        Truth and labels of each state.
    draw : dict of str to float
        The values sampled in addition to the label.
    failures : list of str
        Why earlier draws for this contact failed, in order.
    """

    index: int
    images: list
    arrays: dict
    draw: dict
    failures: list


def make_contact(text: str, index: int) -> Outcome:
    """Simulate contact ``index`` of the configuration given as JSON, on one thread.

    Raises
    ------
    DatasetError
        All draws failed.
    RenderError
        Nothing can be rendered here.
    """
    config = _config(text)
    if index == REST:
        nominal = _nominal(text)
        return Outcome(REST, [_png(config, nominal, nominal.rest, 0)], {}, {}, [])
    failures: list[str] = []
    for attempt in range(MOST_ATTEMPTS):
        try:
            draw = draw_contact(config, index, attempt)
            return _simulate(config, text, draw, index, failures)
        except (ContactError, MeshError) as error:
            failures.append(str(error))
    raise DatasetError(
        f"contact {index}: {MOST_ATTEMPTS} samples failed one after another, the last: {failures[-1]}; narrow the experiment's ranges"
    )


def _simulate(config: GenerationConfig, text: str, draw: Draw, index: int, failures: list) -> Outcome:
    simulator = _nominal(text) if not draw.values else _simulator(config, draw.sensor, _shading(config, text, draw.sensor))
    contact = RigContact(simulator.solver, config.experiment, config.object)
    path = contact.commanded_path(draw.label)
    found = list(contact.along(path, friction=draw.friction))
    labels = [path.label(fraction) for fraction, _ in found[:-1]] + [draw.label]
    kept = range(len(found)) if config.states == "all" else [len(found) - 1]
    images, rows = [], []
    for k in kept:
        fraction, state = found[k]
        if config.images != "none":
            images.append(_png(config, simulator, state, draw.image_seed + k))
        rows.append(_row(config, draw, simulator, state, labels[k]) | {"path_id": index, "fraction": fraction})
    arrays = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return Outcome(index, images, arrays, {"friction": draw.friction, **draw.values}, failures)


def _row(config: GenerationConfig, draw: Draw, simulator: Simulator, state: ContactState, label: ArmLabel) -> dict:
    """Truth of one state; the keys are the arrays of the data set's ``truth.zarr`` (see ``training.generation.store``)."""
    truth = cap_truth(draw.sensor, simulator.rest, state, config.form)
    grid = skin_map(draw.sensor.geometry, state)
    noise_px = config.randomisation.pin_noise_px if config.randomisation else 0.0
    return {
        "caps_mm": truth.caps_mm.astype(np.float32),
        "caps_px": truth.caps_px.astype(np.float32),
        "rest_px": truth.rest_px.astype(np.float32),
        "pins_px": (truth.caps_px + noise_px * draw.noise.normal(size=truth.caps_px.shape)).astype(np.float32),
        "visible": truth.visible,
        "force_n": state.force_n,
        "torque_nmm": state.torque_nmm,
        "area_mm2": state.area_mm2,
        "slipping_mm2": float(state.point_area_mm2[state.slipping].sum()),
        "skin_mm": state.nodes_mm[: simulator.solver.mesh.outer_count].astype(np.float32),
        "map_force_n": grid.force_n.astype(np.float32),
        "map_normal_n": grid.normal_n.astype(np.float32),
        "map_touched_mm2": grid.touched_mm2.astype(np.float32),
        "map_slipping_mm2": grid.slipping_mm2.astype(np.float32),
        "T_sensor_object": state.T_sensor_object,
        "pose": label.pose,
        "move": label.move,
        "executed": label.executed,
    }


def _png(config: GenerationConfig, simulator: Simulator, state: ContactState, seed: int) -> bytes:
    with nullcontext() if simulator.renderer.drawn else one_thread(simulator.renderer.choice):
        rendered = simulator.render(state, form=config.form, seed=seed)
    image = rendered.frame.image if config.images != "gray" else gray_levels(rendered.frame.image)
    return cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1].tobytes()


@cache
def _config(text: str) -> GenerationConfig:
    return GenerationConfig.model_validate_json(text)


@lru_cache(maxsize=1)
def _nominal(text: str) -> Simulator:
    config = _config(text)
    return _simulator(config, config.sensor)


def _simulator(config: GenerationConfig, sensor: SensorSpec, shading: Shading | None = None) -> Simulator:
    solver = SkinSolver(sensor, resolution=Resolution(config.across))
    return Simulator(sensor, quality=config.quality, solver=solver, shading=shading)


def _shading(config: GenerationConfig, text: str, sensor: SensorSpec) -> Shading | None:
    """The shading of the nominal sensor. It is used for the drawn sensor, too, for which nothing is path-traced."""
    if config.quality != "rasterised" or config.images == "none":
        return None
    shading = _nominal(text).renderer.preview.shading
    return shading if sensor.geometry == config.sensor.geometry else replace(shading, skin=np.ones((1, 1)))
