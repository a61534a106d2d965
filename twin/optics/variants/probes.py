"""Tests whether a Dr.Jit backend works on this machine, each in a separate process; and loading of libatomic, which Dr.Jit needs.

A backend with an unsuitable LLVM or driver kills the process instead of raising an exception. Therefore it is tried in a child process.
Results are stored in the cache folder (see ``twin.store``) with a key of everything that could change them. If the cache is off, every
process makes its own test.
"""

import ctypes
import importlib.metadata
import os
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from twin.errors import StoreError
from twin.store import Item, cache_folder, find_json, keep_json

PRIVATE_FOLDER = Path(sys.prefix) / "lib" / "private"
"""Folder for the copies of libraries that 'make setup' makes if it has no permission to install them."""
REMEDY = "install it (Debian, Ubuntu: apt-get install libatomic1)"
"""Advice in the message that libatomic is missing."""
PROBE_TIMEOUT_S = 60.0
"""Time after which a probe counts as failed, s."""

# Dr.Jit gets an empty home folder, so that it does not use a kernel that it compiled before with another LLVM.
_PROBE = """
try:  # no core dump
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
import drjit as dr
from drjit.{backend} import Float
x = dr.arange(Float, 64)
y = dr.minimum(dr.maximum(dr.sin(x), 0.25), dr.rcp(x + 1.5))
dr.eval(y)
assert 0 < dr.sum(y)[0] < 64
version = dr.detail.llvm_version() if "{backend}" == "llvm" and hasattr(dr.detail, "llvm_version") else ""
print("probe-ok", version)
"""


def load_needed_libraries(folder: Path = PRIVATE_FOLDER) -> str:
    """Load libatomic so that Dr.Jit finds it: the system's, else the private copy in ``folder``.

    Returns
    -------
    str
        "" if it was loaded, else what is missing and the remedy.
    """
    if not sys.platform.startswith("linux"):
        return ""
    for library in ("libatomic.so.1", str(folder / "libatomic.so.1")):
        try:
            ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
            return ""
        except OSError:
            continue
    return f"libatomic.so.1 is missing, which Mitsuba needs: {REMEDY}"


@dataclass(frozen=True)
class ProbeResult:
    """Result of a probe: ``ok``, the backend's ``version`` ("" if unknown), and the reason if it does not work."""

    ok: bool
    version: str
    reason: str


def probe(backend: str, library: Path, *, remember_failure: bool = True) -> ProbeResult:
    """Run a tiny kernel on ``backend`` ("llvm" or "cuda") with ``library``, or return the stored result."""
    devices = os.environ.get("CUDA_VISIBLE_DEVICES", "") if backend == "cuda" else ""
    tried = [str(library), library.stat().st_mtime_ns, importlib.metadata.version("drjit"), devices]
    item = Item(f"backend-{backend}", (__name__,), tried)
    folder = cache_folder()
    if folder is None:
        return _run_once(item.file, backend, library)
    known = find_json(folder, item)
    if known is not None:
        return ProbeResult(**known)
    verdict = _run(backend, library)
    if verdict.ok or remember_failure:
        with suppress(StoreError):  # if the cache can't be written, the next start probes again
            keep_json(folder, item, asdict(verdict))
    return verdict


@cache
def _run_once(key: str, backend: str, library: Path) -> ProbeResult:
    return _run(backend, library)


def _run(backend: str, library: Path) -> ProbeResult:
    with tempfile.TemporaryDirectory() as home:
        env = dict(os.environ, HOME=home, APPDATA=home, LOCALAPPDATA=home, PYTHONPATH=os.pathsep.join(p for p in sys.path if p))
        env["LD_LIBRARY_PATH"] = os.pathsep.join(filter(None, [str(PRIVATE_FOLDER), os.environ.get("LD_LIBRARY_PATH")]))
        if backend == "llvm":
            env["DRJIT_LIBLLVM_PATH"] = str(library)
        command = [sys.executable, "-c", _PROBE.format(backend=backend)]
        try:
            done = subprocess.run(command, env=env, cwd=home, capture_output=True, text=True, errors="replace", timeout=PROBE_TIMEOUT_S)
        except (subprocess.TimeoutExpired, OSError) as error:
            return ProbeResult(False, "", f"the probe did not finish: {error.__class__.__name__}")
    for line in done.stdout.splitlines():
        if line.startswith("probe-ok") and done.returncode == 0:
            numbers = [n for n in "".join(c if c.isdigit() else " " for c in line).split() if n != "0"]
            return ProbeResult(True, ".".join(numbers), "")
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    telling = [line for line in lines if "LLVM ERROR" in line or "Error" in line or "failed" in line] or lines[-1:] or ["no message"]
    how = f"killed by signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
    return ProbeResult(False, "", f"a tiny kernel does not run ({how}: {telling[0][:160]})")
