"""Validation: compares the twin's pins with those of labelled real frames. The results are tables and a page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes import ExperimentSpec, ObjectSpec, SensorSpec, load_object
from twin.calibration.contact.forces import FILES, ForceComparison, ForceSetup, compare_table, is_table
from twin.evaluation.labelled import Comparison, ContactModel, compare, measure_frames
from twin.evaluation.labelled.report import summary_of, write_validation
from twin.progress import Progress, silent, stage
from twin.store import writes
from twin.types import FINE, Form, ReadableResult

# Number of frames for which an individual friction is fitted.
FRICTION_FRAMES = 5


@dataclass(frozen=True, repr=False)
class Validation(ReadableResult):
    """The result of a validation.

    Attributes
    ----------
    comparison : Comparison
    summary : dict
        Content of ``validation.json``.
    sensor : SensorSpec
    written : list of Path
    """

    comparison: Comparison
    summary: dict[str, Any]
    sensor: SensorSpec
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = []
        if self.sensor.rig is None:
            lines.append(f"note: {self.sensor.name} has no [rig]: the tool point counts as the tip; 'twin calibrate contact' fits one")
        for row in self.summary["table"]:
            lines.append(f"{row['group']}: {row['error_px']:.2f} px, nothing free (frames: {row['frames']})")
        if own := self.summary["one_friction_a_frame"]:
            common_px = own["error_with_common_friction_px"]
            lines.append(f"one friction a frame (frames: {own['frames']}): {own['error_px']:.2f} px (common friction: {common_px:.2f} px)")
        if failures := self.comparison.failures:
            lines.append(f"failed contacts: {len(failures)}; see frames.csv")
        return lines


@writes("frames.csv", "validation.json", "errors*.png", "frames*.png", *FILES)
def validate_contacts(
    sensor: SensorSpec,
    frames: Path,
    experiment: ExperimentSpec,
    out: Path,
    *,
    obj: ObjectSpec | None = None,
    limit: int | None = None,
    friction_frames: int = FRICTION_FRAMES,
    seed: int = 0,
    across: int = FINE,
    form: Form | None = None,
    columns: Mapping[str, str] | None = None,
    progress: Progress = silent,
) -> Validation | ForceComparison:
    """Simulate the contacts of labelled frames, compare the pins, and write the result to a folder.

    Parameters
    ----------
    frames : Path
        A labelled recording, or a table of poses and forces alone (``.csv``), whose forces are then compared.
    experiment : ExperimentSpec
        The experiment that the recording was made with.
    obj : ObjectSpec, optional
        The experiment's own object by default.
    limit : int, optional
        Number of frames, chosen at random with ``seed``; all by default.
    friction_frames : int
        Number of frames for which an individual friction is fitted.
    across : int
        Elements along each side of the skin's grid.
    columns : mapping of str to str, optional
        As for ``calibrate_to_file``.

    Raises
    ------
    FrameError
        The recording has no labels, or no frame with pins.
    """
    if is_table(frames):
        setup = ForceSetup(sensor, experiment, obj or load_object(experiment.object), across)
        return compare_table(frames, setup, out, columns, 0, seed, progress)
    with stage(progress, "pins") as step:
        measured = measure_frames(frames, sensor, limit, seed, experiment=experiment, form=form, progress=step)
    model = ContactModel(sensor, experiment, obj or load_object(experiment.object), measured.form, across=across)
    with stage(progress, "contacts") as step:
        found = compare(model, measured, friction_frames=friction_frames, progress=step)
    summary = summary_of(found, sensor.name)
    return Validation(found, summary, sensor, write_validation(out, found, sensor.description, summary))
