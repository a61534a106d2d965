"""``twin live``: a camera through a model, shown as it comes."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.options import NONE, SHIPPED_MODEL, AtRest, Camera, Model

HELP = """Show what a model makes of a camera's frames: pins, graph, Voronoi map, pose with its 90 % interval, rates.

A window opens if there is a display, and an OpenCV that can open one. Otherwise a page is served for the browser; its address is
printed. With --rerun (package rerun-sdk) it is Rerun's viewer, or its file: frame, pins, graph and pose on a time line.
With --record DIR every frame is kept, lossless, with its estimate; the folder is readable even if the program is killed.
--replay DIR gives the same frames again, and says whether the estimates are the same. With --at-rest first the camera must see
no contact at the start; that frame is kept with the session.

\b
  twin live --camera /dev/video0 --model RUN
  twin live --camera http://127.0.0.1:8081/stream.mjpg --model RUN --record out/session --headless --seconds 60
  twin live --replay out/session --model RUN --headless
"""


@app.command("live", help=HELP)
def live(
    model: Model = SHIPPED_MODEL,
    camera: Camera = "",
    record: Annotated[Path | None, typer.Option("--record", metavar="DIR", help="new folder for the session")] = None,
    replay: Annotated[Path | None, typer.Option("--replay", metavar="DIR", help="a recorded session instead of a camera")] = None,
    headless: Annotated[bool, typer.Option("--headless", help="show nothing, print the figures at the end")] = False,
    rerun: Annotated[
        str | None, typer.Option("--rerun", metavar="T", help="viewer, a new file *.rrd, or a viewer's address rerun+http://...")
    ] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0, help="stop after this time")] = None,
    count: Annotated[int | None, typer.Option("--count", min=1, help="stop after so many frames")] = None,
    at_rest: AtRest = NONE,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="of the page; 0: a free one")] = 8080,
) -> None:
    from hardware.watching import WatchPlan, watch
    from training.estimator import PoseEstimator
    from twin.cli.endings import arm_let_go
    from twin.cli.output import say

    plan = WatchPlan(
        camera=camera,
        replay=replay,
        record=record,
        shown=not headless,
        rerun=rerun,
        seconds=seconds,
        count=count,
        at_rest=at_rest,
        port=port,
    )
    with arm_let_go():
        watched = watch(plan, PoseEstimator.load(model), name=str(model), on_shown=tell_view)
    say(watched.lines())


def tell_view(url: str) -> None:
    """Say where the frames are shown."""
    print(f"showing in {url}; Ctrl-C ends it", flush=True)
