"""What a robustness study sweeps: its file (conditions, their ranges, steps, pairs of conditions), its pipelines, and real frames for it.

The true places of the pins in real frames are unknown. The places on which several detectors agree are used instead.
"""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from scenes.base import Section, SpecError
from scenes.load import read_section
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs, FrameError, OptionError, TwinError, format_count
from twin.evaluation.degradation.condition import Condition, DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS, condition
from twin.evaluation.degradation.shots import RealSource
from twin.evaluation.degradation.sweep import SEVERITIES, SweepSettings
from twin.frames import evenly_read, open_recording
from twin.pins import METHODS, DetectorSpec, load_detector, make_detector, shipped_detector, write_detector
from twin.pins.detectors.detector_spec import OWN, is_own, own_detector, own_name, own_places
from twin.pins.detectors.tune import tune
from twin.progress import Progress, Step, report_each, silent, stage
from twin.store import Item, inputs_digest
from twin.types import Form, Frame

AGREE = 0.15
"""Distance of two detectors' places, as a share of the pins' median spacing, below which they agree on a pin. Chosen."""
LEAST_KNOWN = 0.97
"""Smallest fraction of a frame's pins on which detectors must agree. Frames with a smaller fraction are refused."""
LEAST_AGREEING = 2
"""Number of detectors that must agree on a pin."""


class ConditionPlan(Section):
    """One condition of a sweep.

    Attributes
    ----------
    name : str
        Name of a condition; ``twin robustness --list`` lists all of them.
    severe : float, optional
        Value at severity 1, in the unit of the condition's parameter. The default is the condition's own value, which is the most severe
        one.
    """

    name: str
    severe: float | None = None

    def condition(self) -> Condition:
        """The condition with its range.

        Raises
        ------
        TwinError
            The condition is unknown, or the range is not within its own range.
        """
        known = condition(self.name)
        if self.severe is None:
            return known
        if not 0 < (self.severe - known.nominal) / (known.severe - known.nominal) <= 1:
            raise TwinError(
                f"{self.name}: severe = {self.severe:g} is not between {known.nominal:g} (where nothing is degraded) and"
                f" {known.severe:g} {known.unit}".rstrip()
            )
        return replace(known, severe=self.severe)


class SweepPlan(Section):
    """A user's sweep.

    Attributes
    ----------
    steps : tuple of float
        Increasing severities between 0 and 1 (0 is always included). The defaults have smaller steps at small severities.
    condition : tuple of ConditionPlan
        The conditions to sweep; if empty, all of them.
    pairs : tuple of (str, str)
        Pairs of names. Both conditions of a pair act together, with the same severity.
    """

    steps: Annotated[tuple[Annotated[float, Field(gt=0, le=1)], ...], Field(min_length=1)] = SEVERITIES[1:]
    condition: tuple[ConditionPlan, ...] = ()
    pairs: tuple[tuple[str, str], ...] = ()

    def severities(self) -> tuple[float, ...]:
        """All severities, from 0 upwards."""
        return (0.0, *sorted(set(self.steps)))

    def cases(self) -> tuple[DegradedCase, ...]:
        """Single conditions, then pairs.

        Raises
        ------
        TwinError
            A condition is unknown, has an impossible range, or is named twice.
        """
        asked = self.condition or (() if self.pairs else tuple(ConditionPlan(name=name) for name in CONDITIONS))
        named = {each.name: each.condition() for each in asked}
        singles = tuple(DegradedCase((named[each.name],)) for each in asked)
        pairs = tuple(DegradedCase(tuple(named.get(name) or condition(name) for name in pair)) for pair in self.pairs)
        cases = Counter("+".join(sorted(c.name for c in case.conditions)) for case in singles + pairs)
        if twice := [name for name, count in cases.items() if count > 1]:
            raise TwinError(f"named twice: {', '.join(twice)}; name each condition and each pair once")
        if alone := [a for a, b in self.pairs if a == b]:
            raise TwinError(f"a pair needs two conditions, got {alone[0]} with itself")
        return singles + pairs


def load_plan(path: Path) -> SweepPlan:
    """Read a sweep's file.

    Raises
    ------
    TwinError
        The file can't be read, or a key or name is unknown.
    """
    with ErrorsAs(SpecError, lambda error: TwinError(f"{error}; 'twin robustness --help' shows such a file")):
        return read_section(path, SweepPlan)


def real_settings(
    settings: SweepSettings, pipelines: list[str], path: Path, limit: int, folder: Path, *, progress: Progress = silent
) -> tuple[SweepSettings, list[str]]:
    """Settings for at most ``limit`` real frames at a path, and remarks. Only conditions that can be applied to these frames remain.

    Raises
    ------
    TwinError
        None of the conditions can be applied.
    """
    spec, cases = settings.source.spec, settings.cases
    recording = open_recording(path, spec)
    frames = evenly_read(recording, limit)
    with stage(progress, "tuning") as step:
        detectors = choose_pipelines(pipelines, spec, frames, folder, step)
        judges = choose_pipelines(["twin", "adaptive"], spec, frames, folder, step)
    built_in = [each for each in detectors if each.method != OWN]  # what is evaluated must not say what is true
    source, notes = consensus(spec, frames, list(dict.fromkeys((*built_in, *judges))))
    notes += recording.notes()
    usable = tuple(case for case in cases if case.image_level and (recording.form == Form.RAW or not case.in_light))
    if not usable:
        raise TwinError("none of the conditions can be applied to frames that are already there; without `frames` they are rendered")
    if left := [c.name for c in cases if c not in usable]:
        notes.append(f"left out, because they cannot be applied to frames that are already there: {', '.join(left)}")
    return replace(settings, source=replace(source, rest_frame=recording.reference), detectors=detectors, cases=usable), notes


def check_pipelines(names: list[str], models: tuple[str, ...] = ()) -> None:
    """Check names before any work is done.

    Parameters
    ----------
    names : list of str
        Methods, files of detectors, or functions of the user (``FILE.py:FUNCTION``).
    models : tuple of str
        Names of the models, whose rows are in the same tables as those of the pipelines.

    Raises
    ------
    TwinError
        A name is neither a method nor a readable file or function, or two names are the same.
    """
    for name in names:
        if name not in METHODS and Path(name).suffix != ".toml" and not is_own(name):
            raise OptionError(
                f"`pipeline` {name}: give one of {', '.join(METHODS)}, a .toml file written by 'twin tune', or a function of yours as "
                "FILE.py:FUNCTION"
            )
    called = [own_name(name) if is_own(name) else name if name in METHODS else load_detector(Path(name)).name for name in names]
    if len(set(called)) < len(called):
        raise OptionError(f"`pipeline`: each needs a name of its own, got {', '.join(called)}; rename the files or functions")
    if len({*called, *models}) < len(called) + len(models):
        raise OptionError(f"`model`: each needs a name of its own, got {', '.join((*called, *models))}; rename the runs' folders")


def choose_pipelines(names: list[str], spec: SensorSpec, frames: list[Frame], folder: Path, progress: Step) -> tuple[DetectorSpec, ...]:
    """Detectors by file, by method or by function. Ours is that of the specification; others are tuned on undegraded frames and stored in
    ``folder``.

    Raises
    ------
    TwinError
        A file cannot be read (`check_pipelines` finds this before any work is done), or a function fails on the first undegraded frame.
    """
    chosen, inputs = [], inputs_digest(spec, [frame.image for frame in frames])
    progress(0, len(names))
    for name in report_each(names, progress):
        method = next((known for known in METHODS if known == name), None)
        if is_own(name):
            chosen.append(_check_detector(own_detector(name, spec, frames[0].form), frames[0]))
        elif method is None:
            chosen.append(load_detector(Path(name)))
        elif method == "twin":
            chosen.append(shipped_detector(spec, frames[0].form))
        else:
            item = Item(f"{method}-{spec.name}", (tune,), [method, inputs])
            kept = folder / f"{item.file}.toml"
            if not kept.is_file():
                folder.mkdir(parents=True, exist_ok=True)
                tuned = tune(frames, spec, method).detector
                write_detector(kept, tuned, f"Tuned on undegraded frames.\nmade_by = {json.dumps(item.made_by)}")
            chosen.append(load_detector(kept).alter(name=method))
    return tuple(chosen)


def _check_detector(detector: DetectorSpec, frame: Frame) -> DetectorSpec:
    """A detector whose function works on an undegraded frame. On degraded frames its failure is a result."""
    with ErrorsAs(FrameError, lambda error: OptionError(f"`pipeline` {detector.finder}, on the undegraded frame {frame.name}: {error}")):
        own_places(detector, frame)
    return detector


def consensus(spec: SensorSpec, frames: list[Frame], detectors: list[DetectorSpec]) -> tuple[RealSource, list[str]]:
    """Frames in which at least two detectors find the pins at the same places, and the reasons why other frames were refused.

    Raises
    ------
    FrameError
        No frame is left.
    """
    finders = [make_detector(spec, detector) for detector in detectors]
    kept, truth, refused = [], [], []
    for frame in frames:
        seen = np.stack([found.pins_px for found in (find(frame) for find in finders) if found.pins_px is not None])
        pitch = np.nanmedian(np.sort(np.linalg.norm(seen[0][:, None] - seen[0][None], axis=2), axis=1)[:, 1])
        known = (np.linalg.norm(seen - seen[0], axis=2) < AGREE * pitch).sum(axis=0) >= LEAST_AGREEING
        if known.mean() < LEAST_KNOWN:
            refused.append(f"{frame.name}: the detectors agree on {int(known.sum())} of {len(known)} pins only")
            continue
        kept.append(frame)
        truth.append(np.where(known[:, None], seen[0], np.nan))
    if not kept:
        raise FrameError(
            f"none of {format_count(len(frames), 'frames')} is good enough to start from; the first: {refused[0]}; "
            "try 'twin tune', then 'twin check'"
        )
    return RealSource(spec, tuple(kept), np.stack(truth)), refused
