"""Commands for the first steps.

- ``twin sensors``, ``twin objects``, ``twin experiments``, ``twin randomisations``: what is shipped, and where a user's own files go.
- ``twin doctor``: what this machine has, what is missing, and the remedy.
- ``twin demo``: the whole chain on the shipped specifications.
- ``twin render``: one contact, rendered, with its exact ground truth.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli import app, options
from twin.cli.options import call, print_lines
from twin.progress import Progress
from twin.types import Form, Quality

if TYPE_CHECKING:
    from hardware.live.doctor import Machine
    from twin.demo.make_demo import Demo
    from twin.one_contact import RenderedContact


@app.command("sensors")
def sensors() -> None:
    """List the sensors, and the folder for your own.

    \b
    Example:
      twin sensors
    """
    from scenes.catalog import list_all

    print_lines(list_all("sensors").lines())


@app.command("objects")
def objects() -> None:
    """List the objects, and the folder for your own.

    \b
    Example:
      twin objects
    """
    from scenes.catalog import list_all

    print_lines([*list_all("objects").lines(), "Any STL, OBJ or PLY file (in mm) is an object too: --object part.stl"])


@app.command("experiments")
def experiments() -> None:
    """List the experiments, and the folder for your own.

    An experiment defines the contacts, in the robot's coordinates.

    \b
    Example:
      twin experiments
    """
    from scenes.catalog import list_all

    print_lines(list_all("experiments").lines())


@app.command("randomisations")
def randomisations() -> None:
    """List the randomisations, and the folder for your own.

    A randomisation (domain randomisation) is the distribution of the quantities that vary between simulated frames.

    \b
    Example:
      twin randomisations
    """
    from scenes.catalog import list_all

    print_lines(list_all("randomisations").lines())


@app.command("doctor", exit_code=lambda machine: 0 if machine.can_render else 1)
def doctor(
    prepare: Annotated[bool, typer.Option("--prepare", help="first compile what commands need at their first use")] = False,
    *,
    progress: Progress,
) -> "Machine":
    """Check this machine, and list what is missing, with the remedy.

    It checks packages, Mitsuba's variants (with the one that is used, and why), LLVM, GPU, offscreen 3D, cameras and serial ports. The
    exit code is 1 if this machine cannot render. The first command compiles for about half a minute; --prepare does that ahead.

    \b
    Example:
      twin doctor
      twin doctor --prepare
    """
    from hardware.live.doctor import examine_machine

    if prepare:
        from twin.prepare import compile_ahead

        compile_ahead(progress=progress)
    return examine_machine()


@app.command("demo")
def demo(out: options.Out = Path("out/demo"), *, progress: Progress) -> "Demo":
    """Run the whole pipeline on shipped sensors, as one page.

    It presses, renders, finds pins and builds graphs for several sensors and objects. It writes pictures and a page (index.html).

    \b
    Example:
      twin demo --out out/demo
    """
    from twin.demo.make_demo import run_demo

    return run_demo(out, progress=progress)


@app.command("render")
def render_contact_command(
    sensor: options.Sensor,
    obj: options.Object,
    indent_mm: Annotated[float, typer.Option(metavar="D", help="indentation from first touch; 0: no contact")],
    out: options.Out,
    tilt_deg: Annotated[options.Pair, typer.Option(metavar="RX RY", help="turn of the object about x, then y")] = (0.0, 0.0),
    shear_mm: Annotated[options.Pair, typer.Option(metavar="X Y", help="drag after the press")] = (0.0, 0.0),
    twist_deg: Annotated[float, typer.Option(metavar="RZ", help="turn about z during the drag")] = 0.0,
    offset_mm: Annotated[options.Pair, typer.Option(metavar="X Y", help="sideways shift of the object before it approaches")] = (0.0, 0.0),
    form: Annotated[Form, typer.Option(help="the camera's frame, or the cropped and thresholded form of the recordings")] = Form.RAW,
    quality: Annotated[Quality, typer.Option(help=options.QUALITY)] = "standard",
    seed: Annotated[int, typer.Option(min=0, help="seed of the renderer and of the camera's noise")] = 0,
    *,
    progress: Progress,
) -> "RenderedContact":
    """Press an object against a sensor and render the frame.

    The pose is the OBJECT's, relative to the sensor. The image shows the sensor's x to the right and y down; z points out of
    the tip towards the object. Angles are right-handed about these axes.

    \b
            image                        side view (y towards you)
          +----------> x                        camera
          |   . . .                       ___ (       ) ___  lens
          |  . . . .                     |     gel         |
          |   . . .                       \\_             _/   skin, pins inside
          v                                  '---. .---'        O----> x
          y  (z into the page,            ========v=========    |
              towards the object)            object             v z

    \b
    --indent-mm D     object moved by D along -z, from first touch
    --tilt-deg RX RY  object first turned about x by RX, then about y by RY,
                      through the tip: RX > 0 brings the object closer where
                      y < 0, RY > 0 where x > 0
    --shear-mm X Y    then moved by X along x and Y along y (+X drags the pins
                      right, +Y drags them down)
    --twist-deg RZ    and turned about z by RZ (RZ > 0 turns the pins from x to y,
                      clockwise in the image)
    --offset-mm X Y   point of contact on the object: the object is shifted by
                      this before the approach

    \b
    Writes:
      frame.png    the frame
      frame.exr    linear light on the whole raw frame
      truth.npz    caps_mm, caps_px, rest_px, visible: one row a pin, in the
                   specification's order; positions, normals and forces of the
                   contact
      truth.json   force_n of the skin on the object in the sensor's axes (z > 0
                   when pressed), force_size_90_n (ends of the 90 % interval of
                   its size), torque_nmm about the sensor's origin, area_mm2,
                   the pose and all resolved specifications
      skin.vtp, skin.png, panel.png   the deformed skin, and an overview

    \b
    Example:
      twin render --sensor ur5-331 --object edge --indent-mm 3 --out out/edge
    """
    from twin.mechanics.path import ContactPose
    from twin.one_contact import render_contact

    return call(render_contact, locals(), pose=call(ContactPose, locals()))
