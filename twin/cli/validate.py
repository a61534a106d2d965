"""``twin validate``: the twin's pins against those of labelled real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Across, FormOrAuto, Out, Sensor, writable_folder
from twin.types import FINE

HELP = """Compare the twin's pins with those of labelled real frames.

Each frame's contact is simulated along the arm's own way, from its label and the sensor's [rig] alone ('twin calibrate
contact' fits one), and the simulated displacement is added to the recorded no-contact pins (init_0.png). Moves that
move_executed.csv or labels_corrected.csv ('twin audit') calls not executed are left out. Stated apart for executed and not
executed moves, by depth, angle and shear; and, for some frames with an executed move, with one friction a frame.

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
    from training.validation import ContactModel, compare, measure_frames
    from training.validation.report import summary_of, write_validation
    from twin.cli.progress import rate_bar

    spec, plan = load_sensor(sensor), load_experiment(experiment)
    touched = load_object(object_ or plan.object)
    writable_folder(out)
    with rate_bar("pins") as progress:
        measured = measure_frames(frames, spec, limit, seed, form=form, progress=progress)
    model = ContactModel(spec, plan, touched, measured.form, across=across)
    with rate_bar("contacts") as progress:
        found = compare(model, measured, friction_frames=friction_frames, progress=progress)
    summary = summary_of(found, spec)
    if spec.rig is None:
        print(f"note: {spec.name} has no [rig]: the tool point counts as the tip; 'twin calibrate contact' fits one")
    for row in summary["table"]:
        print(f"{row['group']}: {row['error_px']:.2f} px over {row['frames']} frames, nothing free")
    if own := summary["one_friction_a_frame"]:
        print(f"one friction a frame, {own['frames']} frames: {own['error_px']:.2f} px (common friction: ", end="")
        print(f"{own['error_with_common_friction_px']:.2f} px)")
    if found.failures:
        print(f"{len(found.failures)} contacts failed: see frames.csv")
    for path in write_validation(out, found, spec, summary):
        print(f"wrote {path}")
