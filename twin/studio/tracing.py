"""Path tracing in a process of its own: the page and the moving object never wait for it, and its failure ends neither."""

import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import RenderError, TwinError
from twin.optics.preview import Shading
from twin.optics.render import Renderer
from twin.simulator import Simulator
from twin.studio.camera import PARTS, dome_renderer, dome_shading
from twin.studio.pose import PressedPose
from twin.types import ContactState, FloatArray, Form

SHOWN_S = 0.15
"""Time in s for which the first pass is left to be shown before the next one takes all cores."""
END_S = 3.0
"""Longest wait in s for the process to end by itself."""


@dataclass(frozen=True)
class Traced:
    """Path-traced light of the dome's part of the frame.

    Attributes
    ----------
    solved : int
        Number of the contact.
    light : (h, w) or (h, w, 3) float
    ms : float
        Time since the job was begun.
    rough : bool
        Whether this is the first pass, which a better picture follows unless a newer contact comes.
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
    """A job that could not be done; ``tracing`` says whether nothing at all can be path-traced here."""

    reason: str
    tracing: bool = False


@dataclass(frozen=True)
class _Trace:
    solved: int
    state: ContactState


@dataclass(frozen=True)
class _Save:
    out: Path
    touched: ObjectSpec
    pose: PressedPose
    state: ContactState
    form: Form


Outcome = Shading | Traced | Saved | Failed


class Tracer:
    """Path-traces contacts of one sensor. Of several asked at once only the newest is traced. A context manager.

    The first outcome is the preview's shading. Of a contact there are two: the first pass, and the mean of all.

    Parameters
    ----------
    spec : SensorSpec

    Attributes
    ----------
    on_outcome : callable
        Called when something has come back, in a thread of its own.
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
        self._next: _Trace | None = None

    def start(self) -> None:
        """Start the process, if it has not been started. It needs some seconds until it is ready."""
        if self._process is None:
            # not by ``multiprocessing``: that would run the user's own program again in the new process
            number = self._there.fileno()
            self._process = subprocess.Popen([sys.executable, "-c", f"from {__name__} import serve; serve({number})"], pass_fds=[number])
            self._there.close()
            self._here.send(self._spec)
            threading.Thread(target=self._receive, name="studio-tracer", daemon=True).start()

    def trace(self, solved: int, state: ContactState) -> None:
        """Ask for a contact's light. One is traced at a time; of those that are asked for until its first pass only the newest is."""
        with self._one:
            if self._tracing:
                self._next = _Trace(solved, state)
                return
            self._tracing = True
        self._send(_Trace(solved, state))

    def save(self, out: Path, touched: ObjectSpec, pose: PressedPose, state: ContactState, form: Form) -> None:
        """Ask for a contact's files in a folder that exists."""
        self._send(_Save(out, touched, pose, state, form))

    def outcomes(self) -> list[Outcome]:
        """What has come back since the last call; never waits."""
        found: list[Outcome] = []
        while self._found:
            found.append(self._found.popleft())
        return found

    def _receive(self) -> None:
        """Take what comes back as it comes: a process that waits to be heard would not hear the next job, and both would wait forever."""
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
        except (EOFError, OSError, TypeError):  # the other end, or this one, has been closed
            if not self._ended:
                self._ended = True
                self._found.append(Failed("the path tracer's process has ended; pictures stay drawn. Start the studio again", tracing=True))

    def __enter__(self) -> "Tracer":
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        with suppress(OSError):
            self._here.send(None)  # a closed socket alone does not wake the thread that reads from it
        if self._process is None:
            self._there.close()
            return
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:  # it traces or writes
            self._process.kill()
            self._process.wait()
        self._here.close()

    def _send(self, job: _Trace | _Save) -> None:
        self.start()
        if self._ended:
            return
        with suppress(OSError):  # ``outcomes`` reports that the process has ended
            self._here.send(job)


def serve(number: int) -> None:
    """Be the process: the sensor and then jobs come in by a file descriptor, outcomes go out, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is for the studio, which then ends this process
    there = Connection(number)
    try:
        spec: SensorSpec = there.recv()
        for shading in _tried(lambda: iter([dome_shading(spec)]), tracing=True):
            there.send(shading)
        jobs: deque[_Trace | _Save | None] = deque()

        def overtaken(wait_s: float) -> bool:
            while there.poll(0 if jobs else wait_s):
                jobs.append(there.recv())
            return any(job is None or isinstance(job, _Trace) for job in jobs)

        maker = _Maker(spec, overtaken)
        while (job := jobs.popleft() if jobs else there.recv()) is not None:
            for outcome in _tried(partial(maker, job), tracing=isinstance(job, _Trace)):
                there.send(outcome)
    except (EOFError, OSError):
        return


class _Maker:
    """Does the jobs; renderer and simulator are built when they are first needed. What is ``overtaken`` is not refined."""

    def __init__(self, spec: SensorSpec, overtaken: Callable[[float], bool]) -> None:
        self._spec, self._overtaken = spec, overtaken
        self._renderer: Renderer | None = None
        self._simulator: Simulator | None = None

    def __call__(self, job: _Trace | _Save) -> Iterator[Outcome]:
        return self._trace(job) if isinstance(job, _Trace) else self._save(job)

    def _trace(self, job: _Trace) -> Iterator[Traced]:
        if self._renderer is None:
            self._renderer = dome_renderer(self._spec)
        started = time.perf_counter()
        samples = [max(1, self._renderer.spp // part) for part in PARTS]
        for k, light in enumerate(self._renderer.refine(job.state, job.solved, samples=samples)):
            if k == 0 or k == len(samples) - 1:
                yield Traced(job.solved, light, 1e3 * (time.perf_counter() - started), rough=k == 0)
            if self._overtaken(SHOWN_S if k == 0 else 0.0):
                return

    def _save(self, job: _Save) -> Iterator[Saved]:
        from twin.one_contact import write_contact  # imports matplotlib, which no picture of the page needs

        if self._simulator is None:
            self._simulator = Simulator(self._spec)
        shot = self._simulator.shoot(job.state, form=job.form)
        yield Saved(write_contact(job.out, self._simulator, job.touched, job.pose, job.state, shot))


def _tried(make: Callable[[], Iterator[Outcome]], *, tracing: bool = False) -> Iterator[Outcome]:
    try:
        yield from make()
    except RenderError as error:
        yield Failed(str(error), tracing)
    except TwinError as error:
        yield Failed(str(error))
    except (RuntimeError, OSError, ValueError) as error:  # what Mitsuba, LLVM and a full disk raise
        yield Failed(f"{type(error).__name__}: {error}", tracing)
