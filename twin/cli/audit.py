"""``twin audit``: whether a recording's labels agree with its pins."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor, writable_folder

HELP = """Find what is wrong with the labels of a flat-surface recording, from its pins and targets.csv alone.

It looks for moves that were not executed when the frame was taken, sign errors, frames without contact, frames that fit no label,
frames that occur twice, drift along the table, and anything odd about the files. It needs pose_2, pose_6, move_1, move_6.

\b
Writes labels_corrected.csv (image_name, executed, the four labels corrected, misfit to each story, findings),
audit.json, audit.png, audit.html. Copy labels_corrected.csv beside targets.csv, and 'twin train' corrects the labels by it.
"""


@app.command("audit", help=HELP)
def audit(
    data: Annotated[Path, typer.Argument(help="labelled recording")],
    sensor: Sensor,
    out: Out,
    form: FormOrAuto = None,
) -> None:
    from scenes import load_sensor
    from training.studies.label_audit import audit_recording
    from twin.cli.output import tell
    from twin.cli.progress import shown

    spec = load_sensor(sensor)
    with shown() as progress:
        found = audit_recording(data, spec, writable_folder(out), form=form, progress=progress)
    tell(found)
