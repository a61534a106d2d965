"""Labelled real frames, the twin's pins for their labels, and the errors of these: without any fit, and with a friction for each frame.

Pins are compared in px of the recorded frames. A simulated pin is the recorded no-contact pin plus the simulated displacement, so that
the places of individual pins of a printed sensor do not count as errors of the mechanics.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import binned_statistic

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.camera.projection import project_in_form
from twin.errors import ContactError, FrameError
from twin.frames import open_recording
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.pins import Pipeline
from twin.pins.batch import UNMEASURED, recording_reference
from twin.progress import Step, report_each, unheard
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel, poses_and_moves, read_arm_labels
from twin.types import FINE, Form

FRICTIONS = (0.0, 0.15, 0.25, 0.32, 0.4, 0.5, 0.65, 1.0, 2.0)
"""Coefficients of friction among which a frame's individual friction is chosen."""
BINS = 4
"""Number of bins of a measure in the table of mean errors."""
MEASURES = {"depth_mm": "depth, mm", "angle_deg": "turn, deg", "shear_mm": "shear, mm"}
"""Measures by which the errors are tabled, and their titles."""
_SAME = 1e-9  # tolerance of a fraction of the path: fractions that differ by less belong to the same pose


@dataclass(frozen=True)
class MeasuredFrames:
    """Pins of M labelled frames of one recording, N each.

    Attributes
    ----------
    form : Form
    names : list of str
    labels : list of ArmLabel
    pins_px : (M, N, 2) float
        Places; NaN for lost pins.
    no_contact_px : (N, 2) float
    problems : list of str
        Irregularities of the recording and omitted frames, one line each.
    at_rest_seen : bool
        Whether the pins at rest were seen in a frame, or measured before on this unit; otherwise they are those of the specification.
    """

    form: Form
    names: list[str]
    labels: list[ArmLabel]
    pins_px: np.ndarray
    no_contact_px: np.ndarray
    problems: list[str]
    at_rest_seen: bool = True

    def __len__(self) -> int:
        return len(self.names)


def measure_frames(
    folder: Path,
    spec: SensorSpec,
    count: int | None,
    seed: int,
    *,
    experiment: ExperimentSpec | None = None,
    form: Form | None = None,
    progress: Step = unheard,
) -> MeasuredFrames:
    """Find the pins of ``count`` random frames of a labelled recording (None: of all frames). The frames have the order of the table.

    Raises
    ------
    FrameError
        There are no labels, one that the experiment varies is missing, or the pins were found in no frame.
    """
    recording = open_recording(folder, spec, form)
    labels, problems = read_arm_labels(recording, experiment), list(recording.problems)
    reference, named = recording_reference(spec, recording, problems)
    pipeline = Pipeline(spec, recording.form, reference)
    chosen = np.random.default_rng(seed).permutation(len(recording))[:count]
    kept, pins = [], []
    for row in report_each(np.sort(chosen).tolist(), progress):
        try:
            seen = pipeline(recording.read(row))
            if seen.valid:
                kept.append(row)
                pins.append(seen.pins_px)
            reason = seen.reason
        except FrameError as error:
            reason = str(error)
        if reason:
            problems.append(f"{recording.names[row]}: left out: {reason}")
    if not kept:
        raise FrameError(f"{folder}: no frame with pins among {len(chosen)}; {problems[-1] if problems else 'is it the right `sensor`?'}")
    names, told = [recording.names[row] for row in kept], [labels[row] for row in kept]
    return MeasuredFrames(recording.form, names, told, np.stack(pins), reference.pins_px, problems, named != UNMEASURED)


class ContactModel:
    """Simulated displacements of a sensor's pins for labels of an experiment.

    Parameters
    ----------
    form : Form
        Form of the frames in whose pixels the displacements are given.
    across : int
        Elements along each side of the skin's grid.
    """

    def __init__(self, spec: SensorSpec, experiment: ExperimentSpec, obj: ObjectSpec, form: Form, *, across: int = FINE) -> None:
        self.spec, self.experiment, self.form = spec, experiment, form
        self.rig = rig_of(spec, obj.name)
        self.solver = SkinSolver(spec, resolution=Resolution(across))
        self.contact = RigContact(self.solver, experiment, obj)
        self.rest_px = self._pixels(self.solver.rest().caps_mm)

    def displacement_px(self, label: ArmLabel, friction: float | None = None) -> np.ndarray:
        """Displacement (N, 2) from the state without contact, px, with the rig's friction unless another is given.

        Raises
        ------
        ContactError
            The contact does not converge, or is impossible.
        """
        return self.displacements_px(label, friction)[1]

    def displacements_px(self, label: ArmLabel, friction: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Displacements after the tap and at the end, as ``displacement_px``. The end is after the move if it was executed."""
        way = self.contact.commanded_path(label)
        if not way.touches and not label.executed:
            return np.zeros_like(self.rest_px), np.zeros_like(self.rest_px)
        tap_ends = 1 / (len(way.labels) - 1) if way.touches else 0.0
        tapped_mm = self.solver.rest().caps_mm
        for fraction, state in self.contact.along(way, friction=friction):
            if fraction <= tap_ends + _SAME:
                tapped_mm = state.caps_mm
        return self._pixels(tapped_mm) - self.rest_px, self._pixels(state.caps_mm) - self.rest_px

    def _pixels(self, caps_mm: np.ndarray) -> np.ndarray:
        return project_in_form(self.spec, self.form, caps_mm)


@dataclass(frozen=True)
class Comparison:
    """Simulated and recorded pins of M frames with N pins.

    Attributes
    ----------
    measured : MeasuredFrames
    simulated_px : (M, N, 2) float
        NaN if the contact failed.
    error_px : (M,) float
        Mean error over the pins; NaN if the contact failed.
    executed : (M,) bool
        Whether the arm executed the frame's move.
    by : dict of str to (M,) float
        ``depth_mm`` (the label along the approach), ``angle_deg`` (size of all turns), ``shear_mm`` (size of the executed move).
    friction, friction_error_px : (M,) float
        Individual friction of a frame, and the error with it; NaN for frames for which it was not fitted.
    failures : dict of str to str
        Reasons of failed contacts, by image name.
    """

    measured: MeasuredFrames
    simulated_px: np.ndarray
    error_px: np.ndarray
    executed: np.ndarray
    by: dict[str, np.ndarray]
    friction: np.ndarray
    friction_error_px: np.ndarray
    failures: dict[str, str]


def compare(model: ContactModel, measured: MeasuredFrames, *, friction_frames: int = 0, progress: Step = unheard) -> Comparison:
    """Simulate every frame's contact, and fit an individual friction to some frames.

    ``friction_frames`` is the number of frames whose friction is fitted. They are spread evenly over the frames with an executed move.
    """
    executed = np.array([label.executed for label in measured.labels])
    moved = np.flatnonzero(executed)
    sought = moved[np.linspace(0, len(moved) - 1, min(friction_frames, len(moved))).astype(int)]
    total, done = len(measured) + len(sought) * len(FRICTIONS), 0
    simulated, failures = np.full(measured.pins_px.shape, np.nan), {}

    def simulate(row: int, friction: float | None = None) -> np.ndarray:
        nonlocal done
        done += 1
        progress(done, total)
        return measured.no_contact_px + model.displacement_px(measured.labels[row], friction)

    for row, name in enumerate(measured.names):
        try:
            simulated[row] = simulate(row)
        except ContactError as failure:
            failures[name] = str(failure)
    errors, best, best_error = np.full((3, len(measured)), np.nan)
    solved = ~np.isnan(simulated[:, 0, 0])
    errors[solved] = pin_errors(simulated[solved], measured.pins_px[solved])
    best[sought], best_error[sought] = model.rig.friction, errors[sought]
    for row in sought.tolist():
        for friction in FRICTIONS:
            try:
                error = float(pin_errors(simulate(row, friction), measured.pins_px[row]))
            except ContactError:
                continue
            if not error >= best_error[row]:  # also true if the contact failed with the rig's friction (NaN)
                best[row], best_error[row] = friction, error
    axis, (poses, moves) = model.experiment.axis, poses_and_moves(measured.labels)
    depth, across = poses[:, axis], np.delete(moves[:, :3], axis, axis=1)
    by = {"depth_mm": depth, "angle_deg": np.linalg.norm(poses[:, 3:], axis=1), "shear_mm": np.linalg.norm(across, axis=1)}
    return Comparison(measured, simulated, errors, executed, by, best, best_error, failures)


def table_of(found: Comparison) -> list[dict]:
    """Mean errors of executed, not executed and all moves: ``group``, ``frames``, ``error_px`` and ``by`` each measure."""
    rows = []
    for group, chosen in (("move executed", found.executed), ("move not executed", ~found.executed), ("all", np.ones_like(found.executed))):
        solved = chosen & np.isfinite(found.error_px)
        if not solved.any():
            continue
        by = {}
        for key, values in found.by.items():
            edges = np.linspace(values.min(), values.max(), BINS + 1).tolist()
            if edges[0] < edges[-1]:
                by[key] = {"edges": edges, "means": binned_statistic(values[solved], found.error_px[solved], bins=edges).statistic.tolist()}
        rows.append({"group": group, "frames": int(solved.sum()), "error_px": float(found.error_px[solved].mean()), "by": by})
    return rows


def pin_errors(simulated_px: np.ndarray, measured_px: np.ndarray) -> np.ndarray:
    """Mean distance of the pins for each frame, (..., M), from places (..., M, N, 2). Lost pins (NaN) are ignored."""
    return np.nanmean(np.linalg.norm(simulated_px - measured_px, axis=-1), axis=-1)
