"""``twin robustness``: how far a sensor may degrade before its pins are lost."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Out, Sensor, writable_folder

HELP = """How far may the sensor degrade before preprocessing fails?

Sweeps each condition (dim or dead LEDs, room light, glare, defocus, motion, dirt, scratches, bubbles, haze, lost and faded
caps, torn skin, a displaced camera, noise, JPEG, lost rows, wrong settings, ...; --list names them) from nothing to severe
over a set of contacts, runs pipelines and models on every frame, and compares with where the pins truly are.

\b
Writes:
  index.html      envelope (where each pipeline fails), ranking, plots, worst frames
  envelope.csv    severity and parameter at which each measure's limit is crossed
  curves.csv      every measure against severity, with its 90 % interval
  frames.csv      every frame
  real-on-rendered.csv  with --frames: where real and rendered frames fail, and their ratio
  cells/          finished work: an interrupted run goes on where it was; what was computed from another sensor, other weights
                  or another version is not taken for it

\b
With --frames DIR real frames take the place of rendered ones: conditions that act on a frame
alone, the pins on which several detectors agree as the truth. Raw frames are shown on the
envelope of rendered ones: how much of a sound sensor's margin has this one left? That sweeps
rendered frames too; --no-rendered leaves it out.

\b
A file for --conditions:
  steps = [0.1, 0.3, 1.0]               # severities
  pairs = [["leds-dim", "noise"]]       # grow together
  [[condition]]
  name = "noise"
  severe = 0.2                          # the parameter at severity 1

\b
Examples:
  twin robustness --sensor ur5-331 --pipeline twin --pipeline legacy --out out/robustness
  twin robustness --sensor ur5-331 --frames recordings/mine --pipeline mine.toml --out out/mine
"""


@app.command("robustness", help=HELP)
def robustness(
    sensor: Sensor = "ur5-331",
    out: Out = Path("out/robustness"),
    pipeline: Annotated[
        list[str] | None,
        typer.Option("--pipeline", metavar="P", help="twin, legacy, adaptive, fixed, simple, log, dog, doh, or a file of 'twin tune'"),
    ] = None,
    model: Annotated[list[Path] | None, typer.Option("--model", metavar="RUN", help="folder of a trained model")] = None,
    conditions: Annotated[
        Path | None, typer.Option("--conditions", metavar="FILE", help="TOML file: which conditions, ranges, steps, pairs")
    ] = None,
    frames: Annotated[Path | None, typer.Option("--frames", metavar="DIR", help="real frames instead of rendered ones")] = None,
    limit: Annotated[int, typer.Option("--limit", min=2, metavar="N", help="at most N of the real frames, evenly spread")] = 12,
    rendered: Annotated[bool, typer.Option("--rendered/--no-rendered", help="raw --frames beside rendered ones")] = True,
    jobs: Annotated[int, typer.Option("--jobs", min=1, metavar="N", help="processes")] = os.cpu_count() or 1,
    show: Annotated[bool, typer.Option("--list", help="list the conditions and stop")] = False,
) -> None:
    from twin.robustness.conditions import CONDITIONS

    if show:
        for each in CONDITIONS.values():
            print(f"{each.name:18} {each.family:12} {each.title}: {each.parameter}, up to {each.severe:g} {each.unit}".rstrip())
        return
    from scenes import load_sensor
    from twin.cli.progress import count_bar
    from twin.robustness.plan import SweepPlan, load_plan
    from twin.robustness.run import check_pipelines, real_study, rendered_study

    spec, plan = load_sensor(sensor), load_plan(conditions) if conditions else SweepPlan()
    cases, names = plan.cases(), pipeline or ["twin", "legacy"]
    runs = tuple(model or ())
    check_pipelines(names, tuple(run.name for run in runs))
    writable_folder(out)
    options: dict = {"jobs": jobs}
    if runs:
        load_models(runs, spec)  # each process loads its own: what can't be is told here, and once
        options |= {"models": partial(load_models, runs, spec), "model_digests": digests_of(runs)}
    sweep = (names, cases, plan.severities(), out, count_bar)
    if frames is None:
        envelopes, written = rendered_study(spec, *sweep, **options)
    else:
        envelopes, written = real_study(spec, frames, limit, *sweep, beside=rendered, **options)
    for found in sorted(envelopes, key=lambda e: (e.pipeline, e.width)):
        print(f"{found.pipeline:10} {found.case.name:18} {found.label}{f' ({found.measure})' if found.measure else ''}")
    for file in written:
        print(f"wrote {file}")


def digests_of(runs: tuple[Path, ...]) -> dict[str, str]:
    """Digests by name of all that the models' answers depend on."""
    from training.estimator import digest_of

    return {run.name: digest_of(run) for run in runs}


def load_models(runs: tuple[Path, ...], spec) -> dict:
    """Estimators by name, as a sweep calls them: raw frames are recorded first where the model was trained on recordings."""
    from dataclasses import replace

    from training.estimator import PoseEstimator
    from twin.camera import record
    from twin.types import Form

    def ready(run):
        estimator = PoseEstimator.load(run)
        estimator.check(spec, estimator.form)

        def estimate(frame):
            if frame.form == Form.RAW and estimator.form == Form.RECORDING:
                frame = replace(frame, image=record(frame.image, spec.recording), form=Form.RECORDING)
            found = estimator(frame)
            return found.value, found.units, found.valid

        return estimate

    return {run.name: ready(run) for run in runs}
