"""The command ``twin studio``: a page on which the user moves an object and sees the resulting contact, picture and estimate."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.cli import app
from twin.cli.options import print_lines
from twin.errors import extras_named
from twin.signals import signals_as_ctrl_c

if TYPE_CHECKING:
    from training.estimate.estimator import PoseEstimator


@app.command("studio")
def studio(
    sensor: Annotated[
        str | None, typer.Option(metavar="S", help="sensor name ('twin sensors') or specification file (mg400-331 if not given)")
    ] = None,
    obj: Annotated[
        str | None, typer.Option("--object", metavar="O", help="object name ('twin objects'), specification or mesh file (sphere)")
    ] = None,
    state: Annotated[
        str | None, typer.Option(metavar="FILE", help="a state saved by the page, or its link, instead of sensor and object")
    ] = None,
    model: Annotated[Path | None, typer.Option(metavar="RUN", help="folder of a run for its sensor; shipped weights if not given")] = None,
    recording: Annotated[str, typer.Option(metavar="DIR", help="recording for the mode 'Recording'")] = "",
    camera: Annotated[str, typer.Option(metavar="C", help="camera for the mode 'Live', as 'twin live' takes it")] = "",
    arm: Annotated[str, typer.Option(metavar="A", help="arm for the mode 'Live'; it does not move until you arm it on the page")] = "",
    saves: Annotated[Path, typer.Option(metavar="DIR", help="folder for files that the page saves")] = Path("out/studio"),
    host: Annotated[str, typer.Option(help="address to listen on; a warning if other machines can reach it")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="port of the page; the next free one if it is taken")] = 8090,
    plain: Annotated[bool, typer.Option("--plain", help="no path tracing: pictures stay rasterised")] = False,
    seconds: Annotated[float | None, typer.Option(min=0, help="end after this time")] = None,
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
        with extras_named():  # called in a thread of the page, which shows the error
            from training.estimate.loading import models_by_sensor

            return models_by_sensor()(name)

    if run is None:
        return model_of
    from training.estimate.loading import models_by_sensor

    return models_by_sensor(run, sensor)
