"""Estimates of the pose in every frame of a recording, by a trained model."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from training.errors import TrainingError
from training.estimate.contact_estimator import ContactEstimator
from training.estimate.displacements import MOST_CONTACTS, OTHER_UNIT
from training.estimate.estimator import PoseEstimate, PoseEstimator
from training.studies.evaluation import models_of_kinds
from twin.camera.projection import project
from twin.errors import FrameError
from twin.estimate import readable_labels
from twin.frames import Recording, evenly_read, open_recording
from twin.frames.folders import IMAGE_FOLDERS, references_in
from twin.frames.forms import from_raw
from twin.mechanics.skin_map import ContactMaps
from twin.pins.batch import recording_reference
from twin.report.contact_maps import SkinPicture, draw_contact_maps
from twin.store import output, write_npz
from twin.types import Frame

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
                    self.estimator.with_history()(frame)
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
        if not poses:
            raise FrameError(f"{self.recording.path}: none of {len(self.recording)} frames gave a pose ({reasons[0]}); give other frames")


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
    moved = (
        "" if made.executed != made.executed else f", move executed with probability {made.executed:.2f}"
    )  # NaN: the model does not estimate it
    kind = f"{made.contact}: " if made.contact else ""
    notes = "".join(f"; {note}" for note in made.notes)
    return f"{kind}{pose}{moved} ({made.ms:.1f} ms){notes}"
