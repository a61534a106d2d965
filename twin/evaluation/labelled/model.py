"""Labelled real frames, and the twin's pins for their labels.

Pins are compared in px of the recorded frames. A simulated pin is the recorded no-contact pin plus the simulated displacement, so that
the places of individual pins of a printed sensor do not count as errors of the mechanics.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.camera.projection import project_in_form
from twin.errors import FrameError
from twin.frames import open_recording
from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver
from twin.pins import Pipeline
from twin.pins.batch import UNMEASURED, recording_reference
from twin.progress import Step, report_each, unheard
from twin.rig.contact import RigContact
from twin.rig.kinematics import rig_of
from twin.rig.labels import ArmLabel, read_arm_labels
from twin.types import FINE, Form

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
