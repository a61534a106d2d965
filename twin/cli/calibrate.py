"""``twin calibrate``: a specification fitted to frames of a real sensor."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import CORES, Across, FormOrAuto, Sensor, Workers, if_given
from twin.types import FINE

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
    from twin.calibration.optics import calibrate_optics
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        found = calibrate_optics(frames, load_sensor(sensor), out, limit=limit, no_contact=no_contact, progress=progress)
    tell(found)


CONTACT_HELP = """Fit the contact of a specification to labelled frames of the real sensor on its robot.

From the no-contact frame (init_0.png) and N labelled frames: contact offset, tool point, angle offset and sign, tilt of the
surface, direction of the robot's axes in the image, friction, how far the arm gives way and turns, stiffness of the gel relative to
the skin and how much its volume yields, thickness of the skin, length of the pins. Whether each frame's move had been executed
when it was taken is found along with them, and frames that fit no story lose their weight. As many frames again, at most 20, are
kept out of the fit to state the error.

\b
Writes: SPEC.toml, to be used as --sensor SPEC.toml; beside it SPEC-contact/ with index.html (parameters with their
uncertainty and what the frames tell of them, frames with their probabilities, before and after), calibration.json and
contacts/: an interrupted run goes on where it was.

\b
It simulates about 50 + 60 N contacts, of 1 to 3 s each on one core; --workers divides that.

\b
Example:
  twin calibrate contact --sensor mg400-331 --frames recordings/my-surface --labels 20 --out my-tactip.toml
"""


@calibrate_app.command("contact", help=CONTACT_HELP)
def contact(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="labelled recording with its no-contact frame")],
    out: Annotated[Path, typer.Option("--out", metavar="SPEC.toml", help="the specification to write")],
    labels: Annotated[int, typer.Option("--labels", min=4, metavar="N", help="frames to fit to, chosen at random")] = 20,
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the choice of frames")] = 0,
    experiment: Annotated[
        str, typer.Option("--experiment", metavar="E", help="how they were recorded ('twin experiments')")
    ] = "surface-2d",
    object_: Annotated[
        str | None, typer.Option("--object", metavar="O", help="object name, specification or mesh file; the experiment's own if not given")
    ] = None,
    hold: Annotated[list[str] | None, typer.Option("--hold", metavar="KEY", help="leave this parameter as it is; may be repeated")] = None,
    workers: Workers = CORES,
    across: Across = FINE,
    form: FormOrAuto = None,
) -> None:
    from scenes import load_experiment, load_object, load_sensor
    from training.contact_calibration.run import calibrate_to_file
    from twin.cli.output import tell
    from twin.cli.progress import shown

    with shown() as progress:
        found = calibrate_to_file(
            frames,
            load_sensor(sensor),
            load_experiment(experiment),
            out,
            touched=if_given(load_object, object_),
            labels=labels,
            seed=seed,
            hold=hold or (),
            workers=workers,
            across=across,
            form=form,
            progress=progress,
        )
    tell(found)
