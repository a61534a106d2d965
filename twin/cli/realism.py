"""``twin realism``: how close the renders of a sensor come to its real frames."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Out, Quality, Sensor, writable_folder

HELP = """Compare a folder of real raw frames with their renders, pair by pair and as two sets.

Each real frame's pins are found, the skin is fitted to them, and the sensor in that state is rendered and captured. Every
cap stands where it stood in the real frame, so what differs is camera and light. With --pose-aligned the whole twin is
judged as well: the labels in targets.csv (pose_3 depth in mm, pose_4 and pose_5 turns in deg, a tap on a flat plate) become
contacts. The arm's kinematics is fitted to the pins of one half of the frames, and the error is stated on the other half.

\b
Reads: a folder of raw colour or gray frames of one size (images/ with targets.csv, or any folder).
Frames that are black, saturated, of another size or without all their pins are
refused by name; exit code 0 if at least one frame was good.

\b
Writes:
  index.html      pictures side by side, all figures, plots
  metrics.json    every figure: PSNR, SSIM, FLIP over the lens disc; differences by
                  radius; spots; spectra; two-sample accuracy; pin errors
  frames.csv      figures of each frame
  radial.csv      caps in 8 bins of the distance from the disc's centre
  spectrum.csv    radial power spectra
  spots.csv       bright spots that stay in place (LED reflections, bubbles)
  pictures/       real, rendered and difference of each frame

\b
How to read it: PSNR and SSIM of two real frames with the same contact are the best that can
be reached. Two-sample accuracy is the share of patches of unseen frames that a small network
puts into the right set: at 100 % they are always told apart, at 50 % never.

\b
Example:
  twin realism recordings/my-tactip --sensor ur5-331 --limit 10 --out out/realism
"""


@app.command("realism", help=HELP)
def realism(
    path: Annotated[Path, typer.Argument(help="folder of real raw frames")],
    sensor: Sensor,
    out: Out,
    pose_aligned: Annotated[bool, typer.Option("--pose-aligned", help="also render from the labels alone")] = False,
    limit: Annotated[int | None, typer.Option("--limit", min=1, metavar="N", help="at most N frames, evenly spread")] = None,
    quality: Annotated[Quality, typer.Option(help="samples per pixel")] = Quality.STANDARD,
    two_sample: Annotated[bool, typer.Option("--two-sample/--no-two-sample", help="train the two-sample test (minutes)")] = True,
) -> None:
    from scenes import load_sensor
    from training.studies.realism import compare_with_renders
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        found = compare_with_renders(
            path,
            load_sensor(sensor),
            writable_folder(out),
            pose_aligned=pose_aligned,
            limit=limit,
            quality=quality.value,
            test=two_sample,
            progress=progress,
        )
    tell(found)
