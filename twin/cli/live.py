"""``twin live``: a camera through a model, shown as it comes."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli import app
from twin.cli.at_rest import FIRST, NONE, AtRest, counting_from_first, given_frame
from twin.cli.servo import SHIPPED_MODEL, Camera, Model

HELP = """Show what a model makes of a camera's frames: pins, graph, Voronoi map, pose with its 90 % interval, rates.

A window opens where there is a display and an OpenCV that can; else a page in the browser (its address is printed); with
--rerun (package rerun-sdk) Rerun's viewer, or its file: frame, pins, graph and pose on a time line.
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
    from contextlib import ExitStack

    from hardware.cameras.choose import open_camera
    from hardware.cameras.source import await_frame
    from hardware.errors import DeviceError
    from hardware.live import LiveSession, Shower, same_estimates
    from hardware.session import SessionSource, SessionWriter
    from hardware.view.draw import draw_view
    from hardware.view.rerun import RerunView
    from hardware.view.server import BrowserView
    from hardware.view.window import WindowView, has_window
    from training.estimator import PoseEstimator
    from twin.cli.endings import signals_as_ctrl_c
    from twin.preprocess import Pipeline

    if bool(camera) == (replay is not None):
        raise DeviceError("give either --camera or --replay")
    if replay is not None and at_rest != NONE:
        raise DeviceError("--at-rest goes with --camera: a replay counts pins from the frame that was kept with its session; leave it out")
    estimator = PoseEstimator.load(model)
    source = SessionSource(replay) if replay else open_camera(camera, estimator.sensor, estimator.form)
    estimator.check(estimator.sensor, source.form)
    rest = source.rest if replay else given_frame(at_rest, estimator)
    found: list = []
    with ExitStack() as stack:
        stack.enter_context(signals_as_ctrl_c())
        stack.enter_context(source)
        if at_rest == FIRST:
            rest = await_frame(source)
            estimator = counting_from_first(estimator, rest)
        elif rest is not None and (estimator.counts_from_rest or not replay):  # a session may be replayed with another model than its own
            estimator = estimator.at_rest(rest)
        view, title = None, f"{estimator.sensor.name}, {source.name}"
        if rerun is not None:
            view = RerunView(title, rerun)
        elif not headless:
            view = WindowView(title) if has_window() else BrowserView(title, port=port)
        keep = (lambda frame, estimate: found.append(estimate)) if replay else None
        session = LiveSession(source, estimator, on_estimate=keep)
        shower = None
        if view is not None:
            pipeline = Pipeline(estimator.sensor, estimator.form, estimator.pipeline.reference)
            rest_px2 = pipeline.reference.area_px2

            def draw(frame, estimate, lines):
                seen = pipeline(frame)
                if rerun is not None:
                    view.log(frame, seen, estimate)
                return draw_view(frame, seen, rest_px2, lines)

            shower = stack.enter_context(Shower(session, draw, view))
            print(f"showing in {view.url}; Ctrl-C ends it", flush=True)
        if record is not None:  # last: a folder is begun only where there is something to keep
            about = {"sensor": estimator.sensor.name, "form": str(source.form), "camera": source.name, "model": str(model)}
            session.record = stack.enter_context(SessionWriter(record, about))
            if rest is not None:
                session.record.keep_rest(rest)
        try:
            session.run(most=count, seconds=seconds, going=lambda: shower is None or shower.open)
        except KeyboardInterrupt:
            print("ended")
        print("\n".join(session.timing().lines()))
        if replay is not None:
            print(f"{same_estimates(source.steps, found)} of {len(found)} estimates are those that were recorded")
        if record is not None:
            print(f"wrote {record} ({session.record.count} frames)")
