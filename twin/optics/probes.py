"""Proofs, each in a process of its own, that a Dr.Jit backend runs here.

A backend with an unsuitable LLVM or driver ends the process instead of raising, so it is
tried in a child. Verdicts are kept in the user's cache directory, keyed by everything
that could change them.
"""

import importlib.metadata
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from twin.optics.native import PRIVATE_FOLDER

PROBE_TIMEOUT_S = 60.0

# The empty home keeps Dr.Jit from answering with a kernel it compiled (with another LLVM) before.
_PROBE = """
import drjit as dr
from drjit.{backend} import Float
x = dr.arange(Float, 64)
y = dr.minimum(dr.maximum(dr.sin(x), 0.25), dr.rcp(x + 1.5))
dr.eval(y)
assert 0 < dr.sum(y)[0] < 64
version = dr.detail.llvm_version() if "{backend}" == "llvm" and hasattr(dr.detail, "llvm_version") else ""
print("probe-ok", version)
"""


@dataclass(frozen=True)
class Verdict:
    """What a probe found: ``ok``, the backend's ``version`` ("" if it does not tell) and why not."""

    ok: bool
    version: str
    reason: str


def cache_dir() -> Path:
    """Where this package keeps what can be found out again."""
    if "TACTIP_CACHE" in os.environ:
        return Path(os.environ["TACTIP_CACHE"])
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "tactip-twin"


def probe(backend: str, library: Path, *, remember_failure: bool = True) -> Verdict:
    """Run a tiny kernel on ``backend`` ("llvm" or "cuda") with ``library``, or recall the last verdict."""
    key = "|".join(
        [
            backend,
            str(library),
            str(library.stat().st_mtime_ns),
            importlib.metadata.version("drjit"),
            os.environ.get("CUDA_VISIBLE_DEVICES", "") if backend == "cuda" else "",
        ]
    )
    store = cache_dir() / "backend-probes.json"
    known = _read(store)
    if key in known:
        return Verdict(**known[key])
    verdict = _run(backend, library)
    if verdict.ok or remember_failure:
        _write(store, _read(store) | {key: asdict(verdict)})
    return verdict


def _run(backend: str, library: Path) -> Verdict:
    with tempfile.TemporaryDirectory() as home:
        env = dict(os.environ, HOME=home, APPDATA=home, LOCALAPPDATA=home, PYTHONPATH=os.pathsep.join(p for p in sys.path if p))
        env["LD_LIBRARY_PATH"] = os.pathsep.join(filter(None, [str(PRIVATE_FOLDER), os.environ.get("LD_LIBRARY_PATH")]))
        if backend == "llvm":
            env["DRJIT_LIBLLVM_PATH"] = str(library)
        command = [sys.executable, "-c", _NO_CORE_DUMP + _PROBE.format(backend=backend)]
        try:
            done = subprocess.run(command, env=env, cwd=home, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S)
        except (subprocess.TimeoutExpired, OSError) as error:
            return Verdict(False, "", f"the probe did not finish: {error.__class__.__name__}")
    for line in done.stdout.splitlines():
        if line.startswith("probe-ok") and done.returncode == 0:
            numbers = [n for n in "".join(c if c.isdigit() else " " for c in line).split() if n != "0"]
            return Verdict(True, ".".join(numbers), "")
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    telling = [line for line in lines if "LLVM ERROR" in line or "Error" in line or "failed" in line] or lines[-1:] or ["no message"]
    how = f"killed by signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
    return Verdict(False, "", f"a tiny kernel does not run ({how}: {telling[0][:160]})")


_NO_CORE_DUMP = """
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass
"""


def _read(store: Path) -> dict:
    try:
        known = json.loads(store.read_text())
        return known if isinstance(known, dict) else {}
    except (OSError, ValueError):
        return {}


def _write(store: Path, verdicts: dict) -> None:
    """Best effort: without a writable cache every start probes again."""
    try:
        store.parent.mkdir(parents=True, exist_ok=True)
        partial = store.with_name(f"{store.name}.{os.getpid()}")
        partial.write_text(json.dumps(verdicts, indent=1))
        partial.replace(store)
    except OSError:
        return
