"""The command ``twin convert``: records in the formats of other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from twin.cli import app, options
from twin.cli.options import load_if_named
from twin.progress import Progress

if TYPE_CHECKING:
    from twin.records import Converted

# Formats that can be written, as in ``twin.records.FORMATS``, whose import would load the pin detection.
Format = Literal["recording", "lerobot", "huggingface", "mcap"]


@app.command("convert")
def convert_command(
    sources: Annotated[list[Path], typer.Argument(metavar="SOURCE...", help="recordings, sessions, or converted records")],
    to: Annotated[Format, typer.Option(metavar="FORMAT", help="recording, lerobot, huggingface or mcap")],
    out: options.Out,
    sensor: Annotated[str | None, typer.Option(metavar="S", help="sensor for the pin detection; by default that of a source")] = None,
    task: Annotated[str, typer.Option(metavar="TEXT", help="task of the episodes; by default that of each source")] = "",
    video: Annotated[bool, typer.Option("--video", help="with lerobot: pictures as video, which loses detail")] = False,
    *,
    progress: Progress,
) -> "Converted":
    """Convert records to other tools' formats, and back.

    A SOURCE is a recording, a simulated data set, a collection, the session of 'twin live --record' or 'twin servo --record', or the output
    of this command. One contact path, or one round of a servo, is one episode.

    \b
    --to recording    pictures with targets.csv, which every command here reads
         lerobot      LeRobotDataset v3; pictures lossless (PNG), or with --video
         huggingface  pictures with metadata, for 'imagefolder' and the viewer
         mcap         a file with ROS 2 messages for each episode

    Every format contains the picture, the time, and, if the source has them, pins, pose, move, wrench, estimate and action. Pins are
    found in the pictures if the source has none and its sensor is known. docs/records.md has names, units, frames and axes.

    After an interruption the same command resumes. It also adds new sources: several rounds become one data set. Existing episodes are
    not written again.

    \b
    Examples:
      twin convert out/servo/session --to lerobot --out out/dataset
      twin convert sim/surface --to mcap --out out/bags
      twin convert recordings/mine --sensor mine.toml --to huggingface \\
          --out out/pictures
    """
    from scenes import load_sensor
    from twin.records import convert

    return convert(sources, out, to, sensor=load_if_named(load_sensor, sensor), task=task, video=video, progress=progress)
