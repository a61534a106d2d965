"""``twin tune``: parameters of the pin detection, found from a user's own frames."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Sensor

HELP = """Find mask, crop, threshold and blob parameters for your own frames.

Uses nothing of the sensor but the layout of its pins (count, rings, round or hexagon). Give some frames, in contact or not, as
they come from the camera or as a recorder thresholded them (then there is no crop, and the threshold hardly matters).

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
    from twin.cli.check import recorded_frames
    from twin.cli.progress import count_bar
    from twin.detectors import tune, write_detector
    from twin.errors import FrameError

    if out is not None and out.suffix != ".toml":
        raise FrameError(f"--out {out}: give the name of a .toml file")
    spec = load_sensor(sensor)
    chosen = recorded_frames(frames, spec, form, limit)
    with count_bar("tuning") as progress:
        found = tune(chosen, spec, method, progress=progress)
    detector, evidence = found.detector, found.detector.evidence
    blob = detector.blob
    exact, low = 100 * evidence.exact_rate, 100 * evidence.low_rate
    print(f"{evidence.sure}: all {spec.pins.count} pins in {exact:.0f} % of {evidence.frames} frames (90 % sure: at least {low:.0f} %)")
    (x, y), radius, slack = blob.mask_center_px, blob.mask_radius_px, evidence.mask_slack_px
    print(f"mask centre ({x:g}, {y:g}) px, radius {radius:g} px, {slack:g} px beyond the outermost pins")
    if recorder := detector.recording:
        print(f"crop {recorder.crop_px}, adaptive threshold {recorder.threshold_offset:g} over {recorder.threshold_block_px} px")
    else:
        over = f" over {blob.threshold_block_px} px, erosion {blob.erosion_px} px" if blob.threshold_block_px else ""
        print(f"threshold {blob.threshold:g}{over}, slack {evidence.threshold_slack:g} gray levels; least area {blob.min_area_px2:g} px2")
    for note in found.notes:
        print(f"note: {note}")
    if out is not None:
        write_detector(out, detector, f"Found by 'twin tune' from {len(chosen)} frames of {frames.name}; {evidence.sure}.")
        print(f"wrote {out}")
