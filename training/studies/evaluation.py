"""Use of trained models on recordings: estimates of the pose in every frame, and a model's errors on labelled frames."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from training.contact_estimator import ContactEstimator, contacts_folder
from training.contact_maps import judge_maps
from training.dataset import Dataset, joined, load_dataset, told_apart
from training.displacements import MOST_CONTACTS, OTHER_UNIT
from training.estimator import PoseEstimate, PoseEstimator, folder_of
from training.evaluate import judge, judge_changes, rows_to_judge, time_frames, write_evaluation
from training.identity import changed_since, learnt_before
from training.recipes import TrainingError
from training.simulated import is_simulated
from training.slip import Eyes, drags_of, gone_through, judge_slip, random_places
from twin.camera.projection import project
from twin.errors import FrameError
from twin.frames import Recording, evenly_read, open_recording
from twin.frames.forms import from_raw
from twin.mechanics.skin_map import ContactMaps
from twin.pins.batch import recording_reference
from twin.progress import Progress, silent, stage
from twin.report.contact_maps import SkinPicture, draw_contact_maps
from twin.report.table import write_table
from twin.store import output, write_npz, writes
from twin.types import Frame

# Choices of the rows to judge.
ROWS = ("validation", "all")
# Choices of the labels that count as truth.
LABELS = ("corrected", "raw")
# Length, mm, of the vector by which the direction of a shear traction is projected into the frame.
ARROW_MM = 1e-3


@dataclass(frozen=True)
class Predictions:
    """Estimates of a recording's frames, as an iterable. Each estimate is made when the iteration reaches its frame.

    Attributes
    ----------
    estimator : PoseEstimator or ContactEstimator
    recording : Recording
    maps : Path or None
        Folder into which the contact maps of each frame are written (see ``write_frame_maps``), if they are wanted.
    """

    estimator: PoseEstimator | ContactEstimator = field(repr=False)
    recording: Recording = field(repr=False)
    maps: Path | None = None

    def __iter__(self) -> Iterator[tuple[str, PoseEstimate]]:
        """The name of each frame and its estimate."""
        with nullcontext() if self.maps is None else output(self.maps, "*.npz", "*.png"):
            warm = False
            for frame in self.recording:
                if not warm:
                    # loads or compiles code, which must not count in a frame's time; a copy is used, so that no memory changes
                    self.estimator.remembering()(frame)
                    warm = True
                if self.maps is None or not isinstance(self.estimator, PoseEstimator):
                    yield frame.name, self.estimator(frame)
                    continue
                made, maps = self.estimator.contact_maps(frame)
                if maps is not None:
                    write_frame_maps(self.maps, self.estimator, frame, maps)
                yield frame.name, made

    def lines(self) -> Iterator[str]:
        """Lines of text: irregularities of the recording, each frame's pose as soon as it is estimated, and the frames that can't be read.

        Raises
        ------
        FrameError
            At the end, if no frame gave a pose.
        """
        told, poses, reasons = len(self.recording.problems), 0, []
        yield from (f"note: {problem}" for problem in [*self.recording.problems, *self.estimator.caveats])
        for name, made in self:
            yield f"{name}: {_said(made)}"
            poses += made.valid
            if not made.valid:
                reasons.append(f"{name}: {made.reason}")
        yield from (f"note: {problem}" for problem in self.recording.problems[told:])
        for bad in self.recording.failed:
            yield f"skipped {bad['image_name']}: {bad['reason']}"
            reasons.append(f"{bad['image_name']}: {bad['reason']}")
        if not poses:
            raise FrameError(f"{self.recording.path}: none of {len(self.recording)} frames gave a pose ({reasons[0]}); give other frames")


def models_of_kinds(run: str | Path, frames: str | Path) -> ContactEstimator | None:
    """The models of several kinds of contact in a run, if the frames at a path have their form; else None.

    Raises
    ------
    TrainingError
        The models can't be read.
    FrameError
        There are no such frames, or they belong to another sensor.
    """
    folder = contacts_folder(run)
    if folder is None:
        return None
    models = ContactEstimator.load(folder)
    alone = folder == folder_of(run)  # there is no other model that could take frames of another form
    return models if alone or open_recording(frames, models.sensor).form == models.form else None


def _slip_errors(estimator: PoseEstimator, parts: Sequence[Dataset], chosen: set[str]) -> dict[str, Any] | None:
    """Errors of slip on the drags whose frames are all ``chosen``, each traversed once at a random speed; None if there is none."""
    assert estimator.slip is not None
    rng, ways = np.random.default_rng(0), []
    called = told_apart([part.folder.resolve() for part in parts]) if len(parts) > 1 else [""]
    for part, prefix in zip(parts, called, strict=True):
        eyes = Eyes(estimator.modes_of, part.pins)
        for rows, drag in drags_of(part):
            names = {f"{prefix}/{name}" if prefix else name for name in part.pins.image_name[rows].tolist()}
            if names <= chosen:
                ways.append(gone_through(drag, random_places(len(rows), rng), eyes, rng))
    return asdict(judge_slip(estimator.slip, ways)) if ways else None


def write_frame_maps(folder: Path, estimator: PoseEstimator, frame: Frame, maps: ContactMaps) -> list[Path]:
    """Write the contact maps of one frame: arrays as ``NAME.npz``, a picture as ``NAME.png``. NAME is the frame's name without suffix.

    The arrays are ``nodes_mm`` (G, 3), ``nodes_px`` (G, 2) in the frame, ``area_mm2`` (G,), ``force_n`` (G, 3), ``pressure_mpa`` (G,),
    ``traction_mpa`` (G, 3) and ``patch`` (G,), of the grid's nodes, and ``resultant_n`` (3,) and ``torque_z_nmm``.
    """
    spec, name = estimator.sensor, Path(frame.name).stem
    along = maps.traction_mpa / np.maximum(np.linalg.norm(maps.traction_mpa, axis=1, keepdims=True), 1e-12)
    nodes_px, ends_px = (
        from_raw(spec.recording, estimator.form, project(spec.view, places)) for places in (maps.nodes_mm, maps.nodes_mm + ARROW_MM * along)
    )
    arrays = {key: getattr(maps, key) for key in ("nodes_mm", "area_mm2", "force_n", "pressure_mpa", "traction_mpa", "patch")}
    totals = {"resultant_n": maps.resultant_n, "torque_z_nmm": np.array(maps.torque_z_nmm)}
    write_npz(folder / f"{name}.npz", arrays | totals | {"nodes_px": nodes_px})
    shear = np.linalg.norm(maps.traction_mpa, axis=1)
    shown = SkinPicture(frame.image, nodes_px, ends_px, maps.nodes_mm, maps.pressure_mpa, shear, maps.least_mpa)
    force = ", ".join(f"{axis} {value:.2f}" for axis, value in zip("xyz", maps.resultant_n, strict=True))
    draw_contact_maps(folder / f"{name}.png", shown, f"{frame.name}: force {force} N")
    return [folder / f"{name}.npz", folder / f"{name}.png"]


def predict_frames(run: str | Path, frames: str | Path, *, maps: Path | None = None, sequence: bool = False) -> Predictions:
    """Estimate the poses in the frames at a path with a trained model.

    If the model uses displacements from rest and the recording has a frame without contact, displacements are computed from that frame.

    Parameters
    ----------
    run : path
        Path or name as for ``PoseEstimator.load``.
    frames : path
        Path as for ``open_recording``.
    maps : path, optional
        Folder for the contact maps of each frame.
    sequence : bool
        The frames are consecutive, so slip is also estimated (``PoseEstimator.remembering``).

    Raises
    ------
    TrainingError
        There is no such run, or contact maps or slip are requested and the run has no model of them.
    FrameError
        There are no such frames, or they belong to another sensor.
    """
    several = models_of_kinds(run, frames)
    estimator = several or PoseEstimator.load(run)
    recording = open_recording(frames, estimator.sensor, estimator.form)
    if estimator.counts_from_rest:
        if recording.reference is not None:
            estimator = estimator.at_rest(recording.reference)
        else:
            recording_reference(estimator.recorded_sensor, recording, recording.problems)
            estimator, other = estimator.at_rest_of(evenly_read(recording, MOST_CONTACTS))
            recording.problems += [OTHER_UNIT] if other else []
    if maps is not None:
        if not isinstance(estimator, PoseEstimator):
            raise TrainingError(f"{run}: models of several kinds of contact have no contact maps; leave --maps out")
        estimator.require_maps()
    if sequence:
        if not isinstance(estimator, PoseEstimator) or estimator.slip is None:
            raise TrainingError(
                f"{run}: does not tell slip; train touch on simulated drags ('twin dataset --experiment drag --randomise drag "
                "--states all'), or leave --sequence out"
            )
        estimator = estimator.remembering()
    return Predictions(estimator, recording, maps)


def at_own_rest(estimator: PoseEstimator, data: Dataset) -> Dataset:
    """A recording without a no-contact frame, relative to the pins at rest estimated from its contacts; other recordings unchanged."""
    if not estimator.counts_from_rest or is_simulated(data.folder):
        return data
    if open_recording(data.folder, estimator.sensor, estimator.form).reference is not None:
        return data
    other = estimator.other_rest(data.pins.reference, data.pins.nodes_px)
    if other is None:
        return data
    return replace(data, pins=replace(data.pins, reference=other, measured=True), problems=[*data.problems, OTHER_UNIT])


def _said(made: PoseEstimate) -> str:
    if not made.valid:
        return f"not valid: {made.reason}"
    rows = zip(made.names, made.units, made.value, made.low, made.high, strict=True)
    pose = ", ".join(f"{name} {value:.3f} {unit} [{low:.3f}, {high:.3f}]" for name, unit, value, low, high in rows)
    moved = "" if made.executed != made.executed else f", move executed {made.executed:.2f}"  # NaN: the model does not estimate it
    kind = f"{made.contact}: " if made.contact else ""
    notes = "".join(f"; {note}" for note in made.notes)
    return f"{kind}{pose}{moved} ({made.ms:.1f} ms){notes}"


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a model.

    Attributes
    ----------
    metrics : dict
        Content of ``metrics.json``. With models of several kinds of contact it includes ``taken_for``, the share of frames classified as
        each kind. For simulated contacts and a run with contact maps it includes ``maps`` (see ``MapErrors``), and for a run that estimates
        slip ``slip`` (see ``SlipErrors``).
    changes : list of dict
        Errors on changed images; empty if they were not asked for.
    units : dict of str to str
        Unit of each label.
    frames : int
        Number of judged frames.
    problems : list of str
        Irregularities of the recordings.
    written : list of Path
    """

    metrics: dict[str, Any]
    changes: list[dict[str, Any]]
    units: dict[str, str]
    frames: int
    problems: list[str]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"note: {problem}" for problem in self.problems]
        for name, unit in self.units.items():
            raw, corrected = self.metrics["raw"][name], self.metrics["corrected"][name]
            lines.append(
                f"{name}: mean error {corrected['mae']:.4g} {unit} against corrected labels, {raw['mae']:.4g} against raw; "
                f"{100 * corrected['coverage_90']:.1f} % and {100 * raw['coverage_90']:.1f} % inside the 90 % intervals for them"
            )
        if taken := self.metrics.get("taken_for"):
            lines.append("taken for " + ", ".join(f"{kind} {100 * share:.1f} %" for kind, share in taken.items()))
        if maps := self.metrics.get("maps"):
            lines.append(
                f"contact maps of {maps['states']} states: patch's intersection over union {maps['patch_iou']:.2f}, correlation of the "
                f"pressure {maps['pressure_correlation']:.2f} and of the shear {maps['shear_correlation']:.2f}, "
                f"total force wrong by {100 * maps['resultant']:.1f} %"
            )
        if slip := self.metrics.get("slip"):
            lines.append(
                f"slip of {slip['contacts']} contacts: slip of all of it told in {100 * slip['whole_accuracy']:.1f} % of the frames, "
                f"alarm {slip['lead_mm']:.2f} mm of drag before it, in {100 * slip['false_alarms']:.1f} % of the frames without slip; "
                f"sliding share wrong by {slip['share']:.2f}, way left by {slip['left_mm']:.2f} mm"
            )
        if self.metrics["leak_slope"] is not None:
            lines.append(f"slope of the angle's error on move_6 where it was not executed: {self.metrics['leak_slope']:+.3f}")
        ms = self.metrics["ms_per_frame"]
        lines.append(f"{self.frames} frames" + ("" if ms is None else f", {ms:.1f} ms per frame (median, one thread)"))
        for row in self.changes:
            said = (f"{name} {row[f'{name}_mae']:.4g} ({100 * row[f'{name}_more']:+.1f} %)" for name in self.units)
            lines.append(f"{row['change']}: {', '.join(said)}; {row['not_valid']} frames not valid")
        return lines


@writes("predictions.csv", "metrics.json", "errors.png", "robustness.csv")
def evaluate_run(
    run: str | Path,
    recordings: Sequence[Path],
    out: Path,
    *,
    rows: str = "validation",
    labels: str = "corrected",
    robustness: bool = False,
    progress: Progress = silent,
) -> Evaluation:
    """Judge a trained model, and write the result to a folder.

    Parameters
    ----------
    run : path
        Path or name as for ``PoseEstimator.load``.
    recordings : sequence of Path
        Labelled recordings; for ``rows="validation"`` exactly those that the run was trained on.
    rows : {"validation", "all"}
        Judge the rows that were kept out of the run's training, or all rows.
    labels : {"corrected", "raw"}
        Labels that count as truth in ``predictions.csv`` and ``errors.png``.
    robustness : bool
        Also judge changed images.

    Raises
    ------
    TrainingError
        There is no such run, or ``rows`` or ``labels`` has another value. Or the run holds models of several kinds of contact, and the
        recording varies the labels of none, or ``rows`` is not ``"all"``.
    FrameError
        The recordings are not of the run's sensor, or have no labels.

    Notes
    -----
    With models of several kinds of contact (``ContactEstimator``), each frame is judged by the most probable of those kinds whose labels
    the recording varies. ``taken_for`` of the metrics shows the classification among all kinds.
    """
    for value, allowed, option in ((rows, ROWS, "--rows"), (labels, LABELS, "--labels")):
        if value not in allowed:
            raise TrainingError(f"{option} must be {' or '.join(allowed)}, got {value!r}")
    several, parts, kinds = models_of_kinds(run, recordings[0]), [], []
    if several is None:
        estimator = PoseEstimator.load(run)
    elif rows == "validation":
        raise TrainingError(f"{run}: models of several kinds of contact; which rows they kept out is not known; give --rows all")
    else:
        kinds = several.for_labels(open_recording(recordings[0], several.sensor, several.form))
        estimator = several.parts[kinds[0]]
    for folder in recordings:
        with stage(progress, f"frames of {folder.name}") as step:
            part = load_dataset(folder, estimator.recorded_sensor, estimator.names, form=estimator.form, progress=step)
            parts.append(at_own_rest(estimator, part))
    found = joined(parts)
    chosen = rows_to_judge(estimator, found, rows)
    if rows == "validation":
        found.problems.extend(changed_since(estimator.config, found, estimator.part))
    else:
        found.problems.extend(learnt_before(estimator.learnt_from, found))
    made = several.predict_rows(found, chosen, kinds) if several else estimator.predict_rows(found, chosen)
    metrics = {"model": estimator.model, "rows": rows, **judge(made, found, chosen)}
    metrics["ms_per_frame"] = time_frames(several or estimator, found)
    if several is not None:
        metrics["taken_for"] = several.taken_for(found.pins.rows(chosen))
    if estimator.maps is not None and several is None and all(is_simulated(folder) for folder in found.folders):
        rated = judge_maps(estimator.maps_of(found.pins.rows(chosen), made.mean), found, chosen)
        metrics["maps"] = None if rated is None else asdict(rated)
    if estimator.slip is not None and several is None and all(is_simulated(folder) for folder in found.folders):
        metrics["slip"] = _slip_errors(estimator, parts, set(found.pins.image_name[chosen].tolist()))
    written, changes = write_evaluation(out, made, found, chosen, metrics, labels), []
    if robustness:
        with stage(progress, "changed frames") as step:
            changes = judge_changes(estimator, found, chosen, progress=step)
        written.append(write_table(out / "robustness.csv", changes))
    units = dict(zip(estimator.names, estimator.units, strict=True))
    return Evaluation(metrics, changes, units, len(chosen), found.problems, written)
