"""A trained model's errors on labelled frames, and its estimates and contact maps in every frame of a recording."""

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.data.dataset import Dataset, join_datasets, load_dataset
from training.data.simulated import is_simulated
from training.errors import TrainingError
from training.estimate.contact_estimator import ContactEstimator, contacts_folder
from training.estimate.estimator import PoseEstimate, PoseEstimator
from training.estimate.rest import MOST_CONTACTS, OTHER_UNIT
from training.runs.config import changed_since, trained_before
from training.runs.run_files import folder_of
from training.studies.judging import measure_changes, measure_errors, rows_to_evaluate, time_frames, write_evaluation
from training.touch.contact_maps import compare_maps
from training.touch.slip import CapView, compare_slip, name_drags, random_places, resample_path
from twin.camera.projection import project_in_form
from twin.errors import FrameError, format_count
from twin.estimate import readable_labels
from twin.frames import Recording, evenly_read, open_recording
from twin.frames.folders import IMAGE_FOLDERS, references_in
from twin.mechanics.skin_map import ContactMaps
from twin.pins.batch import recording_reference
from twin.progress import Progress, silent, stage
from twin.report.charts import ink, save_figure, sequential, sized_figure
from twin.report.page import write_table
from twin.store import output, write_npz, writes
from twin.types import FloatArray, Frame, ImageArray, ReadableResult

# Choices of the rows to evaluate.
ROWS = ("validation", "all")
# Choices of the labels that count as truth.
LABELS = ("corrected", "raw")
ARROW_MM = 1e-3
"""Length, mm, of the vector by which the direction of a shear traction is projected into the frame."""
SIZE_INCH = (12.0, 5.2)
"""Width and height of the picture, inch."""
SHOWN_SHARE = 0.02
"""Share of the largest pressure above which a place is coloured over the frame."""
ARROW_EVERY = 2
"""Number of grid nodes in each direction for one arrow of shear."""
ARROW_SHARE = 0.06
"""Length of the longest arrow, as a share of the frame's width."""


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
    for part, names, drag in name_drags(parts):
        if chosen.issuperset(names):
            ways.append(resample_path(drag, random_places(len(names), rng), CapView(estimator.modes_of, part.pins), rng))
    return compare_slip(estimator.slip, ways) if ways else None


def at_own_rest(estimator: PoseEstimator, data: Dataset) -> Dataset:
    """A recording without a no-contact frame, relative to the pins at rest estimated from its contacts; other recordings unchanged.

    Raises
    ------
    FrameError
        The camera's picture is displaced so far that estimates would be wrong.
    """
    if not estimator.counts_from_rest or is_simulated(data.folder):
        return data
    if open_recording(data.folder, estimator.sensor, estimator.form).reference is not None:
        return data
    other = estimator.rest.other(data.pins.reference, data.pins.nodes_px)
    estimator.rest.require_view_of_contacts(data.pins.nodes_px[data.pins.valid], other, f"the contacts of {data.folder.name}")
    if other is None:
        return data
    return replace(data, pins=replace(data.pins, reference=other, measured=True), problems=[*data.problems, OTHER_UNIT])


@dataclass(frozen=True, repr=False)
class Evaluation(ReadableResult):
    """Evaluation of a model.

    Attributes
    ----------
    metrics : dict
        Content of ``metrics.json``. With models of several kinds of contact it includes ``taken_for``, the share of frames classified as
        each kind. For simulated contacts and a run with contact maps it includes ``maps`` (see ``compare_maps``), and for a run that
        estimates slip ``slip`` (see ``compare_slip``).
    changes : list of dict
        Errors on changed images; empty if they were not requested.
    units : dict of str to str
        Unit of each label.
    frames : int
        Number of evaluated frames.
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
        labels = dict(zip(self.units, readable_labels(tuple(self.units)), strict=True))
        for name, label in labels.items():
            unit, raw, corrected = self.units[name], self.metrics["raw"][name], self.metrics["corrected"][name]
            against = "" if raw == corrected else f" against corrected labels, {raw['mae']:.4g} against raw"
            inside = " and ".join(f"{100 * kind['coverage_90']:.1f} %" for kind in ([corrected, raw] if against else [raw]))
            inside += f" inside the 90 % intervals{' for them' if against else ''}"
            lines.append(f"{label}: mean error {corrected['mae']:.4g} {unit}{against}; {inside}")
        if taken := self.metrics.get("taken_for"):
            lines.append("taken for " + ", ".join(f"{kind} {100 * share:.1f} %" for kind, share in taken.items()))
        if maps := self.metrics.get("maps"):
            lines.append(
                f"contact maps (states: {maps['states']}): patch's intersection over union {maps['patch_iou']:.2f}, correlation of the "
                f"pressure {maps['pressure_correlation']:.2f} and of the shear {maps['shear_correlation']:.2f}, "
                f"error of the total force {100 * maps['resultant']:.1f} %"
            )
        if slip := self.metrics.get("slip"):
            lines.append(
                f"slip (contacts: {slip['contacts']}): gross slip classified correctly in {100 * slip['whole_accuracy']:.1f} % of the "
                f"frames, alarm {slip['lead_mm']:.2f} mm of drag before it, false alarm in {100 * slip['false_alarms']:.1f} % of the "
                f"frames without slip; error of the sliding share {slip['share']:.2f}, of the remaining distance {slip['left_mm']:.2f} mm"
            )
        if self.metrics["leak_slope"] is not None:
            lines.append(f"slope of the angle's error on a twist that was not executed: {self.metrics['leak_slope']:+.3f}")
        ms = self.metrics["ms_per_frame"]
        lines.append(format_count(self.frames, "frames") + ("" if ms is None else f", {ms:.1f} ms per frame (median, one thread)"))
        for row in self.changes:
            said = (f"{label} {row[f'{name}_mae']:.4g} ({100 * row[f'{name}_more']:+.1f} %)" for name, label in labels.items())
            lines.append(f"{row['change']}: {', '.join(said)}; {format_count(row['not_valid'], 'frames')} not valid")
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
    """Evaluate a trained model, and write the result to a folder.

    Parameters
    ----------
    run : path
        Path or name as for ``PoseEstimator.load``.
    recordings : sequence of Path
        Labelled recordings; for ``rows="validation"`` exactly those that the run was trained on.
    rows : {"validation", "all"}
        Evaluate the rows that were kept out of the run's training, or all rows.
    labels : {"corrected", "raw"}
        Labels that count as truth in ``predictions.csv`` and ``errors.png``.
    robustness : bool
        Also evaluate changed images.

    Raises
    ------
    TrainingError
        There is no such run, or ``rows`` or ``labels`` has another value. Or the run holds models of several kinds of contact, and the
        recording varies the labels of none, or ``rows`` is not ``"all"``.
    FrameError
        The recordings are not of the run's sensor, or have no labels.

    Notes
    -----
    With models of several kinds of contact (``ContactEstimator``), each frame is evaluated by the most probable of those kinds whose labels
    the recording varies. ``taken_for`` of the metrics shows the classification among all kinds.
    """
    for value, allowed, option in ((rows, ROWS, "`rows`"), (labels, LABELS, "`label_kind`")):
        if value not in allowed:
            raise TrainingError(f"{option} must be {' or '.join(allowed)}, got {value!r}")
    several, parts, kinds = models_of_kinds(run, recordings[0]), [], []
    if several is None:
        estimator = PoseEstimator.load(run)
    elif rows == "validation":
        raise TrainingError(f"{run}: models of several kinds of contact; which rows they kept out is not known; give `rows` all")
    else:
        kinds = several.for_labels(open_recording(recordings[0], several.sensor, several.form))
        estimator = several.parts[kinds[0]]
    for folder in recordings:
        with stage(progress, f"frames of {folder.name}") as step:
            part = load_dataset(folder, estimator.recorded_sensor, estimator.names, form=estimator.form, progress=step)
            if estimator.counts_from_rest and part.pins.measured:
                estimator.rest.require_view(part.pins.reference.pins_px, folder.name)
            parts.append(at_own_rest(estimator, part))
    found = join_datasets(parts)
    chosen = rows_to_evaluate(estimator, found, rows)
    notes = trained_before(estimator.learnt_from, found) if rows == "all" else changed_since(estimator.config, found, estimator.part)
    found.problems.extend(notes)
    made = several.predict_rows(found, chosen, kinds) if several else estimator.predict_rows(found, chosen)
    metrics = {"model": estimator.model, "rows": rows, **measure_errors(made, found, chosen)}
    metrics["ms_per_frame"] = time_frames(several or estimator, found)
    if several is not None:
        metrics["taken_for"] = several.taken_for(found.pins.rows(chosen))
    if estimator.maps is not None and several is None and all(is_simulated(folder) for folder in found.folders):
        metrics["maps"] = compare_maps(estimator.maps_of(found.pins.rows(chosen), made.mean), found, chosen)
    if estimator.slip is not None and several is None and all(is_simulated(folder) for folder in found.folders):
        metrics["slip"] = _slip_errors(estimator, parts, set(found.pins.image_name[chosen].tolist()))
    written, changes = write_evaluation(out, made, found, chosen, metrics, labels), []
    if robustness:
        with stage(progress, "changed frames") as step:
            changes = measure_changes(estimator, found, chosen, progress=step)
        written.append(write_table(out / "robustness.csv", changes))
    units = dict(zip(estimator.names, estimator.units, strict=True))
    return Evaluation(metrics, changes, units, len(chosen), found.problems, written)


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
            for number, frame in enumerate(self.recording):
                if not number:  # loads or compiles code, which must not count in a frame's time; a copy, so that no memory changes
                    self.estimator.with_history()(frame)
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
        known, poses, reasons = len(self.recording.problems), 0, []
        yield from (f"note: {problem}" for problem in [*self.recording.problems, *self.estimator.caveats])
        for name, made in self:
            yield f"{name}: {_describe_estimate(made)}"
            poses += made.valid
            if not made.valid:
                reasons.append(f"{name}: {made.reason}")
        yield from (f"note: {problem}" for problem in self.recording.problems[known:])
        for bad in self.recording.failed:
            yield f"skipped {bad['image_name']}: {bad['reason']}"
            reasons.append(f"{bad['image_name']}: {bad['reason']}")
        if reasons and self.estimator.sensor.layout_unsure:
            yield "note: 'twin new' was unsure of the layout of this sensor's pins, which may be why: decide it, and train again"
        if not poses:
            given = format_count(len(self.recording), "frames")
            raise FrameError(f"{self.recording.path}: none of {given} gave a pose ({reasons[0]}); give other frames")


def predict_frames(run: str | Path, frames: str | Path, *, maps: Path | None = None, sequence: bool = False) -> Predictions:
    """Estimate the poses in the frames at a path with a trained model.

    If the model uses displacements from rest and the recording has a frame without contact, displacements are computed from that frame. For
    a single picture it is looked for beside the picture.

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
        if recording.reference is None and Path(frames).is_file():
            _find_rest_frame(recording, Path(frames))
        if recording.reference is not None:
            estimator = estimator.at_rest(recording.reference)
        else:
            recording_reference(estimator.recorded_sensor, recording, recording.problems)
            estimator, other = estimator.at_rest_of(evenly_read(recording, MOST_CONTACTS))
            recording.problems += [OTHER_UNIT] if other else []
    if maps is not None:
        if not isinstance(estimator, PoseEstimator):
            raise TrainingError(f"{run}: models of several kinds of contact have no contact maps; leave `maps` out")
        estimator.require_maps()
    if sequence:
        if not isinstance(estimator, PoseEstimator) or estimator.slip is None:
            raise TrainingError(
                f"{run}: does not estimate slip; train touch on simulated drags ('twin dataset --experiment drag --randomise drag "
                "--states all'), or leave `sequence` out"
            )
        estimator = estimator.with_history()
    return Predictions(estimator, recording, maps)


def _find_rest_frame(recording: Recording, picture: Path) -> None:
    """Use a frame without contact that lies where that of a recording would, if there is one."""
    homes = [picture.parent, *([picture.parent.parent] if picture.parent.name in IMAGE_FOLDERS else [])]
    recording.take_reference([file for home in homes for file in references_in(home) if file.name != picture.name])
    if recording.reference is not None:
        recording.problems.append(f"displacements of pins are measured from {recording.reference.name}, which is beside the picture")


def _describe_estimate(made: PoseEstimate) -> str:
    if not made.valid:
        return f"not valid: {made.reason}"
    rows = zip(readable_labels(made.names), made.units, made.value, made.low, made.high, strict=True)
    pose = ", ".join(f"{name} {value:.3f} {unit} [{low:.3f}, {high:.3f}]" for name, unit, value, low, high in rows)
    moved = f", move executed with probability {made.executed:.2f}" if np.isfinite(made.executed) else ""
    kind = f"{made.contact}: " if made.contact else ""
    notes = "".join(f"; {note}" for note in made.notes)
    return f"{kind}{pose}{moved} ({made.ms:.1f} ms){notes}"


def write_frame_maps(folder: Path, estimator: PoseEstimator, frame: Frame, maps: ContactMaps) -> list[Path]:
    """Write the contact maps of one frame: arrays as ``NAME.npz``, a picture as ``NAME.png``. NAME is the frame's name without suffix.

    The arrays are ``nodes_mm`` (G, 3), ``nodes_px`` (G, 2) in the frame, ``area_mm2`` (G,), ``force_n`` (G, 3), ``pressure_mpa`` (G,),
    ``traction_mpa`` (G, 3) and ``patch`` (G,), of the grid's nodes, and ``resultant_n`` (3,) and ``torque_z_nmm``. The picture shows
    pressure (colour), shear (arrows) and patch (line) over the frame, and the pressure on the deformed skin.
    """
    spec, name = estimator.sensor, Path(frame.name).stem
    along = maps.traction_mpa / np.maximum(np.linalg.norm(maps.traction_mpa, axis=1, keepdims=True), 1e-12)
    nodes_px = project_in_form(spec, estimator.form, maps.nodes_mm)
    ends_px = project_in_form(spec, estimator.form, maps.nodes_mm + ARROW_MM * along)
    arrays = {key: getattr(maps, key) for key in ("nodes_mm", "area_mm2", "force_n", "pressure_mpa", "traction_mpa", "patch")}
    totals = {"resultant_n": maps.resultant_n, "torque_z_nmm": np.array(maps.torque_z_nmm)}
    write_npz(folder / f"{name}.npz", arrays | totals | {"nodes_px": nodes_px})
    force = ", ".join(f"{axis} {value:.2f}" for axis, value in zip("xyz", maps.resultant_n, strict=True))
    figure, (over, _) = sized_figure(SIZE_INCH, 2)
    figure.axes[1].remove()
    _draw_over(over, frame.image, maps, nodes_px, ends_px)
    _draw_skin(figure, maps)
    figure.suptitle(f"{frame.name}: force {force} N")
    save_figure(folder / f"{name}.png", figure, dpi=100)
    return [folder / f"{name}.npz", folder / f"{name}.png"]


def _on_grid(*values: FloatArray) -> list[FloatArray]:
    """Values (S^2,) of the nodes as squares (S, S)."""
    side = int(np.sqrt(len(values[0])))
    return [each.reshape(side, side) for each in values]


def _draw_over(axes: Axes, image: ImageArray, maps: ContactMaps, nodes_px: FloatArray, ends_px: FloatArray) -> None:
    """Draw over the frame: nodes (G, 2), and the same places a little farther along the shear traction (``ARROW_MM``)."""
    height, width = image.shape[:2]
    axes.imshow(image, cmap="gray")
    largest = max(float(maps.pressure_mpa.max()), 1e-9)
    x, y, pressure = _on_grid(*nodes_px.T, maps.pressure_mpa)
    seen = np.ma.masked_less(pressure, SHOWN_SHARE * largest)
    axes.pcolormesh(x, y, seen, shading="nearest", cmap=sequential(), vmin=0, vmax=largest, alpha=0.55, linewidth=0)
    if maps.least_mpa < largest:
        axes.contour(x, y, pressure, [maps.least_mpa], colors="white", linewidths=1.2)
    way = ends_px - nodes_px
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    shear = np.linalg.norm(maps.traction_mpa, axis=1)
    length = shear / max(float(shear.max()), 1e-9) * ARROW_SHARE * width
    chosen = (np.indices(pressure.shape) % ARROW_EVERY == 0).all(axis=0).ravel() & (maps.pressure_mpa >= SHOWN_SHARE * largest)
    at, arrow = nodes_px[chosen], (way * length[:, None])[chosen]
    axes.quiver(*at.T, *arrow.T, angles="xy", scale_units="xy", scale=1, color="white", width=0.004)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title="over the frame; arrows: shear on the object")
    axes.grid(visible=False)


def _draw_skin(figure: Figure, maps: ContactMaps) -> None:
    axes = figure.add_subplot(1, 2, 2, projection="3d")
    x, y, z, pressure = _on_grid(*maps.nodes_mm.T, maps.pressure_mpa)
    largest = max(float(pressure.max()), 1e-9)
    axes.plot_surface(x, y, z, facecolors=sequential()(pressure / largest), rcount=len(x), ccount=len(x), linewidth=0, shade=True)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm", aspect="equal", title=f"on the skin; largest pressure {largest:.3g} N/mm²")
    axes.view_init(elev=35, azim=-60)
    axes.tick_params(colors=ink())
