"""Compares models by following the surfaces of several objects."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hardware.servo.following import Followed, FollowPlan, follow
from hardware.servo.trajectory import comparison_figure
from scenes import ObjectSpec, ServoSpec
from twin.errors import StoreError, TwinError
from twin.estimate import SensorModel
from twin.progress import Progress, silent
from twin.report.charts import save_figure
from twin.report.table import write_rows
from twin.store import writes
from twin.types import ReadableResult

# Measures that are printed, with their headings.
SHOWN = {
    "smoothness": "S",
    "local_smoothness": "local S",
    "path_error_mm": "path mm",
    "depth_error_mm": "depth mm",
    "angle_error_deg": "angle deg",
    "completed": "completed",
    "lost_contacts": "lost",
}


@dataclass(frozen=True)
class ServoStudyPlan:
    """Models, objects and settings of the comparison.

    Attributes
    ----------
    models : mapping of str to SensorModel
        The keys are the models' names in the results.
    objects : tuple of ObjectSpec
    servo : ServoSpec
    steps : int or None
        Number of steps for each object. None: once around the object.
    seed : int
        Seed of the twin's noise.
    plain_light : bool
        See ``build_rig``.
    """

    models: Mapping[str, SensorModel]
    objects: tuple[ObjectSpec, ...]
    servo: ServoSpec
    steps: int | None = None
    seed: int = 0
    plain_light: bool = False


@dataclass(frozen=True, repr=False)
class ServoStudy(ReadableResult):
    """The result of ``study_servo``.

    Attributes
    ----------
    found : dict
        For each model and object: the run, or the reason why it did not make a single step.
    written : list of Path
    """

    found: dict[tuple[str, str], Followed | str]
    written: list[Path]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """``model``, ``object``, every measure and ``failure`` of each run that made a step."""
        return [
            {"model": model, "object": name, **asdict(run.measures), "failure": run.failure}
            for (model, name), run in self.found.items()
            if isinstance(run, Followed)
        ]

    def lines(self) -> list[str]:
        """The comparison as a table in plain text."""
        wide = max((len(model) for model, _ in self.found), default=0)
        lines = [f"{'model':{wide}} {'object':10}" + "".join(f"{head:>11}" for head in SHOWN.values())]
        for (model, name), run in self.found.items():
            lines.append(f"{model:{wide}} {name:10}{f'  failed: {run}' if isinstance(run, str) else _cells(run)}")
        return lines


@writes("study.csv", "study.png")
def study_servo(plan: ServoStudyPlan, out: Path, *, progress: Progress = silent) -> ServoStudy:
    """Follow each object with each model in the twin, and write each run and the comparison to ``out``.

    It writes a folder for each model and object as ``follow`` does, ``study.csv`` and ``study.png``. A run that can't make a single step
    is also a result of the study.

    Raises
    ------
    StoreError
        A run can't be written.
    TwinError
        No run made a step.
    """
    found: dict[tuple[str, str], Followed | str] = {}
    for label, model in plan.models.items():
        for obj in plan.objects:
            run_plan = FollowPlan(obj, plan.servo, steps=plan.steps, seed=plan.seed, plain_light=plan.plain_light)
            folder = out / folder_name(label) / obj.name
            try:
                followed = follow(run_plan, model, folder, about={"model": label})
                assert isinstance(followed, Followed)
                found[label, obj.name] = followed
            except StoreError:
                raise
            except TwinError as error:
                found[label, obj.name] = str(error)
            progress("objects followed", len(found), len(plan.models) * len(plan.objects))
    reasons = [said for said in found.values() if isinstance(said, str)]
    if reasons and len(reasons) == len(found):
        raise TwinError(f"none of {len(found)} runs made a step; the first: {reasons[0]}")
    made = ServoStudy(found, [])
    made.written.append(write_rows(out / "study.csv", made.rows))
    pictures = [(*key, run.path, run.outline_mm) for key, run in found.items() if isinstance(run, Followed)]
    if pictures:
        made.written.append(save_figure(out / "study.png", comparison_figure(pictures)))
    return made


def folder_name(label: str) -> str:
    """A model's name as a valid name of a folder: one part of a path, and never the parent folder."""
    return re.sub(r"^\.+|[^\w.-]+", "_", label) or "_"


def _cells(run: Followed) -> str:
    measures = asdict(run.measures)
    cells = (f"{measures[key]:>11.0%}" if key == "completed" else f"{measures[key]:>11.4g}" for key in SHOWN)
    return "".join(cells) + (f"  ended early: {run.failure}" if run.failure else "")
