"""Observations of an agent: pins, their graph, pictures, the estimator's pose, or the exact state."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from training.data.pins import PinTable, cap_light
from training.surrogate.reading import Backend, ContactReading
from twin.camera.capture import expose, record
from twin.camera.projection import project_in_form
from twin.errors import FrameError, OptionError
from twin.frames.forms import frame_size, gray_levels
from twin.geometry.pins import rest_pins
from twin.optics.preview import Preview
from twin.optics.render import Renderer
from twin.pins import Pipeline, make_graph, measure_reference, node_features, nominal_reference
from twin.types import BoolArray, FloatArray, Form, Frame, ImageArray, IntArray, PinState

if TYPE_CHECKING:
    from training.estimate.estimator import PoseEstimator

Kind = Literal["oracle", "pins", "graph", "image", "pose"]
"""Names of the observations."""
Pictures = Literal["none", "preview", "traced"]
"""Ways to make frames: none, rasterised, or path-traced."""
IMAGE_PX = 128
"""Side of the pictures that an agent gets, px, as in Tactile Gym."""
LARGEST = 10.0
"""Largest size of an observation. Larger values are clipped: no pin moves by ten spacings."""
POSE_SCALES = {"mm": 1.0, "deg": 10.0, "N": 1.0, "Nmm": 10.0, "mm2": 100.0, "": 1.0}
"""Divisors of estimates, by the labels' units."""


@dataclass(frozen=True)
class SensorView:
    """The view of an episode's sensor: the sampled specification, the form of its frames, and how they are made."""

    sensor: SensorSpec
    form: Form
    pictures: Pictures

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: what is cached is made again."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @cached_property
    def rest_px(self) -> FloatArray:
        """The pins at rest in px of the sensor's frames, (N, 2)."""
        return project_in_form(self.sensor, self.form, rest_pins(self.sensor.geometry).caps_mm)

    @cached_property
    def paint(self) -> Callable[[PinState, np.random.Generator], Frame]:
        """Function that makes a frame of a state."""
        sensor, recording = self.sensor, self.sensor.recording if self.form == Form.PROCESSED else None
        preview = Preview(sensor, window_px=recording.crop_px if recording else None)
        renderer = Renderer(sensor, quality="preview", window_px=preview.window_px) if self.pictures == "traced" else None
        frame_size(sensor, self.form)

        def paint(pins: PinState, rng: np.random.Generator) -> Frame:
            light = preview.render(pins) if renderer is None else renderer.render(pins, seed=int(rng.integers(2**31)))
            image = expose(light, sensor.capture, rng, origin_px=preview.window_px[:2])
            return Frame(record(image, recording, origin_px=preview.window_px[:2]) if recording else image, self.form)

        return paint

    @cached_property
    def at_rest(self) -> Frame:
        """The frame without contact."""
        return self.paint(rest_pins(self.sensor.geometry), np.random.default_rng(0))

    @cached_property
    def pipeline(self) -> Pipeline:
        """The pipeline for the sensor's frames, with the pins at rest from a frame without contact.

        Raises
        ------
        OptionError
            The pins can't be found in the frame at rest.
        """
        try:
            return Pipeline(self.sensor, self.form, measure_reference(self.sensor, self.form, self.at_rest))
        except FrameError as error:
            problem = f"the pins of the sampled {self.sensor.name} can't be found at rest ({error})"
            raise OptionError(f"{problem}; narrow the randomisation") from error


class Eye:
    """Makes observations of the states of B environments.

    Parameters
    ----------
    sensor : SensorSpec
    kind : {"oracle", "pins", "graph", "image", "pose"}
    pictures : {"none", "preview", "traced"}
        With pictures, the pins are found by the real pipeline in frames. Otherwise they are the projected caps. Kind "image" needs
        pictures.
    pin_noise_px : float
        Standard deviation of the noise of pins without pictures. Pins that are found in pictures have the noise of the pictures.

    Raises
    ------
    OptionError
        Kind "pose" needs an estimator: the sensor has none, or one that needs pictures.
    """

    def __init__(self, sensor: SensorSpec, count: int, kind: Kind, *, pictures: Pictures, pin_noise_px: float) -> None:
        self.sensor, self.kind, self.pictures, self._noise_px = sensor, kind, pictures, pin_noise_px
        self._estimator = _load_estimator(sensor) if kind == "pose" else None
        self._sees_light = self._estimator is not None and getattr(self._estimator.part, "sees_light", False)
        if self._sees_light and pictures == "none":
            raise OptionError(f"observation 'pose': the weights of {sensor.name} also need the light on caps; give pictures='preview'")
        self.form = self._estimator.form if self._estimator else Form.PROCESSED if sensor.recording else Form.RAW
        self.reference = nominal_reference(sensor, self.form)
        self._spacing = float(self.reference.spacing_px.mean())
        self._nominal = SensorView(sensor, self.form, pictures)
        self._views: list[SensorView] = [self._nominal] * count

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one observation of one environment, without the stack of earlier ones."""
        if self.kind == "image":
            return IMAGE_PX, IMAGE_PX
        if self._estimator is not None:
            return (len(self._estimator.names) + 1,)
        return self.sensor.pins.count, 2 if self.kind == "pins" else 5

    @property
    def limit(self) -> float:
        """Largest size of an observation. The outermost nodes of a graph are ten spacings from its centre."""
        return 2 * LARGEST if self.kind == "graph" else LARGEST

    def begin(self, row: int, sensor: SensorSpec) -> None:
        """Use the camera and light that were sampled for an environment's episode."""
        self._views[row] = self._nominal if sensor is self.sensor else SensorView(sensor, self.form, self.pictures)

    def view(self, row: int) -> SensorView:
        """The view of one environment's sensor as sampled for the episode."""
        return self._views[row]

    def frame(self, row: int, pins: PinState, rng: np.random.Generator) -> Frame:
        """The frame of one environment's sensor as sampled for the episode; a preview if no kind of pictures was chosen."""
        return self._views[row].paint(pins, rng)

    def look(self, backend: Backend, rows: IntArray, rngs: list[np.random.Generator]) -> tuple[FloatArray | ImageArray, BoolArray]:
        """Observations of some rows (R, ...), and whether each could be made (R,). Failed observations are zero."""
        if self.kind == "image" or self.pictures != "none":
            frames = [self.frame(row, backend.attitude(row), rngs[row]) for row in rows.tolist()]
            if self.kind == "image":
                return np.stack([_small(frame.image) for frame in frames]), np.ones(len(rows), bool)
            return self._of_frames(rows, frames)
        pins_px = self.pins_px(backend.felt, rows)
        if self._noise_px:
            pins_px = pins_px + self._noise_px * np.stack([rngs[row].standard_normal(pins_px.shape[1:]) for row in rows.tolist()])
        rest_px = np.stack([self._views[row].rest_px for row in rows.tolist()])
        return self._of_pins(self.reference.pins_px + (pins_px - rest_px)), np.ones(len(rows), bool)

    def pins_px(self, reading: ContactReading, rows: IntArray) -> FloatArray:
        """Projected caps (R, N, 2) of some rows, px of the sensor's frames."""
        caps = reading.caps_mm[rows]
        if all(self._views[row] is self._nominal for row in rows.tolist()):
            return project_in_form(self.sensor, self.form, caps)
        return np.stack([project_in_form(self._views[row].sensor, self.form, seen) for row, seen in zip(rows.tolist(), caps, strict=True)])

    def _of_pins(self, pins_px: FloatArray, light: FloatArray | None = None) -> FloatArray:
        """Observations (R, ...) from pins (R, N, 2), relative to the nominal layout, and from the light (R, N) on their caps."""
        if self.kind == "pins":
            return np.clip((pins_px - self.reference.pins_px) / self._spacing, -self.limit, self.limit).astype(np.float32)
        graphs = [make_graph("voronoi", pins, outmost=self.reference.outmost, net=self.reference.net) for pins in pins_px]
        if self._estimator is None:
            seen = np.stack([node_features(graph, self.reference) for graph in graphs])
        else:
            seen = self._estimates(self._estimator, pins_px, np.stack([graph.area_px2 for graph in graphs]), light)
        return np.clip(seen, -self.limit, self.limit).astype(np.float32)

    def _of_frames(self, rows: IntArray, frames: list[Frame]) -> tuple[FloatArray, BoolArray]:
        """Observations (R, ...) from frames, through the real pipeline of each row's sensor, and whether each could be made (R,)."""
        pipelines = [self._views[row].pipeline for row in rows.tolist()]
        seen = [pipeline(frame) for pipeline, frame in zip(pipelines, frames, strict=True)]
        valid = np.array([one.valid for one in seen])
        rest = [pipeline.reference for pipeline in pipelines]
        moved = [one.graph.nodes_px - at.pins_px if one.graph else np.zeros_like(at.pins_px) for one, at in zip(seen, rest, strict=True)]
        light = None
        if self._sees_light:
            light = np.stack([cap_light(frame, m + at.pins_px, at) for frame, m, at in zip(frames, moved, rest, strict=True)])
        return self._of_pins(self.reference.pins_px + np.stack(moved), light), valid

    def _estimates(self, estimator: "PoseEstimator", pins_px: FloatArray, area_px2: FloatArray, light: FloatArray | None) -> FloatArray:
        """Scaled estimates (R, K), and whether a move was executed, from pins (R, N, 2), their areas (R, N) and the light on their caps."""
        names, lost, valid = np.full(len(pins_px), ""), np.zeros(pins_px.shape[:2], bool), np.ones(len(pins_px), bool)
        columns = names, pins_px, area_px2, lost, valid
        table = PinTable(self.sensor, self.form, self.reference, *columns, measured=True, light=np.zeros(0) if light is None else light)
        told, scale = estimator.predict_table(table), np.array([POSE_SCALES[unit] for unit in estimator.units])
        return np.column_stack([told.mean / scale, np.nan_to_num(np.asarray(told.executed, float), nan=1.0)])


def _load_estimator(sensor: SensorSpec) -> "PoseEstimator":
    """The shipped estimator of a sensor."""
    from training.estimate.estimator import PoseEstimator  # loads torch, which other observations do not need
    from training.runs.run_files import shipped_names

    if sensor.name not in shipped_names():
        known = ", ".join(shipped_names())
        raise OptionError(f"observation 'pose' needs shipped weights; {sensor.name} has none (there are those of {known})")
    return PoseEstimator.load(sensor.name)


def _small(image: ImageArray) -> ImageArray:
    """The picture for the agent: gray, small and square."""
    gray = gray_levels(image)
    side = min(gray.shape)
    top, left = (gray.shape[0] - side) // 2, (gray.shape[1] - side) // 2
    seen = gray[top : top + side, left : left + side]
    return np.asarray(cv2.resize(seen, (IMAGE_PX, IMAGE_PX), interpolation=cv2.INTER_AREA), np.uint8)
