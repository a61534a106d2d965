"""``twin predict``: the pose in one frame."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app

HELP = """Tell the pose in a frame, or in every frame of a folder or video, with its 90 % interval.

The model carries its sensor and pipeline; a frame of another sensor is refused. A recording with a
frame without contact (init_0.png) tells where its pins are at rest.
"""


@app.command("predict", help=HELP)
def predict(
    run: Annotated[Path, typer.Argument(help="folder of a training run, or a sensor whose weights go with the package")],
    frame: Annotated[Path, typer.Argument(help="frame, folder of frames, video or recording")],
) -> None:
    from training.estimator import PoseEstimator
    from twin.recordings import open_recording

    estimator = PoseEstimator.load(run)
    recording = open_recording(frame, estimator.sensor, estimator.form)
    if recording.reference is not None and estimator.counts_from_rest:
        estimator = estimator.at_rest(recording.reference)
    for picture in recording:
        made = estimator(picture)
        if not made.valid:
            print(f"{picture.name}: not valid: {made.reason}")
            continue
        parts = [
            f"{name} {value:.3f} {unit} [{low:.3f}, {high:.3f}]"
            for name, unit, value, low, high in zip(made.names, made.units, made.value, made.low, made.high, strict=True)
        ]
        moved = "" if made.executed != made.executed else f", move executed {made.executed:.2f}"
        print(f"{picture.name}: {', '.join(parts)}{moved} ({made.ms:.1f} ms)")
    for bad in recording.failed:
        print(f"skipped {bad['image_name']}: {bad['reason']}")
