"""Threads and processes of a moving contact: the thread that owns it, and the process that path-traces it.

The thread always moves towards the newest wish, and refines the answer when no wish is open. The page and the moving object never wait for
the path tracer, and continue if it fails.
"""

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import Pipe, connection
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Generic, TypeVar

from scenes.base import SpecError
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import RenderError, TwinError, format_count
from twin.objects import build_field
from twin.optics.preview import Shading
from twin.optics.render import Renderer
from twin.report.skin3d import SkinPainter
from twin.simulator import Simulator
from twin.studio.camera import PARTS, dome_renderer, dome_shading
from twin.studio.contact import ContactAnswer, Light, MovingContact
from twin.studio.pose import ObjectPose, PressedPose
from twin.types import ContactState, FloatArray, Form

SHOWN_S = 0.15
"""Time, s, after the first pass in which it can be shown before the next pass uses all cores."""
END_S = 3.0
"""Longest wait, s, for the process to end by itself."""


@dataclass(frozen=True)
class Traced:
    """Path-traced light of the dome's part of the frame.

    Attributes
    ----------
    solved : int
        Number of the contact.
    light : (h, w) or (h, w, 3) float
    ms : float
        Time since the start of the job.
    rough : bool
        Whether this is the first pass. A better picture follows unless a newer contact comes.
    """

    solved: int
    light: FloatArray
    ms: float
    rough: bool


@dataclass(frozen=True)
class Saved:
    """A contact's files, in the format of ``twin render``."""

    written: list[Path]


@dataclass(frozen=True)
class Failed:
    """A job that failed; ``tracing`` states whether path tracing as such does not work on this machine."""

    reason: str
    tracing: bool = False


Outcome = Shading | Traced | Saved | Failed
Job = tuple[Any, ...]
"""``_trace`` or ``_save``, and its last arguments."""


class Tracer:
    """Path-traces contacts of one sensor. Of several waiting contacts only the newest is traced. Call ``close`` at the end.

    The first outcome is the preview's shading. Each contact has two outcomes: the first pass, and the mean of all passes.

    Parameters
    ----------
    spec : SensorSpec

    Attributes
    ----------
    on_outcome : callable
        Called in a separate thread when an outcome has arrived.
    """

    def __init__(self, spec: SensorSpec) -> None:
        self._spec = spec
        self.on_outcome: Callable[[], None] = lambda: None
        self._here, self._there = Pipe()
        self._process: subprocess.Popen[bytes] | None = None
        self._found: deque[Outcome] = deque()
        self._ended = False
        self._one = threading.Lock()
        self._tracing = False
        self._next: Job | None = None

    def start(self) -> None:
        """Start the process, if it is not running yet. It is ready after some seconds."""
        if self._process is None:
            # ``multiprocessing`` is not used, because it would run the user's own program again in the new process
            number = self._there.fileno()
            passed = () if sys.platform == "win32" else (number,)
            if sys.platform == "win32":
                os.set_handle_inheritable(number, True)
            command = [sys.executable, "-c", f"from {__name__} import serve; serve({number})"]
            self._process = subprocess.Popen(command, pass_fds=passed, close_fds=bool(passed))
            self._there.close()
            self._here.send(self._spec)
            threading.Thread(target=self._receive, name="studio-tracer", daemon=True).start()

    def trace(self, solved: int, state: ContactState) -> None:
        """Request a contact's light. One contact is traced at a time. Of further requests before its first pass only the newest is kept."""
        with self._one:
            if self._tracing:
                self._next = _trace, solved, state
                return
            self._tracing = True
        self._send((_trace, solved, state))

    def save(self, out: Path, obj: ObjectSpec, pose: PressedPose, state: ContactState, form: Form) -> None:
        """Request a contact's files in a folder that exists."""
        self._send((_save, out, obj, pose, state, form))

    def outcomes(self) -> list[Outcome]:
        """Outcomes that have arrived since the last call; never waits."""
        return [self._found.popleft() for _ in range(len(self._found))]

    def _receive(self) -> None:
        """Receive outcomes as they arrive. A process that waits to send does not read the next job, so both sides would wait forever."""
        try:
            while True:
                outcome = self._here.recv()
                self._found.append(outcome)
                self.on_outcome()
                if isinstance(outcome, Failed) or (isinstance(outcome, Traced) and outcome.rough):
                    with self._one:
                        job, self._next = self._next, None
                        self._tracing = job is not None
                    if job is not None:
                        self._send(job)
        except (EOFError, OSError, TypeError):  # this end of the connection, or the other, was closed
            if not self._ended:
                self._ended = True
                why = "the path tracer's process has ended; pictures stay rasterised. Start the studio again"
                self._found.append(Failed(why, tracing=True))

    def close(self) -> None:
        """End the process."""
        self._ended = True
        with suppress(OSError):
            self._here.send(None)  # closing the socket alone does not wake the thread that reads from it
        if self._process is None:
            self._there.close()
            return
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:  # it is still tracing or writing
            self._process.kill()
            self._process.wait()
        self._here.close()

    def _send(self, job: Job) -> None:
        self.start()
        if self._ended:
            return
        with suppress(OSError):  # ``outcomes`` reports that the process has ended
            self._here.send(job)


def serve(number: int) -> None:
    """Run the process: receive the sensor and then jobs through a file descriptor, and send outcomes, until that is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal ends the studio, which then ends this process
    there = getattr(connection, "PipeConnection", Connection)(number)  # Windows has a class of its own for pipes
    jobs: deque[Job | None] = deque()

    def overtaken(wait_s: float) -> bool:
        while there.poll(0 if jobs else wait_s):
            jobs.append(there.recv())
        return any(job is None or job[0] is _trace for job in jobs)

    try:
        spec: SensorSpec = there.recv()
        renderer, simulator = cache(partial(dome_renderer, spec)), cache(partial(Simulator, spec))  # built when they are first needed
        for shading in _catch_render_errors(lambda: iter([dome_shading(spec)]), tracing=True):
            there.send(shading)
        while (job := jobs.popleft() if jobs else there.recv()) is not None:
            work, *given = job
            tools = (renderer, overtaken) if work is _trace else (simulator,)
            for outcome in _catch_render_errors(partial(work, *tools, *given), tracing=work is _trace):
                there.send(outcome)
    except (EOFError, OSError):
        return


def _trace(renderer: Callable[[], Renderer], overtaken: Callable[[float], bool], solved: int, state: ContactState) -> Iterator[Outcome]:
    """Trace a contact pass by pass, until a newer one has ``overtaken`` it."""
    samples = [max(1, renderer().spp // part) for part in PARTS]
    started = time.perf_counter()
    for k, light in enumerate(renderer().refine(state, solved, samples=samples)):
        if k == 0 or k == len(samples) - 1:
            yield Traced(solved, light, 1e3 * (time.perf_counter() - started), rough=k == 0)
        if overtaken(SHOWN_S if k == 0 else 0.0):
            return


def _save(
    simulator: Callable[[], Simulator], out: Path, obj: ObjectSpec, pose: PressedPose, state: ContactState, form: Form
) -> Iterator[Outcome]:
    from twin.one_contact import write_contact  # imports matplotlib, which no picture of the page needs

    made = simulator()
    with SkinPainter() as painter:
        painter.draw_contact(made.solver.mesh, made.spec.pins, state, build_field(obj))
        yield Saved(write_contact(out, made, obj, pose, state, made.render(state, form=form), painter)[0])


def _catch_render_errors(make: Callable[[], Iterator[Outcome]], *, tracing: bool = False) -> Iterator[Outcome]:
    try:
        yield from make()
    except TwinError as error:
        yield Failed(str(error), tracing and isinstance(error, RenderError))
    except (RuntimeError, OSError, ValueError) as error:  # raised by Mitsuba and LLVM, and if the disk is full
        yield Failed(f"{type(error).__name__}: {error}", tracing)


LOG = logging.getLogger(__name__)
STILL_S = 0.04
"""Time, s, without a wish after which the object counts as standing still."""
REFINE_S = 1.0
"""Time, s, without a wish after which the fine mesh follows. A step on it takes some 0.1 s, and a new wish must wait for it."""
LOOK_S = 0.02
"""Interval, s, at which due work is looked for."""


def describe_error(error: Exception) -> str:
    """An error as text for the page. A fault of this program is also logged with its traceback, and the thread continues."""
    if isinstance(error, TwinError | SpecError):
        return str(error)
    LOG.error("a fault of this program", exc_info=error)
    return f"a fault of this program ({error!r}); what is shown may be an earlier state"


Wish = tuple[ObjectPose, float]
"""A pose, and the time (``time.monotonic``) of the wish."""


class _OwnThread(ABC):
    """A thread that waits for work.

    Parameters
    ----------
    name : str
        Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._news = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after its present work."""
        with self._news:
            self._ended = True
            self._news.notify()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """Work until the thread is ended."""


class Worker(_OwnThread):
    """Moves a contact in its own thread.

    Parameters
    ----------
    contact : MovingContact
    tracer : Tracer or None
        If it is None, pictures stay rasterised.
    on_answer : callable
        Called with each answer, in the worker's thread.
    on_message : callable
        Called with a line for the user about saved files or failures.
    """

    def __init__(
        self, contact: MovingContact, tracer: Tracer | None, on_answer: Callable[[ContactAnswer], None], on_message: Callable[[str], None]
    ) -> None:
        self._contact, self._tracer = contact, tracer
        self._on_answer, self._on_message = on_answer, on_message
        super().__init__("studio-worker")
        self._wish: Wish | None = None
        self._jobs: deque[Callable[[], None]] = deque()
        self._way: deque[Wish] = deque()
        self._asked_trace = 0
        self._moved_s = time.monotonic()
        self.newest: ContactAnswer | None = None
        self._traces = tracer is not None
        if tracer is not None:
            tracer.on_outcome = self._wake

    def _wake(self) -> None:
        """Take the tracer's outcomes at once."""
        with self._news:
            self._news.notify()

    def ask(self, wished: ObjectPose) -> None:
        """Move to a pose from now on. Earlier wishes, and a path that is being played, are dropped."""
        with self._news:
            self._way.clear()
            self._wish = (wished, time.monotonic())
            self._news.notify()

    def play(self, way: list[tuple[float, ObjectPose]]) -> None:
        """Move through poses. Each has its time in s from now. If the contact takes longer, the next pose follows as soon as possible."""
        begin = time.monotonic()
        with self._news:
            self._way = deque((pose, begin + at) for at, pose in way)
            self._news.notify()

    def do(self, job: Callable[[], None]) -> None:
        """Call a function in the worker's thread, between two steps. An error of it becomes a message."""
        with self._news:
            self._jobs.append(job)
            self._news.notify()

    def show_again(self) -> None:
        """Compute the newest answer again after a change of form or model. Only the worker's thread may call this."""
        answer = self._contact.again()
        if answer is not None:
            self._publish(answer)

    def _run(self) -> None:
        while True:
            with self._news:
                if not (self._jobs or self._due() or self._ended or self._busy()):
                    self._news.wait(LOOK_S)
                if self._ended:
                    return
                job = self._jobs.popleft() if self._jobs else None
                wish = self._due()
            try:
                self._turn(job, wish)
            except Exception as error:
                with self._news:
                    if self._wish is wish:
                        self._wish = None
                self._moved_s = time.monotonic()  # so that a failed step on the fine mesh is not repeated without a pause
                self._on_message(describe_error(error))

    def _due(self) -> Wish | None:
        """The wish to move to now. A pose of a played path waits for its time, and for the pose before it."""
        if self._way and self._way[0][1] <= time.monotonic() and self._wish is None:
            self._wish = self._way.popleft()
        return self._wish

    def _busy(self) -> bool:
        """Whether the fine mesh has something to do."""
        newest = self.newest
        seen = newest is not None and (newest.lit is Light.TRACED or not self._traces)
        return seen and not self._way and time.monotonic() - self._moved_s > REFINE_S and not self._contact.refined

    def _turn(self, job: Callable[[], None] | None, wish: Wish | None) -> None:
        if job is not None:
            job()
        for outcome in self._tracer.outcomes() if self._tracer is not None else ():
            self._take(outcome)
        if wish is not None:
            self._publish(self._contact.step(wish[0]))
            self._moved_s = time.monotonic()
            with self._news:
                if self.newest is not None and self.newest.arrived and self._wish is wish:
                    self._wish = None
        elif self._busy():
            refined = self._contact.refine()
            if refined is not None and self._traces and self._tracer is not None:
                self._asked_trace = refined.solved
                self._tracer.trace(refined.solved, refined.state)  # the answer is shown together with its traced picture
            elif refined is not None:
                self._publish(refined)
        if wish is None:
            self._ask_trace()

    def _ask_trace(self) -> None:
        """Request the path-traced picture of an answer that stands still."""
        newest = self.newest
        if newest is None or not self._traces or self._tracer is None or self._way:
            return
        still = time.monotonic() - self._moved_s > STILL_S
        if still and newest.lit is Light.RASTERISED and newest.solved != self._asked_trace:
            self._asked_trace = newest.solved
            self._tracer.trace(newest.solved, newest.state)

    def _take(self, outcome: Outcome) -> None:
        match outcome:
            case Traced():
                if outcome.rough and self.newest is not None and self.newest.lit is Light.TRACED:
                    return  # no good picture gives way
                lit = Light.ROUGH if outcome.rough else Light.TRACED
                if (answer := self._contact.newest_traced(outcome.solved, outcome.light, lit, outcome.ms)) is not None:
                    self._publish(answer)
            case Shading():
                self._contact.camera.preview.shading = outcome
                self._moved_s = time.monotonic()
                self.show_again()
            case Saved():
                self._on_message(f"saved {outcome.written[0].parent} ({format_count(len(outcome.written), 'files')})")
            case Failed():
                if outcome.tracing:
                    self._traces = False
                self._on_message(outcome.reason)

    def _publish(self, answer: ContactAnswer) -> None:
        if self.newest is None and self._tracer is not None:
            self._tracer.start()  # not earlier, so that the first picture does not wait for it
        self.newest = answer
        self._on_answer(answer)


T = TypeVar("T")


class Newest(_OwnThread, Generic[T]):
    """Calls a function in its own thread with the newest item that was given. Calls do not overlap.

    Parameters
    ----------
    take : callable
    name : str
        Name of the thread.
    failed : callable, optional
        Called with the text of an error of ``take``. The thread continues.
    """

    def __init__(self, take: Callable[[T], None], name: str, failed: Callable[[str], None] = lambda text: None) -> None:
        super().__init__(name)
        self._take, self._failed = take, failed
        self._waiting: list[T] = []

    def give(self, thing: T) -> None:
        """Use this item next. An item that still waits is dropped."""
        with self._news:
            self._waiting = [thing]
            self._news.notify()

    @property
    def overtaken(self) -> bool:
        """Whether a newer item waits. For a ``take`` that can stop early."""
        return bool(self._waiting) or self._ended

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._ended or self._waiting)
                if self._ended:
                    return
                thing = self._waiting.pop()
            try:
                self._take(thing)
            except Exception as error:
                self._failed(describe_error(error))
