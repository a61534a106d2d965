"""``twin check``: is the sensor well?"""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Sensor

HELP = """Is the sensor well? Brightness, focus, missing pins, specks, glare, and drift from its calibration; and what to do.

Looks at a frame, a folder of frames, a video or a camera, in contact or not, and compares with what the sensor's specification
promises (the twin draws that sensor's frame). Thresholded recordings tell of pins, specks and place only. A pin or spot is
counted as steady if it is lost or there in half of the frames: give frames of several contacts.

\b
Exit code 0 if everything is good or to be watched, 2 if something is bad.

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
    from scenes import load_sensor
    from twin.cli.progress import count_bar
    from twin.detectors import load_detector
    from twin.errors import FrameError
    from twin.health import Grade, examine

    spec = load_sensor(sensor)
    detector = load_detector(pipeline) if pipeline else None
    if detector is not None and detector.method != "twin":
        raise FrameError(
            f"{pipeline}: tuned for method '{detector.method}', --pipeline takes method 'twin'; run 'twin tune' without --method"
        )
    frames = frames_of(source, spec, form, limit)
    with count_bar("frames") as progress:
        findings = examine(frames, spec, detector, progress=progress)
    for found in findings:
        print(f"{found.verdict.upper():5} {found.name:10} {found.text}")
        if found.remedy:
            print(f"      -> {found.remedy}")
    if any(found.verdict is Grade.BAD for found in findings):
        raise SystemExit(2)


def frames_of(source: str, spec, form, limit: int) -> list:
    """The next ``limit`` frames of a camera, or as many, evenly spread, of what was recorded."""
    from hardware.cameras.choose import open_camera
    from hardware.cameras.source import await_frame

    camera = open_camera(source, spec, form)
    if not camera.is_live:
        return recorded_frames(Path(source), spec, form, limit)
    with camera:
        return [await_frame(camera) for _ in range(limit)]


def recorded_frames(path: Path, spec, form, limit: int) -> list:
    """At most ``limit`` frames of whatever lies at a path, evenly spread."""
    import numpy as np

    from twin.recordings import open_recording

    recording = open_recording(path, spec, form)
    return [recording.read(int(k)) for k in np.unique(np.linspace(0, len(recording) - 1, min(limit, len(recording))).round())]
