"""Study: how far may a sensor degrade before pipelines lose its pins, and what do trained models estimate then?"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from scenes import SensorSpec
from twin.camera.capture import in_form
from twin.evaluation.degradation.envelope import Envelope, evaluate_sweep
from twin.evaluation.degradation.report import REPORT_FILES, write_report
from twin.evaluation.degradation.shots import CONTACTS, RealSource, RenderedSource
from twin.evaluation.degradation.study import SweepPlan, check_pipelines, choose_pipelines, real_settings
from twin.evaluation.degradation.sweep import SweepSettings
from twin.progress import Progress, silent, stage
from twin.store import writes
from twin.types import Form, ReadableResult

if TYPE_CHECKING:
    from training.estimate.estimator import PoseEstimator  # loads torch, which pipelines alone do not need

# Pipelines that are evaluated if none are named.
PIPELINES = ("twin", "legacy")
# Most real frames that are evaluated if no other number is given.
LIMIT = 12


@dataclass(frozen=True)
class DegradationPlan:
    """What is degraded, and which pipelines and models are evaluated.

    Attributes
    ----------
    sensor : SensorSpec
    pipelines : tuple of str
        Methods, files of 'twin tune', or functions of yours as ``FILE.py:FUNCTION`` (``twin.pins.detectors.detector_spec``).
    models : tuple of Path
        Folders of runs.
    sweep : SweepPlan
        The conditions and their severities.
    frames : Path or None
        Real frames instead of rendered ones.
    limit : int
        Most real frames that are used; they are spread evenly over the recording.
    rendered : bool
        Also sweep rendered frames, to show them beside raw real ones.
    jobs : int
        Number of processes.
    """

    sensor: SensorSpec
    pipelines: tuple[str, ...] = PIPELINES
    models: tuple[Path, ...] = ()
    sweep: SweepPlan = field(default_factory=SweepPlan)
    frames: Path | None = None
    limit: int = LIMIT
    rendered: bool = True
    jobs: int = 1


@dataclass(frozen=True, repr=False)
class DegradationResult(ReadableResult):
    """The severities at which each pipeline and model fails under each condition, and the files, the page first."""

    envelopes: list[Envelope]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text, sorted by pipeline; the condition with the narrowest envelope comes first."""
        found = sorted(self.envelopes, key=lambda each: (each.pipeline, each.width))
        return [f"{e.pipeline:10} {e.case.name:18} {e.label}{f' ({e.measure})' if e.measure else ''}" for e in found]


@writes(*REPORT_FILES, "cells", "pictures", "pipelines", "rendered")
def run(plan: DegradationPlan, out: Path, *, progress: Progress = silent) -> DegradationResult:
    """Sweep every condition from severity 0 to 1, evaluate pipelines and models on every frame, and write the result.

    The folder ``out`` must exist. Results of an earlier call there are used again if their inputs have not changed. Of real frames only
    the image-level conditions are swept. If they are raw, rendered frames are also swept (in ``out/rendered``), and both are compared.

    Raises
    ------
    TwinError
        A pipeline or model does not exist, two have the same name, or no condition can be applied to the frames.
    """
    pipelines, runs, rendered = list(plan.pipelines), plan.models, RenderedSource(plan.sensor, CONTACTS)
    check_pipelines(pipelines, tuple(each.name for each in runs))
    settings = SweepSettings(rendered, (), plan.sweep.cases(), plan.sweep.severities())
    if runs:
        from training.estimate.estimator import digest_of

        load_models(runs, plan.sensor)  # each worker process loads its own; loading here reports an error once, before the work starts
        models, digests = partial(load_models, runs, plan.sensor), {each.name: digest_of(each) for each in runs}
        settings = replace(settings, models=models, model_digests=digests)
    source, notes, beside = "rendered", list[str](), None
    if plan.frames is None:
        with stage(progress, "contacts, undegraded"):
            frames = [shot.frame for shot in rendered.render(settings.cases[0], 0.0)]
        with stage(progress, "tuning") as step:
            settings = replace(settings, detectors=choose_pipelines(pipelines, plan.sensor, frames, out / "pipelines", step))
    else:
        settings, notes = real_settings(settings, pipelines, plan.frames, plan.limit, out / "pipelines", progress=progress)
        source = plan.frames.name
    with stage(progress, "conditions x steps") as step:
        judged = evaluate_sweep(settings, out, jobs=plan.jobs, progress=step)
    if plan.frames is not None and plan.rendered and settings.source.form == Form.RAW:
        with stage(progress, "the same, rendered") as step:
            beside = evaluate_sweep(replace(settings, source=rendered), out / "rendered", jobs=plan.jobs, progress=step)
    return DegradationResult(judged.envelopes, write_report(out, judged, source=source, notes=notes, rendered=beside))


def load_models(
    runs: tuple[Path, ...], sensor: SensorSpec, source: RenderedSource | RealSource | None = None
) -> dict[str, "PoseEstimator"]:
    """Models by name.

    Models that use a frame without contact take that of the ``source``; without one, its contacts determine the pins at rest.
    """
    from training.estimate.estimator import PoseEstimator

    found = {run.name: PoseEstimator.load(run) for run in runs}
    for estimator in found.values():
        estimator.check(sensor, estimator.form)
    return found if source is None else {name: _at_rest(estimator, source) for name, estimator in found.items()}


def _at_rest(estimator: "PoseEstimator", source: RenderedSource | RealSource) -> "PoseEstimator":
    if not estimator.counts_from_rest:
        return estimator
    recording, rest = source.spec.recording, source.rest_frame
    if rest is not None:
        return estimator.at_rest(in_form(rest, estimator.form, recording))
    assert isinstance(source, RealSource)
    return estimator.at_rest_of(in_form(frame, estimator.form, recording) for frame in source.frames)[0]
