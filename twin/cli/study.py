"""``twin study``: experiments that compare."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Out, PlainLight, ServoName, names_in, writable_folder

OBJECTS = "can,mesh-can,square,prism,tin-box"  # the Tac-VGNN paper's
study = typer.Typer(help="Experiments that compare models.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(study, name="study")

SERVO_HELP = """Follow the paper's five objects with each model, in the twin, and compare.

\b
  twin study servo --model out/gnn --model out/tac-vgnn --out out/study

Writes to --out: a folder for each model and object as 'twin servo' writes it, study.csv, study.png.
"""


@study.command("servo", help=SERVO_HELP)
def servo_command(
    models: Annotated[list[Path], typer.Option("--model", metavar="RUN", help="folder of a training run; give it once for each model")],
    out: Out,
    objects: Annotated[str, typer.Option("--objects", help="names with commas between")] = OBJECTS,
    parameters: ServoName = "surface",
    steps: Annotated[int | None, typer.Option("--steps", min=1, help="for each object, instead of once around it")] = None,
    seed: Annotated[int, typer.Option("--seed", help="of the twin's noise")] = 0,
    plain_light: PlainLight = False,
) -> None:
    from hardware.servo_study import ServoStudyPlan, study_servo
    from scenes import load_object, load_servo
    from training.by_name import load_by_name
    from twin.cli.output import tell
    from twin.cli.progress import shown

    plan = ServoStudyPlan(
        models=load_by_name(models),
        objects=tuple(map(load_object, names_in(objects))),
        servo=load_servo(parameters),
        steps=steps,
        seed=seed,
        plain_light=plain_light,
    )
    with shown() as progress:
        found = study_servo(plan, writable_folder(out), progress=progress)
    tell(found)
