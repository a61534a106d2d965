"""The program ``twin``, started once: each call is a fork of it, in a session of its own, with limits, and watched until it ends.

Starting Python and importing the libraries costs seconds of one core; a fork of a process that has done so costs milliseconds.
Apart from that a call is the real thing: the command line is parsed again, threads are waited for and exit functions run at its end,
and stdout, stderr and the exit code are those of a process. Run as a script this file is the process that forks; ``Program`` talks to it.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import importlib
import json
import os
import pkgutil
import resource
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

LIBRARIES = (  # whose import takes long; Mitsuba is not among them, as it starts threads, which do not survive a fork
    "cv2",
    "jinja2",
    "matplotlib.pyplot",
    "numba",
    "numpy",
    "pydantic",
    "rich.progress",
    "scipy.optimize",
    "scipy.sparse.linalg",
    "scipy.spatial",
    "skimage",
    "tomlkit",
    "torch",
    "trimesh",
    "typer",
    "zarr",
)
PACKAGES = ("scenes", "twin", "training", "hardware")
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
LOOK_S = 0.1  # between two looks at a running call
GRACE_S = 3.0  # for its helper processes to end after it
MOST_OUTPUT = 2_000_000  # bytes of stdout and of stderr that are kept
SET_CHILD_SUBREAPER = 36  # prctl(2): orphans of a call become children of the process that forks
LISTENING = "0A"  # state of a socket in /proc/net/tcp
HERE_ONLY = ("0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F")  # 127.0.0.1, ::1, ::ffff:127.0.0.1


@dataclass(frozen=True)
class Limits:
    """What a call may use: wall time, address space, size of a file it writes.

    ``end_after_s`` seconds after it consists of ``end_processes`` processes it is sent ``end_signal``: SIGINT as a terminal does, to all
    of them, others to the first alone.
    """

    seconds: float = 60.0
    memory_bytes: int = 8 << 30
    file_bytes: int = 1 << 30
    end_after_s: float = 0.0
    end_signal: int = int(signal.SIGTERM)
    end_processes: int = 1


@dataclass(frozen=True)
class Ended:
    """How a call ended.

    Attributes
    ----------
    exit : int
        Exit code; minus the signal's number where one ended it.
    stdout, stderr : str
    seconds, cpu_s : float
        Wall time, and time on a core.
    peak_bytes : int
        Largest resident memory of its first process.
    timed_out : bool
    left_running : int
        Processes of the call that had not ended ``GRACE_S`` after it (they are ended then).
    open_to_network : list of str
        Addresses beyond this machine's own on which it listened at any look.
    """

    exit: int
    stdout: str
    stderr: str
    seconds: float
    cpu_s: float
    peak_bytes: int
    timed_out: bool
    left_running: int
    open_to_network: list[str] = field(default_factory=list)


class Program:
    """``twin``, ready to be called.

    Parameters
    ----------
    home : Path
        Becomes the user's home, with the caches below it.
    """

    def __init__(self, home: Path) -> None:
        home.mkdir(parents=True, exist_ok=True)
        root = str(Path(__file__).parents[2])
        places = {"HOME": str(home), "XDG_CONFIG_HOME": str(home / ".config"), "TACTIP_CACHE": str(home / "cache"), "TMPDIR": str(home)}
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        env = os.environ | ONE_THREAD | places | {"PYTHONPATH": path, "PYTHONHASHSEED": "0", "COLUMNS": "100", "MPLBACKEND": "agg"}
        env.pop("TACTIP_SPECS", None)
        self._server = subprocess.Popen([sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=env, text=True)

    def call(self, *arguments: object, folder: Path, limits: Limits | None = None, env: dict[str, str] | None = None) -> Ended:
        """Call ``twin`` with ``arguments`` in ``folder``, and wait for its end; with an ``env`` of its own Python starts again for it."""
        asked = {"arguments": [str(a) for a in arguments], "folder": str(folder), "env": env or {}, "limits": asdict(limits or Limits())}
        assert self._server.stdin and self._server.stdout
        self._server.stdin.write(json.dumps(asked) + "\n")
        self._server.stdin.flush()
        answer = self._server.stdout.readline()
        if not answer:
            raise RuntimeError(f"the process that forks ended with {self._server.wait()}")
        return Ended(**json.loads(answer))

    def close(self) -> None:
        """End the process that forks."""
        assert self._server.stdin and self._server.stdout
        self._server.stdin.close()
        self._server.wait(timeout=30)
        self._server.stdout.close()

    def __enter__(self) -> Program:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _serve() -> list[str] | None:
    """Answer requests until they end; in a fork: the arguments that it is to run with."""
    ctypes.CDLL(None).prctl(SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    for line in requests:
        asked = json.loads(line)
        limits = Limits(**asked["limits"])
        (out_read, out_write), (err_read, err_write) = os.pipe(), os.pipe()
        started = time.monotonic()
        pid = os.fork()
        if not pid:
            _become(asked, limits, out_write, err_write, keep_not=(requests.fileno(), answers.fileno(), out_read, err_read))
            return asked["arguments"]
        os.close(out_write)
        os.close(err_write)
        ended = _watch(pid, out_read, err_read, limits, started)
        answers.write(json.dumps(asdict(ended)) + "\n")
        answers.flush()
    return None


def _become(asked: dict, limits: Limits, out: int, err: int, *, keep_not: tuple[int, ...]) -> None:
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that starts tests in the background has it ignored
    os.dup2(out, 1)
    os.dup2(err, 2)
    for descriptor in (out, err, *keep_not):
        os.close(descriptor)
    os.chdir(asked["folder"])
    resource.setrlimit(resource.RLIMIT_AS, (limits.memory_bytes, limits.memory_bytes))
    resource.setrlimit(resource.RLIMIT_FSIZE, (limits.file_bytes, limits.file_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if asked["env"]:
        start = [sys.executable, "-c", "import sys; sys.argv[0] = 'twin'; from twin.cli import main; main()", *asked["arguments"]]
        os.execve(sys.executable, start, os.environ | asked["env"])


def _watch(pid: int, out: int, err: int, limits: Limits, started: float) -> Ended:
    kept = {out: bytearray(), err: bytearray()}
    opened: set[str] = set()
    status, usage, timed_out, told = None, None, False, False
    complete: float | None = None  # when it consisted of all its processes
    with selectors.DefaultSelector() as looked:
        for descriptor in kept:
            looked.register(descriptor, selectors.EVENT_READ)
        while status is None:
            for key, _ in looked.select(LOOK_S):
                data = os.read(key.fd, 1 << 16)
                if data:
                    kept[key.fd] += data[: MOST_OUTPUT - len(kept[key.fd])]
                else:
                    looked.unregister(key.fd)
            if not looked.get_map():
                time.sleep(LOOK_S)
            family = _family(pid)
            opened |= _listening(family)
            passed = time.monotonic() - started
            if complete is None and len(family) >= limits.end_processes:
                complete = passed
            if limits.end_after_s and complete is not None and passed > complete + limits.end_after_s and not told:
                told = True
                (os.killpg if limits.end_signal == signal.SIGINT else os.kill)(pid, limits.end_signal)
            if passed > limits.seconds and not timed_out:
                timed_out = True
                _end(_family(pid))
            ended, code, used = os.wait4(pid, os.WNOHANG)
            if ended:
                status, usage = os.waitstatus_to_exitcode(code), used
        seconds = time.monotonic() - started
        left = _left_after(GRACE_S)
        for descriptor in (key.fd for key in list(looked.get_map().values())):
            os.set_blocking(descriptor, False)
            with contextlib.suppress(BlockingIOError):
                while data := os.read(descriptor, 1 << 16):
                    kept[descriptor] += data[: MOST_OUTPUT - len(kept[descriptor])]
    os.close(out)
    os.close(err)
    texts = [bytes(kept[descriptor]).decode("utf-8", "backslashreplace") for descriptor in (out, err)]
    return Ended(status, *texts, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024, timed_out, left, sorted(opened))


def _family(first: int) -> list[int]:
    """A process and all below it."""
    found = [first]
    for pid in found:
        with contextlib.suppress(OSError):
            for task in os.listdir(f"/proc/{pid}/task"):
                found += map(int, Path(f"/proc/{pid}/task/{task}/children").read_text().split())
    return found


def _left_after(seconds: float) -> int:
    """How many of this process's children are left after a time; they are ended."""
    until = time.monotonic() + seconds
    while True:
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        left = _family(os.getpid())[1:]
        if not left or time.monotonic() > until:
            break
        time.sleep(LOOK_S)
    _end(left)
    with contextlib.suppress(ChildProcessError):
        while left and os.waitpid(-1, 0)[0]:
            pass
    return len(left)


def _end(pids: list[int]) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _listening(pids: list[int]) -> set[str]:
    """Addresses and ports on which these processes listen, of all but this machine's own."""
    inodes = set()
    for pid in pids:
        with contextlib.suppress(OSError):
            for descriptor in os.listdir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):
                    target = os.readlink(f"/proc/{pid}/fd/{descriptor}")
                    if target.startswith("socket:["):
                        inodes.add(target[8:-1])
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6") if inodes else ():
        with contextlib.suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                cells = line.split()
                address, port = cells[1].split(":")
                if cells[3] == LISTENING and cells[9] in inodes and address not in HERE_ONLY:
                    found.add("any address" if not int(address, 16) else address)
    return found


def _import_all() -> None:
    """Do what the calls would do each for itself: import the libraries and every module of the program, make Numba ready."""
    for name in LIBRARIES:
        importlib.import_module(name)
    sys.modules["numba"].njit(_nothing)()  # its first function fills tables that all others need, which takes half of a short call
    for package in PACKAGES:
        for found in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            importlib.import_module(found.name)
    if len(os.listdir("/proc/self/task")) > 1:
        raise RuntimeError("an import started a thread, which would not survive a fork")


def _nothing() -> None:
    """The shortest function."""


def _run(main: Callable[[], None]) -> None:
    """Run the program and end as the interpreter does, but for taking down all modules, which costs more than most calls."""
    code = 0
    try:
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        code = 130 if isinstance(error, KeyboardInterrupt) else 1
    threading._shutdown()  # type: ignore[attr-defined]  # waits for threads that are no daemons
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(code)


if __name__ == "__main__":
    _import_all()
    from twin.cli import main

    gc.collect()
    gc.freeze()  # otherwise each fork goes through all that was imported when it ends, which takes a second
    arguments = _serve()
    if arguments is not None:
        sys.argv = ["twin", *arguments]
        _run(main)
