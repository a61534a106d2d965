"""``twin preprocess``: the real pipeline over frames, wherever they come from."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor, writable_folder

HELP = """Find the pins in every frame of a folder, a video, an image or a recording.

Understands any folder of images, videos, and the recordings' own folders (frames_bw/ or images/ or sensor_images/ or
processed_images/ with targets.csv and metadata). init_* is the no-contact reference, not a frame. Broken frames are
listed and skipped; exit code 0 if at least one frame was good.

\b
Writes pins.npz:
  image_name (M,)    base names, in the order of targets.csv where there is one
  pins_px (M, N, 2)  (x, y) in px of the input frame, pixel centres at integers, the
                     specification's pin order; NaN where a pin has no blob of its own
  predicted_px       same shape: the motion model's guess for those pins only
  area_px2 (M, N)    Voronoi cell areas
  found (M,), valid (M,)
and summary.json (frames, exact_fraction, ms.<stage>.p50|p95|p99, parameters, failed).
"""


@app.command("preprocess", help=HELP)
def preprocess(
    path: Annotated[Path, typer.Argument(help="image, folder of frames, video or recording")],
    sensor: Sensor,
    out: Out,
    form: FormOrAuto = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="also write a picture of every frame with its pins and graph")] = False,
) -> None:
    from scenes import load_sensor
    from twin.cli.output import say
    from twin.cli.progress import shown
    from twin.preprocess.batch import preprocess_recording
    from twin.progress import stage

    spec = load_sensor(sensor)
    with shown() as progress, stage(progress, "frames") as step:
        summary = preprocess_recording(path, spec, writable_folder(out), form=form, overlay=overlay, progress=step)
    say(_lines(summary, spec.pins.count))
    say(f"wrote {out / name}" for name in ("pins.npz", "summary.json") + (("overlay",) if overlay else ()))


def _lines(summary: dict[str, Any], pins: int) -> Iterator[str]:
    """What ``summary.json`` says, for people."""
    yield (
        f"{summary['frames']} frames, all {pins} pins found in {100 * summary['exact_fraction']:.2f} %, "
        f"{summary['ms']['total']['p50']:.2f} ms per frame (median)"
    )
    yield from (f"not valid {invalid['image_name']}: {invalid['reason']}" for invalid in summary["invalid"])
    yield from (f"note: {problem}" for problem in summary["problems"])
    yield from (f"skipped {failed['image_name']}: {failed['reason']}" for failed in summary["failed"])
