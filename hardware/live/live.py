"""Watches a camera, or replays a session: from a plan to estimates, figures and, if requested, a recorded session.

``watch`` runs the model on every frame. ``LiveSession`` is its loop; ``Shower`` shows the newest frame from its own thread, on a page or in
Rerun (``rerun-sdk``, an optional package).
"""

import re
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from socket import create_connection
from urllib.parse import urlsplit

import numpy as np

from hardware.cameras.source import FrameSource, SessionSource, await_frame, open_camera
from hardware.errors import DeviceError
from hardware.servo.timing import TimeSpread, Timing
from hardware.workcell.build import load_rest_frame
from hardware.workcell.ros2 import publishing
from twin.errors import ErrorsAs, FrameError, OptionError, TwinError, format_count, library
from twin.estimate import Estimate, Estimator, SensorModel, pins_in, readable_labels
from twin.pins import Pipeline
from twin.records import KeptAlso
from twin.records.session import SESSION_FILES, SessionWriter
from twin.store import output
from twin.studio.page import LiveFrame, LivePage
from twin.types import FIRST, NONE, Frame, Observation

# Number of newest times of each kind from which the figures are computed.
KEPT_TIMES = 10_000
# Number of newest frames from which the present frame rate is computed.
RATE_SPAN = 30
# Interval in s between two pictures of the view.
SHOW_S = 0.1
# Time, s, that a view has at the end to write or send its data.
CLOSE_S = 20.0
# Longest wait for a frame, in s.
FRAME_TIMEOUT_S = 5.0
# Port of the page that shows the frames.
PORT = 8080
# Values of the option `rerun`: the viewer of this machine, and the end of a file's name.
VIEWER, SUFFIX = "viewer", ".rrd"
# Longest wait, s, for a viewer, at the start and at the end. A new viewer needs a second or two.
ANSWER_S = 8.0


class RerunView:
    """Logs frames and estimates to Rerun. A context manager.

    Parameters
    ----------
    title : str
    target : str
        ``viewer`` (opened on this machine), a new file ``*.rrd``, or the address of a running viewer (``rerun+http://...``).

    Raises
    ------
    ExtraError
        The package is missing.
    OptionError, DeviceError
        The target is none of these, or the file already exists.
    """

    def __init__(self, title: str, target: str) -> None:
        if target != VIEWER and "://" not in target and not target.endswith(SUFFIX):
            raise OptionError(f"`rerun` {target}: expected '{VIEWER}', a file *{SUFFIX} or an address rerun+http://...")
        if target.endswith(SUFFIX) and "://" not in target and Path(target).exists():
            raise DeviceError(f"`rerun` {target}: exists already; give a new file, or remove it")
        self._rerun, self._target = library("rerun"), target
        self._stream = self._rerun.RecordingStream(re.sub(r"\W+", "-", title))
        self.url = "Rerun's viewer" if target == VIEWER else target

    def __enter__(self) -> "RerunView":
        """Open the target.

        Raises
        ------
        DeviceError
            No viewer answers at the address, or the file can't be written.
        """
        stream, told = self._stream, f"`rerun` {self._target}: can't be opened"
        remedy = f"start a viewer ('rerun' prints its address) and give rerun+http://HOST:9876/proxy, or a file *{SUFFIX}"
        with ErrorsAs((RuntimeError, OSError, ValueError), lambda error: DeviceError(f"{told} ({error}); {remedy}")):
            if self._target == VIEWER:
                stream.spawn()
            elif "://" in self._target:
                with create_connection(_address(self._target), timeout=ANSWER_S):  # reports a refusal at once and in few words
                    stream.connect_grpc(self._target)
            else:
                Path(self._target).parent.mkdir(parents=True, exist_ok=True)
                stream.save(self._target)
            stream.flush(timeout_sec=ANSWER_S)  # connecting itself reports no error, but flushing does
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._stream.flush(timeout_sec=ANSWER_S)
        except RuntimeError as error:
            raise DeviceError(f"`rerun` {self._target}: closed before the end ({error}); the last pictures are missing there") from error
        finally:
            self._stream.disconnect()

    def show(self, live: LiveFrame, seen: Observation) -> None:
        """Log a frame with its pins and graph, the estimate's values with their intervals, and the lines, on ``frame`` and ``time``."""
        rerun, stream, frame, estimate = self._rerun, self._stream, live.frame, live.estimate
        stream.set_time("frame", sequence=frame.sequence)
        stream.set_time("time", duration=frame.time_s)
        stream.log("camera", rerun.Image(frame.image))
        if seen.valid and seen.graph is not None:
            nodes = seen.graph.nodes_px
            stream.log("camera/edges", rerun.LineStrips2D(nodes[np.asarray(seen.graph.edges)]))
            stream.log("camera/pins", rerun.Points2D(nodes))
        for name, value, low, high in zip(estimate.names, estimate.value, estimate.low, estimate.high, strict=True):
            stream.log(f"pose/{name}", rerun.Scalars([value, low, high]))
        stream.log("figures", rerun.TextDocument("\n".join(live.lines)))


def _address(target: str) -> tuple[str, int]:
    """Host and port of a viewer's address; raises ``ValueError`` if it has none."""
    parts = urlsplit(target)
    if not parts.hostname or not parts.port:
        raise ValueError("no host and port")
    return parts.hostname, parts.port


View = RerunView | LivePage
Hear = Callable[[Frame, Estimate], None]


@dataclass
class LiveSession:
    """Estimates the pose in every frame that a source delivers.

    Parameters
    ----------
    source : FrameSource
        Connected source.
    estimator : Estimator
    record : SessionWriter, optional
    on_estimate : callable, optional
        Called with each frame and its estimate.
    """

    source: FrameSource
    estimator: Estimator
    record: SessionWriter | None = None
    on_estimate: Hear | None = None
    newest: tuple[Frame, Estimate] | None = None
    count: int = 0
    valid: int = 0
    invalid: str = ""
    # ages of the frames when they were taken and when their estimates were made (NaN for a recording), times spent, and ends
    _times: deque[tuple[float, float, float, float]] = field(default_factory=lambda: deque(maxlen=KEPT_TIMES))
    _begun_s: float = field(default_factory=time.monotonic)

    def run(
        self, *, most: int | None = None, seconds: float | None = None, rate_hz: float = np.inf, going: Callable[[], bool] = lambda: True
    ) -> Timing:
        """Run until the recording ends, ``most`` frames were read, ``seconds`` have passed, or ``going()`` is false.

        At most ``rate_hz`` frames are read in a second, each time the newest one of a camera.

        Raises
        ------
        DeviceError
            The camera has ended, or delivers no frame.
        FrameError
            A frame does not belong to the model's sensor.
        """
        self._begun_s = due_s = time.monotonic()
        while going() and (most is None or self.count < most) and (seconds is None or time.monotonic() - self._begun_s < seconds):
            time.sleep(max(0.0, due_s - time.monotonic()))
            due_s = max(due_s, time.monotonic()) + 1 / rate_hz
            try:
                frame = self.source.read(timeout_s=FRAME_TIMEOUT_S)
            except EOFError:
                break
            except TimeoutError as error:
                raise DeviceError(f"{error}; check the camera") from error
            taken_s = time.monotonic()
            with ErrorsAs(FrameError, lambda error: FrameError(f"{self.source.name}: {error}")):
                estimate = self.estimator(frame)
            now_s, exposed_s = time.monotonic(), frame.time_s if self.source.is_live else np.nan
            self._times.append((taken_s - exposed_s, now_s - exposed_s, now_s - taken_s, now_s))
            self.count += 1
            self.valid += estimate.valid
            self.invalid = self.invalid if estimate.valid else estimate.reason
            self.newest = (frame, estimate)
            if self.record is not None:
                self.record.append(frame, estimate_line(estimate) | {"time_s": now_s})
            if self.on_estimate is not None:
                self.on_estimate(frame, estimate)
        return self.timing()

    def timing(self) -> Timing:
        """The figures so far."""
        rate_hz = self.count / max(time.monotonic() - self._begun_s, 1e-9)
        ages, late, spent, _ = map(TimeSpread.of, np.reshape(self._times, (-1, 4)).T.tolist())
        return Timing(self.count, rate_hz, rate_hz, late, ages, spent, self.source.dropped)

    def lines(self, estimate: Estimate) -> list[str]:
        """Lines of text: pose with its interval, rates and losses."""
        if estimate.valid:
            rows = zip(readable_labels(estimate.names), estimate.value, estimate.low, estimate.high, strict=True)
            pose = [f"{name} {value:+.2f} [{low:+.2f}, {high:+.2f}]" for name, value, low, high in rows]
        else:
            pose = [f"not valid: {estimate.reason}"]
        times = list(self._times)
        done = [end_s for *_, end_s in times[-RATE_SPAN:]]
        now_hz = (len(done) - 1) / (done[-1] - done[0]) if len(done) > 1 and done[-1] > done[0] else 0.0
        late = f", exposure to pose {1e3 * np.median([late_s for _, late_s, *_ in times]):.0f} ms" if times and self.source.is_live else ""
        return ["   ".join(pose), f"{now_hz:.1f} frames/s, {format_count(self.count, 'frames')}, {self.source.dropped} dropped{late}"]


def estimate_line(estimate: Estimate) -> dict:
    """An estimate in the form in which a session stores it."""
    numbers = {key: np.asarray(getattr(estimate, key)) for key in ("value", "low", "high")}
    return {"names": list(estimate.names)} | numbers | {"valid": bool(estimate.valid), "reason": estimate.reason}


def same_estimates(steps: list[dict], values: list[np.ndarray]) -> int:
    """Number of steps of a session whose stored estimates equal exactly the present ones (K,)."""
    kept = (np.array(step.get("value", []), float) for step in steps)  # None becomes NaN
    return sum(np.array_equal(then, now, equal_nan=True) for then, now in zip(kept, values, strict=False))


class Shower(AbstractContextManager["Shower"]):
    """Shows the newest frame from its own thread, so that drawing does not delay the session. A context manager.

    Parameters
    ----------
    session : LiveSession
    pipeline : Pipeline
        Pipeline that finds the pins that are drawn over a frame.
    view : View

    Raises
    ------
    DeviceError
        When the context is entered, if the view can't be opened; when it is left, if the view has failed.
    """

    def __init__(self, session: LiveSession, pipeline: Pipeline, view: View) -> None:
        self._session, self._pipeline, self._view = session, pipeline, view
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._error: Exception | None = None

    @property
    def open(self) -> bool:
        """Whether the view still works."""
        return not self._end.is_set()

    def __enter__(self) -> "Shower":
        self._view.__enter__()
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._end.set()
        self._thread.join(timeout=CLOSE_S)
        if kind is None and self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            with ExitStack() as stack:
                stack.push(self._view)
                self._show()
        except TwinError as error:
            self._error = error
        except Exception as error:
            self._error = DeviceError(f"the view failed ({error}); without `rerun`, `headless` shows nothing")
        self._end.set()

    def _show(self) -> None:
        shown = None
        while not self._end.wait(SHOW_S):
            newest = self._session.newest
            if newest is None or newest is shown:
                continue
            try:
                lines = self._session.lines(newest[1])
            except RuntimeError:  # the session added a time while the times were read
                continue
            shown = newest
            self._view.show(LiveFrame(*newest, tuple(lines[1:])), pins_in(*newest, self._pipeline))


@dataclass(frozen=True)
class WatchPlan:
    """Settings of watching: source, view and recording.

    Attributes
    ----------
    camera : str
        Text for ``open_camera``; "" with ``replay``.
    replay : Path or None
        A recorded session instead of a camera.
    record : Path or None
        New folder for a session.
    shown : bool
        Show the frames on a page for the browser.
    rerun : str or None
        A target of ``RerunView``. The frames are then shown there, whatever ``shown`` is.
    seconds, count : float or None, int or None
        Stop after this time in s, or after this number of frames.
    rate : float or None
        Largest number of frames per second that are used; None: all that the model keeps up with.
    at_rest : str
        The pins at rest: ``first`` (from the first frame), ``none`` (those that the model knows, or that follow from the contacts), or a
        file.
    port : int
        Port of the page; 0 for a free one.
    also : tuple of str
        Further formats in which the session is kept at its end, each in a subfolder of ``record``.
    ros2 : str or None
        Namespace in which frames and estimates are published as ROS 2 topics.
    """

    camera: str = ""
    replay: Path | None = None
    record: Path | None = None
    shown: bool = True
    rerun: str | None = None
    seconds: float | None = None
    count: int | None = None
    rate: float | None = None
    at_rest: str = NONE
    port: int = PORT
    also: tuple[str, ...] = ()
    ros2: str | None = None

    def __post_init__(self) -> None:
        if self.also and self.record is None:
            raise OptionError("`also` needs `record`: it keeps the recorded session in a further format")
        if bool(self.camera) == (self.replay is not None):
            raise OptionError("give either `camera` or `replay`")
        if self.replay is not None and self.at_rest != NONE:
            raise OptionError("`at_rest` needs `camera`: a replay measures displacements from its session's own frame; leave `at_rest` out")


@dataclass(frozen=True)
class WatchResult:
    """The result of ``watch``.

    Attributes
    ----------
    timing : Timing
    interrupted : bool
        Whether Ctrl-C ended it.
    same : (int, int) or None
        For a replay: the number of estimates that equal the recorded ones, and the number of all estimates.
    record : Path or None
        Folder of the recorded session.
    frames : int
        Number of frames.
    notes : list of str
        Irregularities of the recording, the session, or the camera's frames.
    valid : int
        Number of frames with a valid estimate.
    invalid : str
        Reason why the last frame without a valid estimate had none.
    """

    timing: Timing
    interrupted: bool
    same: tuple[int, int] | None
    record: Path | None
    frames: int
    notes: list[str] = field(default_factory=list)
    valid: int = 0
    invalid: str = ""

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = ["ended"] if self.interrupted else []
        lines += [f"note: {note}" for note in self.notes]
        lines += self.timing.lines()
        if self.frames:
            why = "" if self.valid == self.frames or not self.invalid else f"; the last invalid one: {self.invalid}"
            lines.append(f"{self.valid} of {format_count(self.frames, 'frames')} valid{why}")
        if self.same is not None:
            lines.append(f"{self.same[0]} of {self.same[1]} estimates equal the recorded ones")
        if self.record is not None:
            lines.append(f"wrote {self.record} ({format_count(self.frames, 'frames')})")
        return lines


def watch(
    plan: WatchPlan, model: SensorModel, *, name: str = "", on_shown: Callable[[str], None] | None = None, on_estimate: Hear | None = None
) -> WatchResult:
    """Estimate the pose in every frame that the camera or the session delivers, until the plan's end or Ctrl-C.

    Parameters
    ----------
    plan : WatchPlan
    model : SensorModel
    name : str
        The model's name, which is stored with the session.
    on_shown : callable, optional
        Called with the address of the view once it is open.
    on_estimate : callable, optional
        Called with each frame and its estimate.

    Raises
    ------
    TwinError
        There is no such camera or session, its sensor is not the model's, or the view can't be opened or fails.
    """
    kept = KeptAlso(plan.record or Path(), plan.also, model.sensor)
    source = SessionSource(plan.replay) if plan.replay is not None else open_camera(plan.camera, model.sensor, model.form)
    model.check(model.sensor, source.form)
    rest = source.session.rest if isinstance(source, SessionSource) else load_rest_frame(plan.at_rest, model)
    found: list[np.ndarray] = []

    def keep(frame: Frame, estimate: Estimate) -> None:
        if plan.replay is not None:
            found.append(np.asarray(estimate.value, float))
        publish(frame, estimate)
        if on_estimate is not None:
            on_estimate(frame, estimate)

    with ExitStack() as stack:
        stack.enter_context(source)
        model, rest = _at_rest(plan, model, source, rest)
        publish = stack.enter_context(publishing(plan.ros2, source, model.pipeline))
        session, shower = LiveSession(source, model, on_estimate=keep), None
        pipeline = Pipeline(model.sensor, model.form, model.pipeline.reference)  # a separate one for the view's thread
        view = _view(plan, f"{model.sensor.name}, {source.name}", pipeline)
        if view is not None:
            shower = stack.enter_context(Shower(session, pipeline, view))
            if on_shown is not None:
                on_shown(view.url)
        if plan.record is not None:  # last, so that no folder is made if an earlier step fails
            about = {"sensor": model.sensor.name, "form": str(source.form), "camera": source.name, "model": name}
            stack.enter_context(output(plan.record, *SESSION_FILES))
            stack.enter_context(kept)
            stack.callback(_catch_up, session, kept)
            session.record = stack.enter_context(SessionWriter(plan.record, about))
            if rest is not None:
                session.record.keep_rest(rest)
        interrupted = True
        with suppress(KeyboardInterrupt):
            session.run(most=plan.count, seconds=plan.seconds, rate_hz=plan.rate or np.inf, going=lambda: shower is None or shower.open)
            interrupted = False
        same = (same_estimates(source.session.steps, found), len(found)) if isinstance(source, SessionSource) else None
        return WatchResult(session.timing(), interrupted, same, plan.record, session.count, source.notes(), session.valid, session.invalid)


def _catch_up(session: LiveSession, kept: KeptAlso) -> None:
    """Write a session with at least one step in the further formats, however it ended."""
    if session.count:
        kept.catch_up()


def _at_rest(plan: WatchPlan, model: SensorModel, source: FrameSource, rest: Frame | None) -> tuple[SensorModel, Frame | None]:
    """The model with the pins at rest from the frame without contact, or from the contacts, and that frame."""
    if plan.at_rest == FIRST:
        rest = await_frame(source)
        return model.at_rest(rest), rest
    # A session may be replayed with another model, which may not use displacements from rest.
    if rest is not None and (model.counts_from_rest or plan.replay is None):
        return model.at_rest(rest), rest
    return model.seeking_rest(), rest


def _view(plan: WatchPlan, title: str, pipeline: Pipeline) -> View | None:
    """The view of the plan, not yet open; None if nothing is shown."""
    if plan.rerun is not None:
        return RerunView(title, plan.rerun)
    return LivePage(title, pipeline.spec, pipeline.reference, port=plan.port) if plan.shown else None
