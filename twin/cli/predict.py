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
    from training.studies.prediction import predict_frames
    from twin.cli.output import say

    say(predict_frames(run, frame).lines())
