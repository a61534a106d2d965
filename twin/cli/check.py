"""``twin check``: is the sensor well?"""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Sensor, if_given

HELP = """Is the sensor well? Brightness, focus, missing pins, specks, glare, and drift from its calibration; and what to do.

Looks at a frame, a folder of frames, a video or a camera, in contact or not, and compares with what the sensor's specification
promises (the twin draws that sensor's frame). Thresholded recordings tell of pins, specks and place only. A lost pin, or a spot,
counts as a fault of the sensor if it is so in half of the frames: give frames of several contacts.

\b
Exit code: 0 if everything is good or to be watched, 2 if something is bad.

\b
Example:
  twin check recordings/today --sensor ur5-331
  twin check 0 --sensor mine.toml
"""


@app.command("check", help=HELP)
def check(
    source: Annotated[
        str, typer.Argument(metavar="FRAME", help="image, folder of frames, video, recording, or a camera: 0, /dev/video2, http://...")
    ],
    sensor: Sensor,
    form: FormOrAuto = None,
    pipeline: Annotated[Path | None, typer.Option("--pipeline", metavar="FILE.toml", help="what 'twin tune' wrote")] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, metavar="N", help="look at most at N frames, evenly spread")] = 20,
) -> None:
    from hardware.examining import examine_sensor
    from scenes import load_sensor
    from twin.cli.output import say
    from twin.cli.progress import shown
    from twin.detectors import load_detector

    spec, detector = load_sensor(sensor), if_given(load_detector, pipeline)
    with shown() as progress:
        found = examine_sensor(source, spec, form=form, detector=detector, limit=limit, progress=progress)
    say(found.lines())
    if found.bad:
        raise SystemExit(2)
