"""The pins of every frame of a recording, found once by the pipeline and then kept on disk.

This module imports nothing of the simulation. What is kept on disk is valid for one state of the code that made it, so pins of real
recordings stay valid when only the simulation changes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.frames import Recording
from twin.pins import Pipeline, make_graph, make_reference
from twin.pins.batch import UNMEASURED, recording_reference
from twin.pins.reference import Reference
from twin.progress import Step
from twin.store import cached_arrays
from twin.types import Form

PIN_COLUMNS = ("image_name", "nodes_px", "area_px2", "lost", "valid")  # the fields of a PinTable that hold a row for each frame


@dataclass(frozen=True)
class PinTable:
    """The pipeline's view of M frames of one sensor with N pins.

    Attributes
    ----------
    sensor : SensorSpec
    form : Form
    reference : Reference
        No contact, N pins.
    image_name : (M,) str
    nodes_px : (M, N, 2) float
        Every pin of the valid frames; a lost pin's is its predicted place. NaN where a frame is not valid.
    area_px2 : (M, N) float
        Voronoi areas; NaN where a frame is not valid.
    lost : (M, N) bool
        Pins without a blob of their own.
    valid : (M,) bool
    measured : bool
        Whether the reference is that of these very frames' own camera, and not only the specification's.
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

    def __len__(self) -> int:
        return len(self.image_name)

    def rows(self, index: np.ndarray) -> "PinTable":
        """The same table with only some rows, or rows in another order."""
        return self.with_columns({key: getattr(self, key)[index] for key in PIN_COLUMNS})

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> "PinTable":
        """The same sensor, form and reference with other frames; ``columns`` holds an array for each of ``PIN_COLUMNS``."""
        return PinTable(self.sensor, self.form, self.reference, **columns, measured=self.measured)

    def seen_from(self, reference: Reference) -> "PinTable":
        """The same motion of the pins from another no-contact layout: displacements and the areas' growth are kept."""
        nodes_px = reference.pins_px + (self.nodes_px - self.reference.pins_px)
        area_px2 = reference.area_px2 * (self.area_px2 / self.reference.area_px2)
        return replace(self, reference=reference, nodes_px=nodes_px, area_px2=area_px2)


def pin_table(recording: Recording, spec: SensorSpec, *, problems: list[str], progress: Step | None = None) -> PinTable:
    """Run the pipeline over a recording, or take its result from the cache.

    What could not be read is appended to ``problems``.
    """

    def compute() -> dict[str, np.ndarray]:
        notes: list[str] = []
        reference, named = recording_reference(spec, recording, notes)
        pipeline = Pipeline(spec, recording.form, reference)
        n = spec.pins.count
        names, nodes, areas, lost, valid = [], [], [], [], []
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
            if progress:
                progress(frame.sequence + 1, len(recording))
        notes += [f"{bad['image_name']}: {bad['reason']}" for bad in recording.failed]
        arrays = {
            "nodes_px": np.reshape(nodes, (-1, n, 2)),
            "area_px2": np.reshape(areas, (-1, n)),
            "lost": np.reshape(lost, (-1, n)).astype(bool),
            "valid": np.array(valid, bool),
        }
        about = {"rest_px": reference.pins_px, "measured": np.array(named != UNMEASURED), "notes": np.array(notes, str)}
        return {"image_name": np.array(names, str)} | about | arrays

    found = cached_arrays("recorded-pins", _key(recording, spec), compute)
    problems += found.pop("notes").tolist()
    reference = make_reference(found.pop("rest_px"), spec.pins)
    return PinTable(spec, recording.form, reference, measured=bool(found.pop("measured")), **found)


def _key(recording: Recording, spec: SensorSpec) -> dict[str, object]:
    """All that the pins depend on beside the code: files and the specification."""
    root = recording.path if recording.path.is_dir() else recording.path.parent
    states = sorted((str(file.relative_to(root)), *_state(file)) for file in root.rglob("*") if file.is_file())
    return {
        "path": str(recording.path.resolve()),
        "names": recording.names,
        "files": json.dumps(states),
        "reference": b"" if recording.reference is None else recording.reference.image.tobytes(),
        "form": str(recording.form),
        "sensor": spec.model_dump(mode="json"),
    }


def _state(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_size, status.st_mtime_ns


def voronoi_areas(nodes_px: np.ndarray, reference: Reference, *, progress: Step | None = None) -> np.ndarray:
    """Voronoi areas (S, N), px^2, of S times N pins (S, N, 2) with this no-contact layout; computed once, then kept on disk."""

    def compute() -> dict[str, np.ndarray]:
        areas = np.empty(nodes_px.shape[:2])
        for k, pins_px in enumerate(nodes_px):
            areas[k] = make_graph("voronoi", pins_px, outmost=reference.outmost).area_px2
            if progress:
                progress(k + 1, len(nodes_px))
        return {"area_px2": areas}

    key = {"pins": nodes_px.tobytes(), "rest": reference.pins_px.tobytes()}
    return cached_arrays("simulated-areas", key, compute)["area_px2"]
