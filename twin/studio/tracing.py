"""Path tracing in a process of its own: the page and the moving object never wait for it, and its failure ends neither."""

import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import RenderError, TwinError
from twin.geometry.mesh import build_mesh
from twin.one_contact import write_contact
from twin.optics.preview import Shading
from twin.optics.render import Renderer
from twin.simulator import Simulator
from twin.studio.camera import QUALITY, dome_shading, dome_window
from twin.studio.pose import PressedPose
from twin.types import ContactState, FloatArray, Form

END_S = 3.0
"""Longest wait in s for the process to end by itself."""


@dataclass(frozen=True)
class Traced:
    """Path-traced light of the dome's part of the frame.

    Attributes
    ----------
    number : int
        The answer's.
    light : (h, w) or (h, w, 3) float
    ms : float
    """

    number: int
    light: FloatArray
    ms: float


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
    number: int
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

    The first outcome is the preview's shading.

    Parameters
    ----------
    spec : SensorSpec
    """

    def __init__(self, spec: SensorSpec) -> None:
        self._spec = spec
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

    def trace(self, number: int, state: ContactState) -> None:
        """Ask for an answer's light. One is traced at a time; of those that are asked for meanwhile only the newest is."""
        with self._one:
            if self._tracing:
                self._next = _Trace(number, state)
                return
            self._tracing = True
        self._send(_Trace(number, state))

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
                if isinstance(outcome, Traced):
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
        there.send(_tried(lambda: dome_shading(spec), tracing=True))
        maker = _Maker(spec)
        while (job := there.recv()) is not None:
            there.send(_tried(partial(maker, job), tracing=isinstance(job, _Trace)))
    except (EOFError, OSError):
        return


class _Maker:
    """Does the jobs; renderer and simulator are built when they are first needed."""

    def __init__(self, spec: SensorSpec) -> None:
        self._spec = spec
        self._renderer: Renderer | None = None
        self._simulator: Simulator | None = None

    def __call__(self, job: _Trace | _Save) -> Outcome:
        return self._trace(job) if isinstance(job, _Trace) else self._save(job)

    def _trace(self, job: _Trace) -> Traced:
        if self._renderer is None:
            self._renderer = Renderer(self._spec, quality=QUALITY, mesh=build_mesh(self._spec.geometry), window_px=dome_window(self._spec))
        started = time.perf_counter()
        light = self._renderer.render(job.state, seed=job.number)
        return Traced(job.number, light, 1e3 * (time.perf_counter() - started))

    def _save(self, job: _Save) -> Saved:
        if self._simulator is None:
            self._simulator = Simulator(self._spec)
        shot = self._simulator.shoot(job.state, form=job.form)
        return Saved(write_contact(job.out, self._simulator, job.touched, job.pose, job.state, shot))


def _tried(make: Callable[[], Outcome], *, tracing: bool = False) -> Outcome:
    try:
        return make()
    except RenderError as error:
        return Failed(str(error), tracing)
    except TwinError as error:
        return Failed(str(error))
    except (RuntimeError, OSError, ValueError) as error:  # what Mitsuba, LLVM and a full disk raise
        return Failed(f"{type(error).__name__}: {error}", tracing)
