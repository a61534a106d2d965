"""Makes one contact of a data set: a worker process computes its pictures and its truth from its number."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from training.generation.config import DatasetError, Draw, GenerationConfig, draw_contact
from twin.camera.projection import cap_truth
from twin.errors import ContactError, MeshError
from twin.frames.forms import gray_levels
from twin.geometry.solid import Resolution
from twin.mechanics.skin_map import skin_map
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Shading
from twin.optics.variant import one_thread
from twin.rig.contact import RigContact
from twin.rig.labels import ArmLabel
from twin.simulator import Simulator
from twin.types import ContactState

# Most draws for one contact before the data set is given up.
MOST_ATTEMPTS = 20
# Index of the frame without contact.
REST = -1
UNITS = {  # unit and meaning of each array of a contact, in the order in which they are kept
    "caps_mm": "mm, sensor frame",
    "caps_px": "px of the frame: exact projection of each cap's centre",
    "rest_px": "px of the frame: the same sensor without contact",
    "pins_px": "px of the frame: caps_px with the noise of a measurement",
    "visible": "whether the cap is inside the frame and no other pin hides it",
    "force_n": "N, of the skin on the object, sensor frame",
    "torque_nmm": "N mm about the sensor's origin",
    "area_mm2": "mm2 of skin in contact: nearer to the object than 0.05 mm",
    "slipping_mm2": "mm2 of skin that is pressed and slides",
    "skin_mm": "mm, sensor frame: the outer skin's nodes (the first ones of SensorMesh)",
    "map_force_n": "N, of the skin on the object at each node of the sensor's skin grid (twin.mechanics.skin_map), sensor frame",
    "map_normal_n": "N, magnitude of the part of it that presses",
    "map_touched_mm2": "mm2 of skin that is pressed, at each of these nodes",
    "map_slipping_mm2": "mm2 of it that slides",
    "T_sensor_object": "the object's pose, mm",
    "pose": "pose_1..6 as in targets.csv: mm, deg",
    "move": "move_1..6 as in targets.csv: mm, deg",
    "executed": "whether the move had been made when the frame was taken",
    "path_id": "number of the contact that the state belongs to: split by it, never by row",
    "fraction": "share of the contact's path that is done",
}


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
    arrays = {key: np.array([row[key] for row in rows]) for key in UNITS}
    return Outcome(index, images, arrays, {"friction": draw.friction, **draw.values}, failures)


def _row(config: GenerationConfig, draw: Draw, simulator: Simulator, state: ContactState, label: ArmLabel) -> dict:
    """Truth of one state, by the keys of ``UNITS``."""
    truth = cap_truth(draw.sensor, simulator.rest, state, config.form)
    grid = skin_map(draw.sensor.geometry, state)
    noise_px = config.randomisation.pin_noise_px if config.randomisation else 0.0
    single = {"caps_mm": truth.caps_mm, "caps_px": truth.caps_px, "rest_px": truth.rest_px}
    single |= {"pins_px": truth.caps_px + noise_px * draw.noise.normal(size=truth.caps_px.shape)}
    single |= {"skin_mm": state.nodes_mm[: simulator.solver.mesh.outer_count]}
    single |= {f"map_{key}": getattr(grid, key) for key in ("force_n", "normal_n", "touched_mm2", "slipping_mm2")}
    double = {key: getattr(state, key) for key in ("force_n", "torque_nmm", "area_mm2", "T_sensor_object")}
    double |= {"slipping_mm2": float(state.point_area_mm2[state.slipping].sum()), "visible": truth.visible}
    double |= {"pose": label.pose, "move": label.move, "executed": label.executed}
    return double | {key: value.astype(np.float32) for key, value in single.items()}


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
