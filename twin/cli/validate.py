"""``twin validate``: the twin's pins against those of labelled real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Across, FormOrAuto, Out, Sensor, if_given, writable_folder
from twin.types import FINE

HELP = """Compare the twin's pins with those of labelled real frames.

Each frame's contact is simulated along the arm's own way, from its label and the sensor's [rig] alone ('twin calibrate
contact' fits one), and the simulated displacement is added to the recorded no-contact pins (init_0.png). Moves that
move_executed.csv or labels_corrected.csv ('twin audit') calls not executed are left out. Errors are stated apart for executed and
not executed moves, by depth, angle and shear. For some frames with an executed move they are also stated with one friction a frame.

\b
Writes index.html, frames.csv (a row a frame), validation.json.

\b
Example:
  twin validate --sensor mg400-331 --frames recordings/surface --limit 40 --out out/validate
"""


@app.command("validate", help=HELP)
def validate(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="labelled recording")],
    out: Out,
    experiment: Annotated[str, typer.Option("--experiment", metavar="E", help="how it was recorded ('twin experiments')")] = "surface-2d",
    object_: Annotated[
        str | None, typer.Option("--object", metavar="O", help="what was touched; the experiment's own if not given")
    ] = None,
    limit: Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help="N frames, chosen at random")] = None,
    friction_frames: Annotated[
        int, typer.Option("--friction-frames", min=0, metavar="N", help="frames for which their own friction is sought, 9 contacts each")
    ] = 5,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the choice of frames")] = 0,
    across: Across = FINE,
    form: FormOrAuto = None,
) -> None:
    from scenes import load_experiment, load_object, load_sensor
    from training.studies.validation import validate_contacts
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        found = validate_contacts(
            load_sensor(sensor),
            frames,
            load_experiment(experiment),
            writable_folder(out),
            touched=if_given(load_object, object_),
            limit=limit,
            friction_frames=friction_frames,
            seed=seed,
            across=across,
            form=form,
            progress=progress,
        )
    tell(found)
