"""The pipeline over a whole recording, written to a folder."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.preprocess.overlay import draw_overlay, overlay_name
from twin.preprocess.pipeline import Pipeline, measure_reference
from twin.preprocess.reference import Reference, nominal_reference
from twin.recordings import Recording, open_recording
from twin.recordings.forms import blob_spec
from twin.recordings.recording import BadFrame
from twin.store import made_by, unwritten, write_bytes, write_json, write_npz
from twin.types import Form, Observation

UNMEASURED = "specification"  # in place of a no-contact frame's name


def recording_reference(spec: SensorSpec, recording: Recording, problems: list[str]) -> tuple[Reference, str]:
    """The recording's own no-contact layout and its frame's name; without a usable no-contact frame the specification's layout.

    The reason why a no-contact frame cannot be used is added to ``problems``.
    """
    if recording.reference is not None:
        try:
            return measure_reference(spec, recording.form, recording.reference), recording.reference.name
        except FrameError as error:
            problems.append(str(error))
    return nominal_reference(spec, recording.form), UNMEASURED


def _timing(observations: list[Observation]) -> dict[str, dict[str, float]]:
    """Median, 95 and 99 % of the milliseconds of each stage, without the first frame, which also loads the compiled code."""
    if not observations:
        return {}
    warm = observations[1:] or observations
    stages = {stage: [o.ms[stage] for o in warm] for stage in observations[0].ms}
    return {s: dict(zip(("p50", "p95", "p99"), np.percentile(ms, (50, 95, 99)).round(4).tolist(), strict=True)) for s, ms in stages.items()}


def _arrays(names: list[str], observations: list[Observation], n: int) -> dict[str, np.ndarray]:
    """What ``pins.npz`` holds of M frames with ``n`` pins."""
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


def _nothing_found(path: str | Path, summary: dict, summary_path: Path) -> str:
    bad = summary["invalid"] + summary["failed"]
    return (
        f"{path}: the pins were found in none of {len(bad)} frames; the first, {bad[0]['image_name']}: {bad[0]['reason']}; "
        f"check --sensor, --form and the [pipeline] section of the specification (details in {summary_path})"
    )


def preprocess_recording(
    path: str | Path,
    spec: SensorSpec,
    out_dir: str | Path,
    form: Form | None = None,
    overlay: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """Observe every frame of a recording and write ``pins.npz``, ``summary.json`` and, if asked, ``overlay/``.

    A frame is valid if its pins were found.

    Parameters
    ----------
    path : path
        Anything ``open_recording`` takes.
    form : Form, optional
        Told by size and content if not given.
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    dict
        The summary; ``invalid`` and ``failed`` list the frames whose pins weren't found and those that couldn't be read.
        ``pins.npz`` has one row per readable frame, in the recording's order: ``image_name``, ``pins_px`` and
        ``predicted_px`` (M, N, 2), ``area_px2`` (M, N), ``found`` and ``valid`` (M,).

    Raises
    ------
    FrameError
        No frame was readable, or none was valid (the files are written all the same).
    StoreError
        The folder can't be written to.
    """
    recording = open_recording(path, spec, form)
    out_dir = Path(out_dir)
    try:
        (out_dir / "overlay" if overlay else out_dir).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritten(out_dir, error) from error
    notes: list[str] = []
    reference, reference_name = recording_reference(spec, recording, notes)
    pipeline = Pipeline(spec, recording.form, reference)
    names: list[str] = []
    observations: list[Observation] = []
    unfit: list[BadFrame] = []
    pictures: set[str] = set()
    for frame in recording:
        try:
            observation = pipeline(frame)
        except FrameError as error:
            unfit.append({"image_name": frame.name, "reason": str(error).removeprefix(f"{frame.name}: ")})
            continue
        names.append(frame.name)
        observations.append(observation)
        if overlay:
            picture = cv2.cvtColor(draw_overlay(frame, observation), cv2.COLOR_RGB2BGR)
            write_bytes(out_dir / "overlay" / overlay_name(frame.name, pictures), cv2.imencode(".png", picture)[1].tobytes())
        if progress:
            progress(frame.sequence + 1, len(recording))
    failed = recording.failed + unfit
    arrays = _arrays(names, observations, spec.pins.count)
    all_found = arrays["valid"] & (arrays["found"] == spec.pins.count)
    summary = {
        "sensor": spec.name,
        "frames": len(observations),
        "exact_fraction": float(all_found.sum() / max(len(names), 1)),
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
        "failed": failed,
        "problems": recording.problems + notes,
        "made_by": made_by(preprocess_recording, inputs=[spec, recording.path.resolve(), recording.names]),
    }
    write_npz(out_dir / "pins.npz", arrays, compressed=True)
    write_json(out_dir / "summary.json", summary)
    if not arrays["valid"].any():
        raise FrameError(_nothing_found(path, summary, out_dir / "summary.json"))
    return summary
