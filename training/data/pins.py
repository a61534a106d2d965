"""The pins of every frame of a recording. The pipeline finds them once; then they are stored on disk.

Stored results are valid only for the code that made them. This module imports nothing of the simulation, so that stored pins of real
recordings stay valid if only the simulation changes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.frames import Recording
from twin.frames.forms import gray_levels
from twin.pins import Pipeline, make_graph, make_reference
from twin.pins.batch import UNMEASURED, recording_reference
from twin.pins.labelling.reference import Reference
from twin.progress import Step, unheard
from twin.store import cached_arrays
from twin.types import Form, Frame

LIGHT_SIGMA = 0.12  # standard deviation of the Gaussian that averages a cap's light, in mean rest spacings: about a third of a cap
LEAST_LEVEL = 0.5  # gray levels, added before the logarithm is taken: half a step of the camera
# Fields of a PinTable that hold a row for each frame.
PIN_COLUMNS = ("image_name", "nodes_px", "area_px2", "lost", "valid", "light")


@dataclass(frozen=True)
class PinTable:
    """The pins that the pipeline found in M frames of one sensor with N pins.

    Attributes
    ----------
    sensor : SensorSpec
    form : Form
    reference : Reference
        The layout of the N pins without contact.
    image_name : (M,) str
    nodes_px : (M, N, 2) float
        Places of the pins; a lost pin has its predicted place. NaN for frames that are not valid.
    area_px2 : (M, N) float
        Voronoi areas; NaN for frames that are not valid.
    lost : (M, N) bool
        Pins for which no blob was found.
    valid : (M,) bool
    measured : bool
        Whether the reference was measured with the camera of these frames. Otherwise it is computed from the specification.
    light : (M, N) float, optional
        Logarithm of the gray level at each pin (``cap_light``); 0 if there are no pictures.
    """

    sensor: SensorSpec
    form: Form
    reference: Reference
    image_name: np.ndarray
    nodes_px: np.ndarray
    area_px2: np.ndarray
    lost: np.ndarray
    valid: np.ndarray
    measured: bool = False
    light: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.light.shape != self.lost.shape:
            object.__setattr__(self, "light", np.zeros(self.lost.shape))

    def __len__(self) -> int:
        return len(self.image_name)

    def rows(self, index: np.ndarray) -> "PinTable":
        """The table of the rows with these indices, in their order."""
        return self.with_columns({key: getattr(self, key)[index] for key in PIN_COLUMNS})

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> "PinTable":
        """A table of other frames with the same sensor, form and reference; ``columns`` holds an array for each of ``PIN_COLUMNS``."""
        return PinTable(self.sensor, self.form, self.reference, **columns, measured=self.measured)

    def relative_to(self, reference: Reference) -> "PinTable":
        """The table relative to another layout without contact: as its camera would see the displacements.

        The displacements are turned, scaled and stretched by the linear map of the two layouts. Ratios of areas do not change.
        """
        if np.array_equal(self.reference.pins_px, reference.pins_px):
            return replace(self, reference=reference)
        nodes_px = reference.pins_px + (self.nodes_px - self.reference.pins_px) @ self.reference.map_to(reference)
        area_px2 = reference.area_px2 * (self.area_px2 / self.reference.area_px2)
        return replace(self, reference=reference, nodes_px=nodes_px, area_px2=area_px2)


def pin_table(recording: Recording, spec: SensorSpec, *, problems: list[str], progress: Step = unheard) -> PinTable:
    """Run the pipeline over a recording, or take its result from the cache.

    Frames that can't be read are appended to ``problems``.
    """

    def compute() -> dict[str, np.ndarray]:
        notes: list[str] = []
        reference, named = recording_reference(spec, recording, notes)
        pipeline = Pipeline(spec, recording.form, reference)
        n = spec.pins.count
        names, nodes, areas, lost, valid, light = [], [], [], [], [], []
        for frame in recording:
            try:
                seen = pipeline(frame)
            except FrameError as error:
                notes.append(str(error))
                continue
            names.append(frame.name)
            graph = seen.graph if seen.valid else None
            valid.append(graph is not None)
            nodes.append(np.full((n, 2), np.nan) if graph is None else graph.nodes_px)
            areas.append(np.full(n, np.nan) if graph is None else graph.area_px2)
            lost.append(np.isnan(seen.pins_px[:, 0]))
            light.append(np.zeros(n) if graph is None else cap_light(frame, graph.nodes_px, reference))
            progress(frame.sequence + 1, len(recording))
        notes += [f"{bad['image_name']}: {bad['reason']}" for bad in recording.failed]
        arrays = {"nodes_px": np.reshape(nodes, (-1, n, 2)), "area_px2": np.reshape(areas, (-1, n)), "light": np.reshape(light, (-1, n))}
        arrays |= {"lost": np.reshape(lost, (-1, n)).astype(bool), "valid": np.array(valid, bool)}
        about = {"rest_px": reference.pins_px, "measured": np.array(named != UNMEASURED), "notes": np.array(notes, str)}
        return {"image_name": np.array(names, str)} | about | arrays

    found = cached_arrays("recorded-pins", recording_key(recording, spec), compute)
    problems += found.pop("notes").tolist()
    reference = make_reference(found.pop("rest_px"), spec.pins)
    return PinTable(spec, recording.form, reference, measured=bool(found.pop("measured")), **found)


def cap_light(frame: Frame, nodes_px: np.ndarray, reference: Reference) -> np.ndarray:
    """Logarithm (N,) of the gray level at the pins (N, 2) of a frame, averaged over the middle of a cap."""
    gray = gray_levels(frame.image)
    sigma_px = LIGHT_SIGMA * float(reference.spacing_px.mean())
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)
    at = nodes_px.astype(np.float32).reshape(-1, 1, 2)
    level = cv2.remap(smooth, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
    return np.log(level.astype(float) + LEAST_LEVEL)


def recording_key(recording: Recording, spec: SensorSpec) -> dict[str, object]:
    """Everything, besides the code, that affects a recording's pins, or its pictures as a network gets them: its files and, of the
    specification, the layout, the view, and how frames are made and read. A new fit of the rig changes none of these."""
    root = recording.path if recording.path.is_dir() else recording.path.parent
    states = sorted((str(file.relative_to(root)), *_state(file)) for file in root.rglob("*") if file.is_file())
    parts = [part.model_dump(mode="json") for part in (spec.geometry, spec.view, spec.pipeline, spec.recording) if part]
    reference = b"" if recording.reference is None else recording.reference.image.tobytes()
    files: dict[str, object] = {"path": str(recording.path.resolve()), "names": recording.names, "files": json.dumps(states)}
    return files | {"reference": reference, "form": str(recording.form), "sensor": [spec.name, *parts]}


def _state(file: Path) -> tuple[int, int, int]:
    """A value that changes with every change of the file. The inode's time is included, because copying tools set the modification time."""
    status = file.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def voronoi_areas(nodes_px: np.ndarray, reference: Reference, *, progress: Step = unheard) -> np.ndarray:
    """Voronoi areas (S, N) in px^2 of pins (S, N, 2) with this layout without contact. They are computed once, then stored on disk."""

    def compute() -> dict[str, np.ndarray]:
        areas = np.empty(nodes_px.shape[:2])
        for k, pins_px in enumerate(nodes_px):
            areas[k] = make_graph("voronoi", pins_px, outmost=reference.outmost, net=reference.net).area_px2
            progress(k + 1, len(nodes_px))
        return {"area_px2": areas}

    key = {"pins": nodes_px.tobytes(), "rest": reference.pins_px.tobytes()}
    return cached_arrays("simulated-areas", key, compute)["area_px2"]
