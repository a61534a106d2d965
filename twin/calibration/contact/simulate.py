"""Simulated displacements of many contacts with many parameter values. Each is stored on disk as soon as it is computed."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.calibration.contact.parameters import PARAMETERS, FittedParameter, with_quantities
from twin.errors import ContactError
from twin.evaluation.labelled.model import ContactModel
from twin.progress import Step, unheard
from twin.rig.labels import ArmLabel
from twin.store import Item, find_arrays, inputs_digest, keep_arrays
from twin.types import Form
from twin.workers import in_processes


@dataclass(frozen=True)
class CalibrationSetup:
    """Settings that all contacts of a calibration have in common.

    Attributes
    ----------
    sensor : SensorSpec
        The sensor at the start of the fit.
    experiment : ExperimentSpec
        The experiment that the frames were recorded with.
    obj : ObjectSpec
    form : Form
        Form of the frames, in whose px the displacements are.
    across : int
        Elements along each side of the skin's grid.
    folder : Path
        Folder for the simulated contacts.
    workers : int
        Number of processes.
    parameters : tuple of FittedParameter
        The fitted parameters.
    """

    sensor: SensorSpec
    experiment: ExperimentSpec
    obj: ObjectSpec
    form: Form
    across: int
    folder: Path
    workers: int = 1
    parameters: tuple[FittedParameter, ...] = PARAMETERS

    def displacements(self, jobs: list[tuple], labels: list[ArmLabel], progress: Step = unheard) -> np.ndarray:
        """(J, 2, N, 2) px after tap and after move, for jobs of (values (P,), turn_sign, row of ``labels``); NaN if the contact failed."""
        shared = inputs_digest(replace(self, folder=Path(), workers=1))
        moves = [ArmLabel(label.pose, label.move) for label in labels]  # as if they had been executed
        tasks = [(k, np.asarray(values, float), int(sign), moves[row]) for k, (values, sign, row) in enumerate(jobs)]
        items = [Item("contact", (__name__,), [shared, *task[1:]]) for task in tasks]
        found = {k: kept["displacements_px"] for k, item in enumerate(items) if (kept := find_arrays(self.folder, item)) is not None}
        todo = [task for task in tasks if task[0] not in found]
        for k, both in in_processes(partial, (_contact, self), todo, processes=self.workers):
            keep_arrays(self.folder, items[k], {"displacements_px": both})
            found[k] = both
            progress(len(found), len(items))
        return np.stack([found[k] for k in range(len(items))])


def _contact(setup: CalibrationSetup, task: tuple[int, np.ndarray, int, ArmLabel]) -> tuple[int, np.ndarray]:
    number, values, sign, label = task
    try:
        return number, np.stack(_model(setup, tuple(values.tolist()), sign).displacements_px(label))
    except (ContactError, ValidationError):
        return number, np.full((2, setup.sensor.pins.count, 2), np.nan)


@lru_cache(maxsize=4)
def _model(setup: CalibrationSetup, values: tuple[float, ...], sign: int) -> ContactModel:
    sensor = with_quantities(setup.sensor, setup.experiment, np.array(values), sign, setup.parameters)
    return ContactModel(sensor, setup.experiment, setup.obj, setup.form, across=setup.across)
