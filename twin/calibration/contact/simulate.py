"""Simulated displacements of many contacts with many parameter values. Each is stored on disk as soon as it is computed."""

import json
from dataclasses import dataclass
from functools import lru_cache
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
from twin.workers import outcomes


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
        plans = [
            {"values": np.asarray(values).tolist(), "sign": int(sign), "pose": list(labels[row].pose), "move": list(labels[row].move)}
            for values, sign, row in jobs
        ]
        fixed = {
            "sensor": self.sensor.model_dump(mode="json"),
            "experiment": self.experiment.model_dump(mode="json"),
            "touched": self.obj.model_dump(mode="json"),
            "form": str(self.form),
            "across": self.across,
            "parameters": [parameter.name for parameter in self.parameters],
        }
        shared = inputs_digest(fixed)
        items = [Item("contact", (__name__,), [shared, plan]) for plan in plans]
        found = {k: kept["displacements_px"] for k, item in enumerate(items) if (kept := find_arrays(self.folder, item)) is not None}
        todo = [k for k in range(len(items)) if k not in found]
        text = json.dumps({"fixed": fixed, "plans": plans})
        for k, both in outcomes(_contact, text, todo, workers=self.workers, scheduler=""):
            keep_arrays(self.folder, items[k], {"displacements_px": both})
            found[k] = both
            progress(len(found), len(items))
        return np.stack([found[k] for k in range(len(items))])


def _contact(text: str, index: int) -> tuple[int, np.ndarray]:
    content = _content(text)
    plan = content["plans"][index]
    label = ArmLabel(np.array(plan["pose"]), np.array(plan["move"]))
    count = SensorSpec.model_validate(content["fixed"]["sensor"]).pins.count
    try:
        return index, np.stack(_model(text, tuple(plan["values"]), plan["sign"]).displacements_px(label))
    except (ContactError, ValidationError):
        return index, np.full((2, count, 2), np.nan)


@lru_cache(maxsize=1)
def _content(text: str) -> dict:
    return json.loads(text)


@lru_cache(maxsize=4)
def _model(text: str, values: tuple, sign: int) -> ContactModel:
    fixed = _content(text)["fixed"]
    experiment = ExperimentSpec.model_validate(fixed["experiment"])
    parameters = tuple(p for p in PARAMETERS if p.name in fixed["parameters"])
    sensor = with_quantities(SensorSpec.model_validate(fixed["sensor"]), experiment, np.array(values), sign, parameters)
    return ContactModel(sensor, experiment, ObjectSpec.model_validate(fixed["touched"]), Form(fixed["form"]), across=fixed["across"])
