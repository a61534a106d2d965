"""``twin robustness``: how far a sensor may degrade before its pins are lost."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import CORES, Out, Sensor, if_given, writable_folder

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
  cells/          finished work: an interrupted run goes on where it was; work from another sensor, other weights or another
                  version is not used

\b
With --frames DIR real frames take the place of rendered ones. Only conditions that act on a
frame are swept, and the truth is the pins on which several detectors agree. Raw frames are shown
on the envelope of rendered ones: how much of a sound sensor's margin has this one left? For that
rendered frames are swept too; --no-rendered leaves it out.

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
    jobs: Annotated[int, typer.Option("--jobs", min=1, metavar="N", help="processes")] = CORES,
    show: Annotated[bool, typer.Option("--list", help="list the conditions and stop")] = False,
) -> None:
    from scenes import load_sensor
    from training.studies import degradation
    from twin.cli.output import say, tell
    from twin.cli.progress import shown
    from twin.robustness.conditions import condition_lines
    from twin.robustness.plan import SweepPlan, load_plan

    if show:
        say(condition_lines())
        raise typer.Exit
    plan = degradation.Plan(
        load_sensor(sensor),
        pipelines=tuple(pipeline or degradation.PIPELINES),
        models=tuple(model or ()),
        sweep=if_given(load_plan, conditions) or SweepPlan(),
        frames=frames,
        limit=limit,
        rendered=rendered,
        jobs=jobs,
    )
    with shown() as progress:
        found = degradation.run(plan, writable_folder(out), progress=progress)
    tell(found)
