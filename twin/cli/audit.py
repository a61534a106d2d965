"""``twin audit``: whether a recording's labels agree with its pins."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor, writable_folder

HELP = """Find what is wrong with the labels of a flat-surface recording, from its pins and targets.csv alone.

Moves that were not executed when the frame was taken, sign errors, frames without contact, frames that fit no label,
frames that occur twice, drift along the table, and everything odd about the files. Needs pose_2, pose_6, move_1, move_6.

\b
Writes labels_corrected.csv (image_name, executed, the four labels corrected, misfit to each story, findings),
audit.json, audit.png, audit.html. Copied beside targets.csv, labels_corrected.csv is what 'twin train' corrects labels by.
"""


@app.command("audit", help=HELP)
def audit(
    data: Annotated[Path, typer.Argument(help="labelled recording")],
    sensor: Sensor,
    out: Out,
    form: FormOrAuto = None,
) -> None:
    from scenes import load_sensor
    from training.audit import audit_labels
    from training.audit_page import summary_of, write_audit
    from training.dataset import load_dataset
    from twin.cli.progress import count_bar

    with count_bar("frames") as progress:
        found = load_dataset(data, load_sensor(sensor), "surface-2d-shear", form=form, progress=progress)
    made = audit_labels(found.pins, *found.targets.raw.T)
    summary = summary_of(made, found)
    writable_folder(out)
    undone = summary["moves_not_executed"]
    print(f"{len(found)} frames; in {undone['frames']} the move was not executed; {summary['undecided']} undecided")
    for key in ("no_contact", "wrong_sign", "fit_no_story", "same_pins_as_an_earlier_frame", "reader"):
        if summary[key]:
            print(f"{key.replace('_', ' ')}: {len(summary[key])} ({', '.join(summary[key][:3])}{', ...' if len(summary[key]) > 3 else ''})")
    print(f"depth beyond the label where not executed: {made.depth_per_move:+.4f} mm for each mm of move_1")
    print(f"row number told by the outmost pins beyond the labels: R^2 {made.drift['r2_of_row_number_beyond_labels']:.2f}")
    for path in write_audit(out, made, found, summary):
        print(f"wrote {path}")
