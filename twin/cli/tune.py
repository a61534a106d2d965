"""``twin tune``: parameters of the pin detection, found from a user's own frames."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Sensor

HELP = """Find mask, crop, threshold and blob parameters for your own frames.

It uses nothing of the sensor but the layout of its pins (count, rings, round or hexagon). Give some frames, in contact or not, as
they come from the camera, or as a recorder thresholded them (then there is no crop, and the threshold hardly matters).

\b
Prints how sure it is: in how many frames all pins are found, by how many gray levels the
threshold may move, and what speaks against it.
Writes a file for 'twin robustness --pipeline' and 'twin check --pipeline'; its [blob] section is what
[pipeline.raw] (or [pipeline.recording]) of a sensor's specification takes.

\b
Example:
  twin tune --sensor ur5-331 --frames recordings/mine --out mine.toml
"""


@app.command("tune", help=HELP)
def tune_command(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="folder of frames, video or recording")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.toml", help="the file to write")] = None,
    method: Annotated[
        Literal["twin", "legacy", "adaptive", "fixed", "simple", "log", "dog", "doh"], typer.Option("--method", help="whose parameters")
    ] = "twin",
    form: FormOrAuto = None,
    limit: Annotated[int, typer.Option("--limit", min=1, metavar="N", help="at most N frames, evenly spread")] = 12,
) -> None:
    from scenes import load_sensor
    from twin.cli.output import tell
    from twin.cli.progress import shown
    from twin.detectors.tune_files import tune_on_frames

    with shown() as progress:
        found = tune_on_frames(frames, load_sensor(sensor), out=out, method=method, form=form, limit=limit, progress=progress)
    tell(found)
