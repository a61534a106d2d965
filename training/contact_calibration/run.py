"""A contact calibration from a folder of frames to a page."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from training.contact_calibration.fit import fit_contact, held_out_px, simulate
from training.contact_calibration.parameters import PARAMETERS
from training.contact_calibration.report import summary_of, write_calibration
from training.contact_calibration.simulate import Setup
from training.validation.model import MeasuredFrames, measure_frames
from twin.rig.kinematics import rig_of
from twin.types import FINE, Form

MOST_HELD_OUT = 20


def calibrate_contact(
    folder: Path,
    frames: Path,
    spec: SensorSpec,
    experiment: ExperimentSpec,
    touched: ObjectSpec,
    count: int,
    seed: int,
    *,
    parameters: tuple = PARAMETERS,
    workers: int = 1,
    across: int = FINE,
    form: Form | None = None,
    progress: Callable | None = None,
) -> tuple[SensorSpec, dict, Path]:
    """Fit ``parameters`` to ``count`` random frames of a recording, and judge the result on others.

    Everything is written to ``folder``; contacts that lie there from an earlier run are not computed again.

    Returns
    -------
    SensorSpec, dict, Path
        The fitted sensor, all figures, the page.

    Raises
    ------
    FrameError
        No labels, no pins, too few frames.
    """
    measured = measure_frames(frames, spec, count + min(count, MOST_HELD_OUT), seed, form=form)
    order = np.random.default_rng(seed).permutation(len(measured))  # they come in the table's order
    fitted, held = _part(measured, np.sort(order[:count])), _part(measured, np.sort(order[count:]))
    setup = Setup(spec, experiment, touched, measured.form, across, folder / "contacts", workers, parameters)
    fit = fit_contact(setup, fitted, progress=progress)
    error = held_out_px(setup, fit, held, progress=progress) if len(held) else None
    summary = summary_of(setup, fitted, fit, error, len(held))
    pairs = ((fit.start, rig_of(spec).turn_sign), (fit.value, fit.sensor.rig.turn_sign))
    moved = np.stack([simulate(setup, fitted, [values], sign)[0] for values, sign in pairs]).swapaxes(1, 2)
    return fit.sensor, summary, write_calibration(folder, fitted, moved, fit, summary)


def _part(measured: MeasuredFrames, rows: np.ndarray) -> MeasuredFrames:
    names, labels = [measured.names[k] for k in rows], [measured.labels[k] for k in rows]
    return replace(measured, names=names, labels=labels, pins_px=measured.pins_px[rows])
