"""``twin calibrate``: a specification fitted to frames of a real sensor."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import Sensor

calibrate_app = typer.Typer(help="Fit a sensor's specification to frames of a real one.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calibrate_app, name="calibrate")

HELP = """Fit light, colours, sharpness and noise of a specification to raw frames of the real sensor.

Start from the shipped specification that is most like your sensor. The frames may show any contact: their pins are found,
the skin is fitted to them, the twin renders the same state, and its parameters are moved until both agree, by
differentiating the path tracer (LEDs, reflectances, haze) and by least squares (ring, reflections, specks, each cap's own
reflectance and outline, blur, aperture, sharpening, colour fringes, compression, noise). With --no-contact one frame without
contact fits the camera first.

\b
Writes: SPEC.toml, to be used as --sensor SPEC.toml; beside it SPEC-calibration/ with
index.html (before, after, what is left, what changed) and the stages' results: an interrupted
run goes on where it was.

\b
What frames cannot tell is held at the starting values, and named: the response curve (gamma) and the
product of LED power and exposure always, distance and focal length with no-contact frames only.

\b
Example:
  twin calibrate optics --sensor ur5-331 --frames recordings/my-tactip --out my-tactip.toml
"""


@calibrate_app.command("optics", help=HELP)
def optics(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="folder of raw frames, in contact or not")],
    out: Annotated[Path, typer.Option("--out", metavar="SPEC.toml", help="the specification to write")],
    no_contact: Annotated[
        Path | None, typer.Option("--no-contact", metavar="FRAME", help="a raw frame without contact: fits the camera")
    ] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, metavar="N", help="fit at most N frames, evenly spread")] = 6,
) -> None:
    from scenes import load_sensor
    from scenes.write import write_sensor
    from twin.calibration.report import write_page
    from twin.calibration.run import calibrate
    from twin.cli.progress import count_bar
    from twin.errors import FrameError

    if out.suffix != ".toml":
        raise FrameError(f"--out {out}: give the name of a .toml file")
    spec = load_sensor(sensor)
    folder = out.with_name(f"{out.stem}-calibration")
    folder.mkdir(parents=True, exist_ok=True)
    found = calibrate(frames, spec, folder, count_bar, limit=limit, no_contact=no_contact)
    write_sensor(out, found.spec, f"Fitted to {len(found.frames)} frames of {frames.name}, starting from {spec.name}.")
    page = write_page(folder, spec, found, frames.name)
    for note in found.notes:
        print(f"note: {note}")
    before, after = found.before, found.after
    print(f"over the disc: PSNR {before['psnr_db']:.2f} -> {after['psnr_db']:.2f} dB, SSIM {before['ssim']:.3f} -> {after['ssim']:.3f}")
    print(f"wrote {out}\nwrote {page}")
