"""The pipeline applied to a whole recording. The results are files in a folder: pins, a summary, and pictures of the found pins."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError, format_count
from twin.frames import Recording, open_recording
from twin.frames.forms import blob_spec, gray_levels
from twin.frames.images import write_image
from twin.frames.recording import BadFrame
from twin.pins.labelling.reference import Reference, nominal_reference, view_of
from twin.pins.pipeline import Pipeline, measure_reference
from twin.progress import Step, unheard
from twin.store import made_by, write_json, write_npz, writes
from twin.types import Form, Frame, Observation, ReadableResult

EDGE_RGB = (90, 110, 160)
"""Colour of a graph's edges in a picture."""
FOUND_RGB = (60, 220, 60)
"""Colour of found pins."""
LOST_RGB = (255, 60, 60)
"""Colour of the predicted places of lost pins."""
EXTRA_RGB = (255, 210, 0)
"""Colour of rejected blobs."""
GRAY = (28, 32, 38)
"""Background of a cell map."""
FULL_CHANGE = 0.3
"""Relative change of a cell's area at both ends of the colour scale."""
AREA_STOPS = ((5, 48, 97), (67, 147, 195), (247, 247, 247), (214, 96, 77), (103, 0, 31))
"""RGB colours of areas from smaller to larger, evenly spaced: those of matplotlib's RdBu_r, which the charts of reports have."""
UNMEASURED = "specification"
"""Text instead of the name of a no-contact frame if the reference is the specification's layout."""
WITHOUT_NO_CONTACT = {
    "": (UNMEASURED, ": the pins at rest are those of the specification, which makes errors of a pose up to four times larger;"),
    "measured": (
        "measured before",
        ": the pins at rest are those that were measured before on this unit; if the camera or the tip was touched since,",
    ),
    "contacts": (
        "made from contacts",
        ", and none when the specification was made: the pins' rest places were made from contacts; expect errors of a tenth of a spacing "
        "or so;",
    ),
}
"""Text instead of a no-contact frame's name, and the middle of the note, by the origin of the places at rest ("" for none)."""
FARTHEST_PX = 1e4
"""Largest distance of a drawn point from the frame's origin, px. OpenCV's integers would overflow beyond it."""
HALF, BRIGHTEST, DARKEST = 127.0, 98.0, 12.0
"""Brightness of a picture: the gray level ``HALF`` that is given to the frame's level at the percentile ``BRIGHTEST``, between the pins if
some are found. That level counts as ``DARKEST`` at least. The frame is shown at half brightness, so that the drawing on it is visible."""


@dataclass(frozen=True, repr=False)
class Preprocessed(ReadableResult):
    """The pins of all frames of a recording.

    Attributes
    ----------
    summary : dict
        Content of ``summary.json``. ``invalid`` lists the frames whose pins were not found, ``failed`` those that could not be read.
    arrays : dict of str to array
        Content of ``pins.npz``, one row for each readable frame in the recording's order: ``image_name``, ``pins_px`` and ``predicted_px``
        (M, N, 2), ``area_px2`` (M, N), ``found`` and ``valid`` (M,).
    written : list of Path
    """

    summary: dict[str, Any]
    arrays: dict[str, np.ndarray]
    written: list[Path]

    def lines(self) -> Iterator[str]:
        """The summary in words."""
        summary, pins = self.summary, self.arrays["pins_px"].shape[1]
        in_view = summary["in_view"]
        which = (
            f"all {pins} pins" if in_view == pins else f"all pins in view ({in_view:g} of {pins}; the picture's border cuts the others off)"
        )
        yield (
            f"{format_count(summary['frames'], 'frames')}, {which} found in {100 * summary['exact_fraction']:.2f} %, "
            f"{summary['ms']['total']['p50']:.2f} ms per frame (median)"
        )
        yield from (f"not valid {invalid['image_name']}: {invalid['reason']}" for invalid in summary["invalid"])
        yield from (f"note: {problem}" for problem in summary["problems"])
        yield from (f"skipped {failed['image_name']}: {failed['reason']}" for failed in summary["failed"])

    def to_table(self) -> dict[str, np.ndarray]:
        """The arrays with one number a frame, by column: for ``pandas.DataFrame``, say."""
        return {name: values for name, values in self.arrays.items() if values.ndim == 1}


@writes("pins.npz", "summary.json", "overlay", to="out_dir")
def preprocess_recording(
    path: str | Path, spec: SensorSpec, out_dir: str | Path, form: Form | None = None, overlay: bool = False, progress: Step = unheard
) -> Preprocessed:
    """Observe every frame of a recording and write ``pins.npz``, ``summary.json`` and, with ``overlay``, the pictures ``overlay/``.

    A frame is valid if its pins were found. Irregularities are listed in the summary.

    Parameters
    ----------
    path : path
        Anything ``open_recording`` takes.
    form : Form, optional
        Recognised by size and content if not given.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    FrameError
        The frame without contact shows a contact, no frame was readable, or none was valid. In the last case the files are written
        nevertheless.
    StoreError
        The folder can't be written to, another run is at work in it, or it holds files of these names that this program did not write.
    """
    recording = open_recording(path, spec, form)
    out_dir = Path(out_dir)
    pictures_dir = out_dir / "overlay" if overlay else None
    if pictures_dir is not None:
        pictures_dir.mkdir(exist_ok=True)
    notes: list[str] = []
    reference, reference_name = recording_reference(spec, recording, notes)
    pipeline = Pipeline(spec, recording.form, reference)
    names, observations, unfit = _observe_frames(recording, pipeline, pictures_dir, progress)
    arrays = _arrays(names, observations, spec.pins.count)
    all_found = np.array([o.complete for o in observations], bool)
    summary = {
        "sensor": spec.name,
        "frames": len(observations),
        "exact_fraction": float(all_found.sum() / max(len(names), 1)),
        "in_view": float(np.median([o.expected for o in observations])) if observations else 0.0,
        "valid_fraction": float(arrays["valid"].sum() / max(len(names), 1)),
        "ms": _timing(observations),
        "parameters": {
            "form": str(recording.form),
            "size_px": list(recording.size_px),
            "reference": reference_name,
            "graph": pipeline.graph,
            "detection": blob_spec(spec.pipeline, recording.form).model_dump(mode="json"),
        },
        "invalid": [{"image_name": name, "reason": o.reason} for name, o in zip(names, observations, strict=True) if not o.valid],
        "failed": recording.failed + unfit,
        "problems": recording.problems + notes,
        "made_by": made_by(preprocess_recording, inputs=[spec, recording.path.resolve(), recording.names]),
    }
    write_npz(out_dir / "pins.npz", arrays, compressed=True)
    write_json(out_dir / "summary.json", summary)
    if not arrays["valid"].any():
        raise FrameError(_describe_no_result(path, summary, out_dir / "summary.json"))
    return Preprocessed(summary, arrays, [out_dir / name for name in ("pins.npz", "summary.json", "overlay")[: 3 if overlay else 2]])


def _observe_frames(
    recording: Recording, pipeline: Pipeline, pictures_dir: Path | None, progress: Step
) -> tuple[list[str], list[Observation], list[BadFrame]]:
    """Names and observations of a recording's frames, and the frames that do not suit the pipeline. Pictures go to the given folder."""
    names: list[str] = []
    observations: list[Observation] = []
    unfit: list[BadFrame] = []
    pictures: set[str] = set()
    for frame in recording:
        try:
            if not observations:
                pipeline(frame)  # loads or compiles code, which must not count in the first frame's time
            observation = pipeline(frame)
        except FrameError as error:
            unfit.append({"image_name": frame.name, "reason": str(error).removeprefix(f"{frame.name}: ")})
            continue
        names.append(frame.name)
        observations.append(observation)
        if pictures_dir is not None:
            write_image(pictures_dir / overlay_name(frame.name, pictures), draw_overlay(frame, observation))
        progress(frame.sequence + 1, len(recording))
    return names, observations, unfit


def recording_reference(spec: SensorSpec, recording: Recording, problems: list[str]) -> tuple[Reference, str]:
    """The layout in the recording's no-contact frame and this frame's name; without such a frame the specification's layout.

    Notes about the reference are added to ``problems``.

    Raises
    ------
    FrameError
        The no-contact frame shows a contact, or not this sensor.
    """
    if recording.reference is not None:
        found = measure_reference(spec, recording.form, recording.reference)
        if displaced := view_of(found.pins_px, nominal_reference(spec, recording.form), spec.pins).displacements():
            problems.append(
                f"{recording.reference.name}: the camera's picture is {' and '.join(displaced)} against {spec.name}: the specification's "
                "camera and light, and weights for it, do not hold for these frames; 'twin check' says more"
            )
        return found, recording.reference.name
    blob = blob_spec(spec.pipeline, recording.form)
    name, why = WITHOUT_NO_CONTACT[blob.rest_origin if blob.rest_px else ""]
    record = "record one frame without contact (init_0.png beside the frames, or `no_contact` FRAME)"
    problems.append(f"no frame without contact was used{why} {record}")
    return nominal_reference(spec, recording.form), name


def draw_overlay(frame: Frame, observation: Observation, *, scale: int = 2, numbers: bool = False) -> np.ndarray:
    """Picture (H, W, 3) uint8 RGB: frame, graph, found pins (green), predicted places of lost pins (red), rejected blobs (yellow).

    With ``numbers`` each pin has its number beside it.
    """
    image = cv2.resize(frame.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    gray, found_px = gray_levels(frame.image), observation.pins_px[np.isfinite(observation.pins_px[:, 0])]
    if len(found_px):  # a bright housing around the pins must not make them dark
        (left, top), (right, bottom) = np.maximum(found_px.min(axis=0), 0).astype(int), np.ceil(found_px.max(axis=0)).astype(int)
        gray = gray[top : bottom + 1, left : right + 1]
    light = HALF / max(float(np.percentile(gray, BRIGHTEST)), DARKEST)  # a dark frame is shown lighter
    canvas = np.minimum(image.reshape(*image.shape[:2], -1) * light, HALF).astype(np.uint8)
    canvas = np.repeat(canvas, 3, axis=2) if canvas.shape[2] == 1 else canvas

    def place(px: np.ndarray) -> list[list[int]]:
        px = px[np.isfinite(px).all(axis=1)]
        return np.round((np.clip(px, -FARTHEST_PX, FARTHEST_PX) + 0.5) * scale - 0.5).astype(int).tolist()

    if observation.graph is not None:
        nodes = place(observation.graph.nodes_px)
        for i, j in observation.graph.edges:
            if i < j:
                cv2.line(canvas, nodes[i], nodes[j], EDGE_RGB, 1, cv2.LINE_AA)
    for px in place(observation.pins_px):
        cv2.circle(canvas, px, max(2, scale), FOUND_RGB, -1, cv2.LINE_AA)
    both_px = np.where(np.isfinite(observation.pins_px), observation.pins_px, observation.predicted_px)
    for pin in np.flatnonzero(np.isfinite(both_px).all(axis=1)) if numbers else ():
        ((x, y),) = place(both_px[[pin]])
        cv2.putText(canvas, str(pin), (x + 5, y - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1, cv2.LINE_AA)
    for px in place(observation.predicted_px):
        cv2.circle(canvas, px, 5, LOST_RGB, 1, cv2.LINE_AA)
    for px in place(observation.extra_px):
        cv2.circle(canvas, px, 6, EXTRA_RGB, 1, cv2.LINE_AA)
    name = frame.name.encode("ascii", "replace").decode()  # OpenCV's font has no other letters, and some of them crash the process
    outside = len(observation.pins_px) - observation.expected
    pins = f"{observation.found}/{observation.expected}" + (f" in view, {outside} outside" if outside else "")
    text = f"{name}  {pins}  {observation.reason}"
    cv2.putText(canvas, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def voronoi_map(shape: tuple[int, int], seen: Observation, rest_area_px2: np.ndarray | None) -> np.ndarray:
    """Cells (H, W, 3) coloured by their relative change of area: blue smaller, red larger than without contact."""
    canvas = np.full((*shape, 3), GRAY, np.uint8)
    if seen.graph is None or rest_area_px2 is None or not seen.graph.cells:
        return canvas
    change = np.clip((seen.graph.area_px2 / rest_area_px2 - 1) / FULL_CHANGE, -1, 1)
    for cell, color in zip(seen.graph.cells, area_colours(np.nan_to_num(change)), strict=True):
        if len(cell) > 2:
            corners = np.round(np.asarray(cell)).astype(np.int32)
            cv2.fillPoly(canvas, [corners], color.tolist(), cv2.LINE_AA)
            cv2.polylines(canvas, [corners], True, GRAY, 1, cv2.LINE_AA)
    return canvas


def area_colours(change: np.ndarray) -> np.ndarray:
    """RGB colours (n, 3) of changes of area (n,) from -1 to 1, in units of ``FULL_CHANGE``."""
    stops = np.array(AREA_STOPS, float)
    return np.stack([np.interp(change, np.linspace(-1, 1, len(stops)), channel) for channel in stops.T], axis=1)


def overlay_name(frame_name: str, taken: set[str]) -> str:
    """File name for a frame's picture that is not in ``taken`` (lower case) yet. The name is added to ``taken``."""
    stem = Path(frame_name).stem
    tries = chain((f"{stem}.png", f"{frame_name}.png"), (f"{stem}_{k}.png" for k in count(2)))
    name = next(name for name in tries if name.casefold() not in taken)
    taken.add(name.casefold())
    return name


def _timing(observations: list[Observation]) -> dict[str, dict[str, float]]:
    """Median, 95th and 99th percentile of the milliseconds of each stage."""
    stages = {stage: [o.ms[stage] for o in observations] for stage in (observations[0].ms if observations else ())}
    return {s: dict(zip(("p50", "p95", "p99"), np.percentile(ms, (50, 95, 99)).round(4).tolist(), strict=True)) for s, ms in stages.items()}


def _arrays(names: list[str], observations: list[Observation], n: int) -> dict[str, np.ndarray]:
    """The arrays of ``pins.npz`` for M frames with ``n`` pins."""
    none = np.full(n, np.nan)
    areas = [none if o.graph is None else o.graph.area_px2 for o in observations]
    return {
        "image_name": np.array(names, str),
        "pins_px": np.array([o.pins_px for o in observations], float).reshape(-1, n, 2),
        "predicted_px": np.array([o.predicted_px for o in observations], float).reshape(-1, n, 2),
        "area_px2": np.array(areas, float).reshape(-1, n),
        "found": np.array([o.found for o in observations], int),
        "valid": np.array([o.valid for o in observations], bool),
    }


def _describe_no_result(path: str | Path, summary: dict, summary_path: Path) -> str:
    """The message for a recording without a valid frame."""
    bad = summary["invalid"] + summary["failed"]
    return (
        f"{path}: the pins were found in none of {format_count(len(bad), 'frames')}; the first, {bad[0]['image_name']}: {bad[0]['reason']}"
        f"; check `sensor`, `form` and the [pipeline] section of the specification (details in {summary_path})"
    )
