"""Path tracing in a separate process. The page and the moving object never wait for it, and continue if it fails."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import Pipe, connection
from multiprocessing.connection import Connection
from pathlib import Path

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import RenderError, TwinError
from twin.objects import build_field
from twin.optics.preview import Shading
from twin.optics.render import Renderer
from twin.report.skin3d import SkinPainter
from twin.simulator import Simulator
from twin.studio.camera import PARTS, dome_renderer, dome_shading
from twin.studio.pose import PressedPose
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


@dataclass(frozen=True)
class _Trace:
    solved: int
    state: ContactState


@dataclass(frozen=True)
class _Save:
    out: Path
    obj: ObjectSpec
    pose: PressedPose
    state: ContactState
    form: Form


Outcome = Shading | Traced | Saved | Failed


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
        self._next: _Trace | None = None

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
                self._next = _Trace(solved, state)
                return
            self._tracing = True
        self._send(_Trace(solved, state))

    def save(self, out: Path, obj: ObjectSpec, pose: PressedPose, state: ContactState, form: Form) -> None:
        """Request a contact's files in a folder that exists."""
        self._send(_Save(out, obj, pose, state, form))

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

    def _send(self, job: _Trace | _Save) -> None:
        self.start()
        if self._ended:
            return
        with suppress(OSError):  # ``outcomes`` reports that the process has ended
            self._here.send(job)


def serve(number: int) -> None:
    """Run the process: receive the sensor and then jobs through a file descriptor, and send outcomes, until that is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal ends the studio, which then ends this process
    there = getattr(connection, "PipeConnection", Connection)(number)  # Windows has a class of its own for pipes
    jobs: deque[_Trace | _Save | None] = deque()

    def overtaken(wait_s: float) -> bool:
        while there.poll(0 if jobs else wait_s):
            jobs.append(there.recv())
        return any(job is None or isinstance(job, _Trace) for job in jobs)

    try:
        spec: SensorSpec = there.recv()
        renderer, simulator = cache(partial(dome_renderer, spec)), cache(partial(Simulator, spec))  # built when they are first needed
        for shading in _catch_render_errors(lambda: iter([dome_shading(spec)]), tracing=True):
            there.send(shading)
        while (job := jobs.popleft() if jobs else there.recv()) is not None:
            do = partial(_trace, job, renderer, overtaken) if isinstance(job, _Trace) else partial(_save, job, simulator)
            for outcome in _catch_render_errors(do, tracing=isinstance(job, _Trace)):
                there.send(outcome)
    except (EOFError, OSError):
        return


def _trace(job: _Trace, renderer: Callable[[], Renderer], overtaken: Callable[[float], bool]) -> Iterator[Outcome]:
    """Trace a contact pass by pass, until a newer one has ``overtaken`` it."""
    samples = [max(1, renderer().spp // part) for part in PARTS]
    started = time.perf_counter()
    for k, light in enumerate(renderer().refine(job.state, job.solved, samples=samples)):
        if k == 0 or k == len(samples) - 1:
            yield Traced(job.solved, light, 1e3 * (time.perf_counter() - started), rough=k == 0)
        if overtaken(SHOWN_S if k == 0 else 0.0):
            return


def _save(job: _Save, simulator: Callable[[], Simulator]) -> Iterator[Outcome]:
    from twin.one_contact import write_contact  # imports matplotlib, which no picture of the page needs

    made = simulator()
    with SkinPainter() as painter:
        painter.draw_contact(made.solver.mesh, made.spec.pins, job.state, build_field(job.obj))
        rendered = made.render(job.state, form=job.form)
        yield Saved(write_contact(job.out, made, job.obj, job.pose, job.state, rendered, painter)[0])


def _catch_render_errors(make: Callable[[], Iterator[Outcome]], *, tracing: bool = False) -> Iterator[Outcome]:
    try:
        yield from make()
    except TwinError as error:
        yield Failed(str(error), tracing and isinstance(error, RenderError))
    except (RuntimeError, OSError, ValueError) as error:  # raised by Mitsuba and LLVM, and if the disk is full
        yield Failed(f"{type(error).__name__}: {error}", tracing)
