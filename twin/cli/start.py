"""Commands for the first steps.

- ``twin sensors``, ``twin objects``, ``twin experiments``, ``twin randomisations``: what is shipped, and where a user's own files go.
- ``twin doctor``: what this machine has, what is missing, and the remedy.
- ``twin demo``: the whole chain on the shipped specifications.
- ``twin render``: one contact, rendered, with its exact ground truth.
- ``twin studio``: a page on which the user moves an object and sees the resulting contact, picture and estimate.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from twin.cli import app, options
from twin.cli.options import call, print_lines
from twin.errors import library
from twin.progress import Progress
from twin.signals import signals_as_ctrl_c
from twin.types import Form, Quality

if TYPE_CHECKING:
    from hardware.live.doctor import Machine
    from training.estimate.estimator import PoseEstimator
    from twin.demo.make_demo import Demo
    from twin.one_contact import RenderedContact


@app.command("sensors")
def sensors() -> None:
    """List the sensors, and the folder for your own.

    \b
    Example:
      twin sensors
    """
    from scenes.load import catalog_lines

    print_lines(catalog_lines("sensors"))


@app.command("objects")
def objects() -> None:
    """List the objects, and the folder for your own.

    \b
    Example:
      twin objects
    """
    from scenes.load import catalog_lines

    print_lines([*catalog_lines("objects"), "Any STL, OBJ or PLY file (in mm) is an object too: --object part.stl"])


@app.command("experiments")
def experiments() -> None:
    """List the experiments, and the folder for your own.

    An experiment defines the contacts, in the robot's coordinates.

    \b
    Example:
      twin experiments
    """
    from scenes.load import catalog_lines

    print_lines(catalog_lines("experiments"))


@app.command("randomisations")
def randomisations() -> None:
    """List the randomisations, and the folder for your own.

    A randomisation (domain randomisation) is the distribution of the quantities that vary between simulated frames.

    \b
    Example:
      twin randomisations
    """
    from scenes.load import catalog_lines

    print_lines(catalog_lines("randomisations"))


@app.command("doctor", exit_code=lambda machine: 0 if machine.can_render else 1)
def doctor(
    prepare: Annotated[bool, Option("--prepare", help="first compile what commands need at their first use")] = False, *, progress: Progress
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
    indent_mm: Annotated[float, Option(metavar="D", help="indentation from first touch; 0: no contact")],
    out: options.Out,
    tilt_deg: Annotated[options.Pair, Option(metavar="RX RY", help="turn of the object about x, then y")] = (0.0, 0.0),
    shear_mm: Annotated[options.Pair, Option(metavar="X Y", help="drag after the press")] = (0.0, 0.0),
    twist_deg: Annotated[float, Option(metavar="RZ", help="turn about z during the drag")] = 0.0,
    offset_mm: Annotated[options.Pair, Option(metavar="X Y", help="sideways shift of the object before it approaches")] = (0.0, 0.0),
    form: Annotated[Form, Option(help="the camera's frame, or the cropped and thresholded form of the recordings")] = Form.RAW,
    quality: Annotated[Quality, Option(help=options.QUALITY)] = "standard",
    seed: Annotated[int, Option(min=0, help="seed of the renderer and of the camera's noise")] = 0,
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


@app.command("studio")
def studio(
    sensor: Annotated[
        str | None, Option(metavar="S", help="sensor name ('twin sensors') or specification file (mg400-331 if not given)")
    ] = None,
    obj: Annotated[
        str | None, Option("--object", metavar="O", help="object name ('twin objects'), specification or mesh file (sphere)")
    ] = None,
    state: Annotated[
        str | None, Option(metavar="FILE", help="a state saved by the page, or its link, instead of sensor and object")
    ] = None,
    model: Annotated[Path | None, Option(metavar="RUN", help="folder of a run for its sensor; shipped weights if not given")] = None,
    recording: Annotated[str, Option(metavar="DIR", help="recording for the mode 'Recording'")] = "",
    camera: Annotated[str, Option(metavar="C", help="camera for the mode 'Live', as 'twin live' takes it")] = "",
    arm: Annotated[str, Option(metavar="A", help="arm for the mode 'Live'; it does not move until you arm it on the page")] = "",
    saves: Annotated[Path, Option(metavar="DIR", help="folder for files that the page saves")] = Path("out/studio"),
    host: Annotated[str, Option(help="address to listen on; a warning if other machines can reach it")] = "127.0.0.1",
    port: Annotated[int, Option(min=1, max=65535, help="port of the page; the next free one if it is taken")] = 8090,
    plain: Annotated[bool, Option("--plain", help="no path tracing: pictures stay rasterised")] = False,
    seconds: Annotated[float | None, Option(min=0, help="end after this time")] = None,
) -> None:
    """Move an object over the skin, on a page in the browser.

    Drag the object with the arrows and rings of the gizmo, or use sliders, typed numbers or keys (shift and arrows, page up and page down;
    with ctrl they turn it; 'ctrl + K' lists all). The page immediately shows the skin with its pins, the camera's picture, the detected
    pins and their Voronoi cells, force and torque, and the model's estimate with its 90 % interval beside the ground truth.

    While the object moves, contacts are solved on the usual mesh and pictures are rasterised. When it stands still, the picture is
    path-traced and the contact is solved again on a fine mesh. The page shows which of them it displays. The object stops at its limits,
    and the page shows the reason.

    Other modes: Degrade (the severity that the pipeline and the model tolerate on this contact), Recording (labels against estimates),
    Live (camera and arm), Your own sensor (a specification from a folder of frames, as 'twin new' makes it, with the layout over the
    frames).

    Without --sensor, --object and --state it shows what it showed last, from last-state.json in the folder --saves.

    The page's folder 'Save' shows a link that opens the complete state again, in a browser while the studio runs, or with --state.

    Only this machine can open the page, and the page loads nothing from other servers. All browsers show the same state. Ctrl-C ends it.

    \b
    Example:
      twin studio
      twin studio --sensor ur5-331 --object edge
      twin studio --state out/studio/state-1.json
      twin studio --state '?sensor=mg400-331&object=edge&depth_mm=3'
    """
    from hardware.live.studio_mode import LiveMode, require_feed
    from scenes import load_sensor
    from twin.studio.state import first_state
    from twin.studio.studio import StudioPlan, run_studio

    first = first_state(state, sensor, obj, saves)
    shown = load_sensor(first.sensor)
    require_feed(camera, arm, recording, shown)
    plan = StudioPlan(first, saves, host=host, port=port, traces=not plain, recording=recording, camera=camera, arm=arm, seconds=seconds)
    print_lines(plan.warnings)
    with signals_as_ctrl_c():
        run_studio(plan, lazy_models_by_sensor(model, shown.name), LiveMode, on_open=print_address)


def print_address(url: str) -> None:
    """Print the page's address."""
    print(f"open {url} in a browser; Ctrl-C ends it", flush=True)


def lazy_models_by_sensor(run: Path | None, sensor: str) -> Callable[[str], "PoseEstimator | None"]:
    """``models_by_sensor``. If no run is given, it loads when the first model is requested, so that the page does not wait for PyTorch."""

    def model_of(name: str) -> "PoseEstimator | None":
        return library("training.estimate.estimator").models_by_sensor()(name)

    return model_of if run is None else library("training.estimate.estimator").models_by_sensor(run, sensor)
