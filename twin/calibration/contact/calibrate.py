"""Contact calibration from a folder of frames, with a page as its result."""

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenes import load_object
from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.calibration.contact.fit import PARAMETERS, CalibrationSetup, before_and_after, fit_contact, held_out_px
from twin.calibration.contact.forces import FILES, FORCE_PARAMETERS, ForceComparison, ForceSetup, compare_table, is_table
from twin.calibration.contact.newtons import MOST_PRESSES, Newtons, assume_stiffness, compare_forces, pressed_n
from twin.calibration.contact.report import summary_of, write_calibration
from twin.calibration.sensor_file import sibling_folder, write_sensor
from twin.errors import OptionError
from twin.evaluation.labelled.model import MeasuredFrames, measure_frames
from twin.frames import open_recording
from twin.progress import Progress, silent, stage
from twin.rig.kinematics import rig_of
from twin.rig.labels import read_arm_labels
from twin.store import output, writes_file
from twin.types import FINE, Form, ReadableResult

LABELS = 20
"""Number of frames to which the contact is fitted."""
MOST_HELD_OUT = 20
"""Most frames that are kept out of the fit. The report states the error on them."""


def scale_forces(
    frames: Path, sensor: SensorSpec, experiment: ExperimentSpec, obj: ObjectSpec, seed: int, *, across: int, form: Form | None = None
) -> Newtons:
    """The scale of a sensor's forces, from all frames of a recording with a measured force, ``MOST_PRESSES`` at most.

    The contact should be fitted before. Forces are in N along the approach. They come from the rig's force sensor (``rig.force_sensor``) if
    the specification has one, else from the column ``Fz``.
    """
    recording = open_recording(frames, sensor, form)
    measured = pressed_n(recording, sensor, experiment)
    rows = np.flatnonzero(np.isfinite(measured))
    if not len(rows):
        return assume_stiffness(sensor, "none was measured")
    labels = read_arm_labels(recording)
    rows = np.sort(np.random.default_rng([seed, 6]).permutation(rows)[:MOST_PRESSES])
    setup = ForceSetup(sensor, experiment, obj, across, parameters=())
    return compare_forces(measured[rows], setup.forces([setup.start], [labels[row] for row in rows])[0, :, 2], sensor)


def _part(measured: MeasuredFrames, rows: np.ndarray) -> MeasuredFrames:
    """Some of the frames."""
    names, labels = [measured.names[k] for k in rows], [measured.labels[k] for k in rows]
    return replace(measured, names=names, labels=labels, pins_px=measured.pins_px[rows])


@dataclass(frozen=True, repr=False)
class ContactCalibration(ReadableResult):
    """A fitted contact and its files.

    Attributes
    ----------
    sensor : SensorSpec
        The specification with the fitted parameters.
    summary : dict
        Content of ``calibration.json``.
    written : list of Path
        The specification, then the page.
    """

    sensor: SensorSpec
    summary: dict[str, Any]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text: the parameters with their uncertainty, and the errors before and after."""
        lines = [f"note: {problem}" for problem in self.summary["problems"]]
        for p in self.summary["parameters"]:
            doubt = "" if p["known"] else "  (these frames do not determine it)"
            lines.append(f"{p['name']:26s} {p['start']:9.4g} -> {p['value']:9.4g} +- {p['sd']:.2g}{doubt}")
        for title, key in (("fitted frames", "fitted_px"), ("held-out frames", "held_out_px")):
            if part := self.summary[key]:
                lines.append(f"{title}: {part['before']:.2f} -> {part['after']:.2f} px over {part['frames']}")
        lines.append(self.summary["newtons"]["explanation"])
        lines += self.summary["warnings"]
        if self.summary["distrusted"]:
            lines.append(f"labels not trusted: {', '.join(self.summary['distrusted'])}")
        return lines


@writes_file(".*.csv", ".*.uri")
def calibrate_to_file(
    frames: Path,
    sensor: SensorSpec,
    experiment: ExperimentSpec,
    out: Path,
    *,
    obj: ObjectSpec | None = None,
    labels: int = LABELS,
    seed: int = 0,
    hold: Collection[str] = (),
    workers: int = 1,
    across: int = FINE,
    form: Form | None = None,
    columns: Mapping[str, str] | None = None,
    progress: Progress = silent,
) -> ContactCalibration | ForceComparison:
    """Fit the contact of a specification to labelled frames, and write it.

    The folder ``NAME-contact`` beside the specification holds the page and the simulated contacts, so that an interrupted run can be
    continued.

    Parameters
    ----------
    frames : Path
        A labelled recording with its no-contact frame, or a table of poses and forces alone (``.csv``): parameters on which forces
        depend are then fitted to ``labels`` of its rows, and evaluated on all others (see ``twin.calibration.contact.forces``).
    out : Path
        The ``.toml`` file to write.
    obj : ObjectSpec, optional
        The object; the experiment's own by default.
    labels : int
        Number of frames to fit to; they are chosen at random.
    seed : int
        Seed of this choice.
    hold : collection of str
        Names of parameters that are not fitted.
    columns : mapping of str to str, optional
        A table's own names of columns, by those that are used here (``pose_3``, ``move_1``, ``Fz``, ...), with a minus sign or a factor
        before them for another direction or unit (``-height``, ``0.001*Fz_mN``).

    Raises
    ------
    FrameError
        There are no labels, no pins or too few frames, a parameter is unknown, or ``out`` is not the name of a ``.toml`` file.
    """
    names = [parameter.name for parameter in (*PARAMETERS, *FORCE_PARAMETERS)]
    if unknown := set(hold) - set(names):
        raise OptionError(f"`hold` {', '.join(sorted(unknown))}: no such parameter; known: {', '.join(sorted(names))}")
    folder = sibling_folder(out, "contact")
    of_pins, of_forces = (tuple(each for each in every if each.name not in hold) for every in (PARAMETERS, FORCE_PARAMETERS))
    obj = obj or load_object(experiment.object)
    if is_table(frames):
        table = ForceSetup(sensor, experiment, obj, across, workers=workers, parameters=of_forces)
        with output(folder, *FILES):
            forces = compare_table(frames, table, folder, columns, labels, seed, progress)
        write_sensor(out, forces.sensor, "\n".join([f"Contact fitted to {frames.name}, starting from {sensor.name}.", *forces.lines()]))
        return replace(forces, written=[out, *forces.written])
    with output(folder, "index.html", "calibration.json", "*.png", "contacts"), stage(progress, "contacts") as step:
        measured = measure_frames(frames, sensor, labels + min(labels, MOST_HELD_OUT), seed, experiment=experiment, form=form)
        order = np.random.default_rng(seed).permutation(len(measured))  # the frames come in the order of the recording's table
        fitted, held = _part(measured, np.sort(order[:labels])), _part(measured, np.sort(order[labels:]))
        spec = sensor.alter(rig=rig_of(sensor, obj.name))
        setup = CalibrationSetup(spec, experiment, obj, across, measured.form, folder / "contacts", workers=workers, parameters=of_pins)
        fit = fit_contact(setup, fitted, progress=step)
        error = held_out_px(setup, fit, held, progress=step) if len(held) else None
        newtons = scale_forces(frames, fit.sensor, experiment, obj, seed, across=across, form=form)
        summary = summary_of(setup, fitted, fit, error, len(held)) | {"newtons": asdict(newtons)}
        moved = before_and_after(setup, fit, fitted).swapaxes(1, 2)
        page = write_calibration(folder, replace(fitted, no_contact_px=fit.rest_px), moved, fit, summary)
    found = newtons.of(fit.sensor)
    text = f"Contact fitted to {summary['fitted_px']['frames']} frames of {frames.name}, starting from {sensor.name}."
    write_sensor(out, found, "\n".join([text, summary["newtons"]["explanation"], *summary["warnings"]]))
    return ContactCalibration(found, summary, [out, page])
