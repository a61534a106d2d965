"""Watching a camera, or replaying a session: from a plan to estimates, figures and a recorded session."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hardware.at_rest import FIRST, NONE, counting_from_first, given_frame
from hardware.cameras.choose import open_camera
from hardware.cameras.source import FrameSource, await_frame
from hardware.errors import DeviceError
from hardware.live import LiveSession, Shower, same_estimates
from hardware.session import SessionSource, SessionWriter
from hardware.step import Estimate, SensorModel
from hardware.timing import Timing
from hardware.view.draw import draw_view
from hardware.view.rerun import RerunView
from hardware.view.server import BrowserView
from hardware.view.window import WindowView, has_window
from twin.preprocess import Pipeline
from twin.types import Frame

PORT = 8080  # of the page that shows the frames
View = RerunView | WindowView | BrowserView


@dataclass(frozen=True)
class WatchPlan:
    """What to watch, and what becomes of it.

    Attributes
    ----------
    camera : str
        As ``open_camera`` takes it; "" with ``replay``.
    replay : Path or None
        A recorded session instead of a camera.
    record : Path or None
        New folder for a session.
    shown : bool
        Show the frames: in a window where there is a display, else on a page.
    rerun : str or None
        Show them in Rerun instead, as ``RerunView`` takes it, whatever ``shown`` says.
    seconds, count : float or None, int or None
        Stop after so long, or after so many frames.
    at_rest : str
        What pins are counted from: ``first`` (the first frame), ``none`` (the specification's layout), or a file.
    port : int
        Of the page; 0: a free one.
    """

    camera: str = ""
    replay: Path | None = None
    record: Path | None = None
    shown: bool = True
    rerun: str | None = None
    seconds: float | None = None
    count: int | None = None
    at_rest: str = NONE
    port: int = PORT

    def __post_init__(self) -> None:
        if bool(self.camera) == (self.replay is not None):
            raise DeviceError("give either --camera or --replay")
        if self.replay is not None and self.at_rest != NONE:
            raise DeviceError(
                "--at-rest goes with --camera: a replay counts pins from the frame that was kept with its session; leave it out"
            )


@dataclass(frozen=True)
class Watched:
    """What came of it.

    Attributes
    ----------
    timing : Timing
    interrupted : bool
        Whether Ctrl-C ended it.
    same : (int, int) or None
        Of a replay: how many estimates are those that were recorded, and how many there are.
    record : Path or None
        The session's folder.
    frames : int
    """

    timing: Timing
    interrupted: bool
    same: tuple[int, int] | None
    record: Path | None
    frames: int

    def lines(self) -> list[str]:
        """For people."""
        lines = ["ended"] if self.interrupted else []
        lines += self.timing.lines()
        if self.same is not None:
            lines.append(f"{self.same[0]} of {self.same[1]} estimates are those that were recorded")
        if self.record is not None:
            lines.append(f"wrote {self.record} ({self.frames} frames)")
        return lines


def watch(
    plan: WatchPlan,
    model: SensorModel,
    *,
    name: str = "",
    on_shown: Callable[[str], None] | None = None,
    on_estimate: Callable[[Frame, Estimate], None] | None = None,
) -> Watched:
    """Estimate the pose in every frame that can be had, until it is told to stop.

    Parameters
    ----------
    plan : WatchPlan
    model : SensorModel
    name : str
        Of the model, to be kept with the session.
    on_shown : callable, optional
        Called with the address of the view once it is open.
    on_estimate : callable, optional
        Called with each frame and its estimate.

    Raises
    ------
    TwinError
        There is no such camera or session, it is not the model's sensor, or the view can't be opened or broke.
    """
    source = SessionSource(plan.replay) if plan.replay is not None else open_camera(plan.camera, model.sensor, model.form)
    model.check(model.sensor, source.form)
    rest = source.rest if isinstance(source, SessionSource) else given_frame(plan.at_rest, model)
    found: list[Estimate] = []

    def keep(frame: Frame, estimate: Estimate) -> None:
        if plan.replay is not None:
            found.append(estimate)
        if on_estimate is not None:
            on_estimate(frame, estimate)

    with ExitStack() as stack:
        stack.enter_context(source)
        model, rest = _at_rest(plan, model, source, rest)
        session, shower = LiveSession(source, model, on_estimate=keep), None
        view = _view(plan, f"{model.sensor.name}, {source.name}")
        if view is not None:
            shower = stack.enter_context(Shower(session, _drawing(view, model), view))
            if on_shown is not None:
                on_shown(view.url)
        if plan.record is not None:  # last: a folder is begun only where there is something to keep
            about = {"sensor": model.sensor.name, "form": str(source.form), "camera": source.name, "model": name}
            session.record = stack.enter_context(SessionWriter(plan.record, about))
            if rest is not None:
                session.record.keep_rest(rest)
        interrupted = False
        try:
            session.run(most=plan.count, seconds=plan.seconds, going=lambda: shower is None or shower.open)
        except KeyboardInterrupt:
            interrupted = True
        same = (same_estimates(source.steps, found), len(found)) if isinstance(source, SessionSource) else None
        return Watched(session.timing(), interrupted, same, plan.record, session.count)


def _at_rest(plan: WatchPlan, model: SensorModel, source: FrameSource, rest: Frame | None) -> tuple[SensorModel, Frame | None]:
    """The model that counts pins from the frame without contact, and that frame."""
    if plan.at_rest == FIRST:
        rest = await_frame(source)
        return counting_from_first(model, rest), rest
    if rest is not None and (model.counts_from_rest or plan.replay is None):  # a session may be replayed with another model than its own
        return model.at_rest(rest), rest
    return model, rest


def _view(plan: WatchPlan, title: str) -> View | None:
    if plan.rerun is not None:
        return RerunView(title, plan.rerun)
    if not plan.shown:
        return None
    return WindowView(title) if has_window() else BrowserView(title, port=plan.port)


def _drawing(view: View, model: SensorModel) -> Callable[[Frame, Estimate, list[str]], np.ndarray]:
    """What draws a frame with its pins and its estimate, in the thread of the view."""
    pipeline = Pipeline(model.sensor, model.form, model.pipeline.reference)
    rest_px2 = pipeline.reference.area_px2

    def draw(frame: Frame, estimate: Estimate, lines: list[str]) -> np.ndarray:
        seen = pipeline(frame)
        if isinstance(view, RerunView):
            view.log(frame, seen, estimate)
        return draw_view(frame, seen, rest_px2, lines)

    return draw
