"""Choice of the Mitsuba variant and of the LLVM library that it uses. Only this module chooses and sets them.

Dr.Jit loads the first libLLVM that it finds. LLVM 15 and older abort the whole process at the first kernel (they have no instruction for
IEEE fminimum). Therefore a library is chosen and tested here, before Dr.Jit searches for one. Nothing is imported or set before
`use_variant` is called. `with_room` makes copies of arrays that are safe to give to Dr.Jit.

A backend with an unsuitable LLVM or driver kills the process instead of raising an exception. Therefore it is tried in a child process
(`probe`). Results are stored in the cache folder (see ``twin.store``) with a key of everything that could change them. If the cache is off,
every process makes its own test.
"""

import ctypes
import ctypes.util
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.errors import RenderError, StoreError
from twin.store import Item, cache_folder, find_json, keep_json

DrJit: TypeAlias = Any
"""A value of Dr.Jit or an object of Mitsuba. Their classes belong to the variant, which is chosen while the program runs."""


Number = TypeVar("Number", np.float32, np.uint32)

ROOM_BYTES = 64
"""Size of the widest packet: 16 numbers of 4 bytes (AVX-512)."""
OLDEST_LLVM = 16
"""Oldest usable major version of LLVM: versions 14 and 15 abort the process at the first kernel."""
BACKENDS = ("cuda", "llvm", "scalar")
REMEDY = (
    "install LLVM 16 or newer (Debian, Ubuntu: apt-get install libllvm19; macOS: brew install llvm; Windows: winget install LLVM.LLVM), "
    "or point DRJIT_LIBLLVM_PATH to its library"
)
# Folders of LLVM on Linux, macOS and Windows, beside Python's own; the folders of its library below them; and the library's names.
_ROOTS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt", "/usr/local/opt", "/opt/local/libexec", "$PROGRAMFILES")
_BELOW = ("", "lib/", "*-linux-gnu/", "llvm*/lib/", "LLVM/bin/", "Library/bin/")
_LIBRARIES = ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
_LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
_VARIANT_VARIABLE = "TACTIP_VARIANT"
PRIVATE_FOLDER = Path(sys.prefix) / "lib" / "private"
"""Folder for the copies of libraries that 'make setup' makes if it has no permission to install them."""
ATOMIC_REMEDY = "install it (Debian, Ubuntu: apt-get install libatomic1)"
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


def with_room(values: ArrayLike, dtype: type[Number]) -> NDArray[Number]:
    """A contiguous copy of ``values`` with the same shape, which is safe to give to Dr.Jit.

    Dr.Jit's vectorised variants use the memory of a NumPy array without a copy, and their kernels read it in whole packets: up to one
    packet beyond the last element. If that is beyond the end of a mapped page, the process is killed (drjit 1.5, `arr + 1` on such an
    array). Embree also reads beyond the last vertex. Therefore every array that is given to them has unused memory behind its end, at
    least ``ROOM_BYTES``. A kernel is compiled again for arrays that do not begin at a multiple of a packet's size. Therefore all copies
    begin at a multiple of ``ROOM_BYTES``.
    """
    values = np.asarray(values)
    each = np.dtype(dtype).itemsize
    room = np.zeros(values.size + 2 * (ROOM_BYTES // each), dtype)
    first = -room.ctypes.data % ROOM_BYTES // each
    out = room[first : first + values.size].reshape(values.shape)
    out[...] = values
    return out


@dataclass(frozen=True)
class LlvmLibrary:
    """One libLLVM found on this machine; ``reason`` states why it is not used ("" if it is used)."""

    path: str
    version: str
    ok: bool
    reason: str


@dataclass(frozen=True)
class VariantChoice:
    """A Mitsuba variant that works on this machine, the reason for its choice, and the LLVM library that it needs (None: none)."""

    variant: str
    reason: str
    llvm_path: str | None = None

    @property
    def backend(self) -> str:
        """ "cuda", "llvm" or "scalar"."""
        return self.variant.split("_")[0]


def find_llvm(search: Sequence[Path] | None = None) -> tuple[LlvmLibrary | None, list[LlvmLibrary]]:
    """The newest working LLVM library (or None), the user's DRJIT_LIBLLVM_PATH first; and the libraries before it, which do not work.

    Parameters
    ----------
    search : sequence of Path, optional
        Library files to consider instead of those in the usual places.
    """
    rejected = []
    wish = os.environ.get(_LLVM_VARIABLE)
    if wish:
        asked = _judge(Path(wish), asked_for=True)
        if asked.ok:
            return asked, []
        rejected.append(asked)
    for path in _newest_first(_usual_places() if search is None else search):
        library = _judge(path)
        if library.ok:
            return library, rejected
        rejected.append(library)
    return None, rejected


def find_cuda() -> tuple[bool, str]:
    """Whether a GPU works here, and the reason."""
    library = _libcuda()
    if library is None:
        return False, "no NVIDIA driver (libcuda) found"
    verdict = probe("cuda", library, remember_failure=False)
    return verdict.ok, "a tiny kernel runs on the GPU" if verdict.ok else verdict.reason


def choose_variant(channels: str = "color", prefer: str | None = None, *, llvm_search: Sequence[Path] | None = None) -> VariantChoice:
    """The fastest Mitsuba variant that works on this machine, according to tests.

    Parameters
    ----------
    channels : {"color", "mono"}
        Channels of the camera.
    prefer : {"cuda", "llvm", "scalar", "auto"} or a full variant name, optional
        The backend that must be used; the environment variable TACTIP_VARIANT takes precedence.
    llvm_search : sequence of Path, optional
        As for `find_llvm`.

    Raises
    ------
    RenderError
        The name is unknown, or the backend that must be used does not work.
    """
    override = os.environ.get(_VARIANT_VARIABLE)
    wish, source = override or prefer or "auto", _VARIANT_VARIABLE if override else "variant"
    exact = wish if wish in available_variants() else None
    backend = wish.split("_")[0] if exact else wish
    if backend not in (*BACKENDS, "auto"):
        names = ", ".join(v for v in available_variants() if v.endswith(("_rgb", "_mono")))
        raise RenderError(f"{source}={wish!r} is no variant: use auto, {', '.join(BACKENDS)}, or one of {names}")
    failed: list[str] = []
    for kind in BACKENDS if backend == "auto" else (backend,):
        choice, reason = _try(kind, exact or _name(kind, channels), llvm_search)
        if choice is not None:
            reasons = [choice.reason, *failed] if backend == "auto" else [f"asked for by {source}", choice.reason]
            return VariantChoice(choice.variant, "; ".join(reasons), choice.llvm_path)
        failed.append(f"{kind}: {reason}")
    raise RenderError(f"{source}={wish!r} does not work here: {failed[0]}; {REMEDY if backend == 'llvm' else 'use TACTIP_VARIANT=auto'}")


def use_variant(choice: VariantChoice) -> ModuleType:
    """Make ``choice`` Mitsuba's current variant and return the ``mitsuba`` module.

    Raises
    ------
    RenderError
        A library of the system that Mitsuba needs is missing.
    """
    if choice.llvm_path:
        os.environ[_LLVM_VARIABLE] = choice.llvm_path
    if missing := load_needed_libraries():
        raise RenderError(missing)
    import mitsuba as mi

    if mi.variant() != choice.variant:
        mi.set_variant(choice.variant)
    return mi


@contextmanager
def one_thread(choice: VariantChoice) -> Iterator[None]:
    """Context in which ``choice`` renders on one thread. In processes that share a machine, more threads would only wait for each other."""
    use_variant(choice)
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def available_variants() -> tuple[str, ...]:
    """Names of the variants compiled into the installed Mitsuba, without importing it.

    Raises
    ------
    RenderError
        Mitsuba is not installed.
    """
    spec = importlib.util.find_spec("mitsuba")
    if spec is None or spec.origin is None:
        raise RenderError("Mitsuba is not installed: pip install 'mitsuba>=3.9'")
    pattern = re.compile(r"((?:scalar|llvm_ad|cuda_ad)_\w+?)\.[\w.-]*(?:so|pyd)$")
    found = (pattern.match(p.name) for p in Path(spec.origin).parent.iterdir())
    return tuple(sorted(m.group(1) for m in found if m))


def report() -> dict[str, Any]:
    """The part of a diagnosis that is about rendering on this machine.

    Returns
    -------
    dict
        ``variants`` : names of the variants compiled into the installed Mitsuba.
        ``used`` : for "color" and "mono" cameras, ``variant`` (None if no variant works), ``reason`` and ``llvm_path``.
        ``llvm`` : the LLVM library in use, as `LlvmLibrary`, or None.
        ``llvm_rejected`` : libraries that were found and do not work.
        ``gpu``, ``gpu_reason`` : whether a GPU works here, and the reason.
        ``override`` : TACTIP_VARIANT.
        ``remedy`` : advice on what to install; None if no rendering is slow.
    """
    llvm, rejected = find_llvm()
    gpu, gpu_reason = find_cuda()
    used: dict[str, dict[str, str | None]] = {}
    for channels in ("color", "mono"):
        try:
            used[channels] = asdict(choose_variant(channels))
        except RenderError as error:
            used[channels] = {"variant": None, "reason": str(error), "llvm_path": None}
    return {
        "variants": list(available_variants()),
        "used": used,
        "llvm": asdict(llvm) if llvm else None,
        "llvm_rejected": [asdict(library) for library in rejected],
        "gpu": gpu,
        "gpu_reason": gpu_reason,
        "override": os.environ.get(_VARIANT_VARIABLE),
        "remedy": None if llvm or gpu else REMEDY,
    }


def _name(backend: str, channels: str) -> str:
    """The compiled variant for a camera. If scalar_mono was not compiled, colour is rendered and converted to luminance later."""
    prefix = backend if backend == "scalar" else f"{backend}_ad"
    mono = f"{prefix}_mono"
    return mono if channels == "mono" and mono in available_variants() else f"{prefix}_rgb"


def _try(backend: str, variant: str, llvm_search: Sequence[Path] | None) -> tuple[VariantChoice | None, str]:
    if variant not in available_variants():
        return None, f"{variant} is not compiled into the installed Mitsuba"
    if missing := load_needed_libraries():
        return None, missing
    if backend == "scalar":
        return VariantChoice(variant, "the scalar variant works everywhere, and is slow"), ""
    if backend == "cuda":
        works, reason = find_cuda()
        return (VariantChoice(variant, reason), "") if works else (None, reason)
    library, rejected = find_llvm(llvm_search)
    if library is None:
        return None, f"{'; '.join(f'{each.path}: {each.reason}' for each in rejected) or 'no libLLVM found'}; {REMEDY}"
    return VariantChoice(variant, f"LLVM {library.version} at {library.path}", library.path), ""


def _judge(path: Path, *, asked_for: bool = False) -> LlvmLibrary:
    version = _version(path)
    if not path.exists():
        return LlvmLibrary(str(path), version, False, f"does not exist{' (DRJIT_LIBLLVM_PATH)' if asked_for else ''}")
    if version and int(version.split(".")[0]) < OLDEST_LLVM and not asked_for:
        return LlvmLibrary(str(path), version, False, f"older than LLVM {OLDEST_LLVM}: would abort the process at the first kernel")
    verdict = probe("llvm", path)
    return LlvmLibrary(str(path), verdict.version or version, verdict.ok, verdict.reason)


def _version(path: Path) -> str:
    """Version according to a library's resolved name or folder; "" if neither states it."""
    for text in (path.resolve().name, path.name, str(path.resolve().parent)):
        match = re.search(r"(?:libLLVM[-.](?:so\.)?|llvm[-@]?)(\d+(?:\.\d+)*)", text)
        if match:
            return match.group(1)
    return ""


def _newest_first(paths: Sequence[Path]) -> list[Path]:
    distinct = {Path(p).resolve(): Path(p) for p in reversed(list(paths))}
    return sorted(distinct.values(), key=lambda p: [int(n) for n in (_version(p) or "0").split(".")], reverse=True)


def _usual_places() -> list[Path]:
    found = []
    for tool in ("/sbin/ldconfig", "/usr/sbin/ldconfig"):
        if Path(tool).exists():
            listing = subprocess.run([tool, "-p"], capture_output=True, text=True, errors="replace").stdout
            found += [Path(p) for p in re.findall(r"=> (\S*libLLVM[^\s]*)", listing)]
            break
    for root, below, library in product((*_ROOTS, sys.prefix), _BELOW, _LIBRARIES):
        found += sorted(Path(os.path.expandvars(root)).glob(below + library))
    return [p for p in found if p.exists()]


def _libcuda() -> Path | None:
    if sys.platform == "win32":
        library = Path(os.environ.get("SYSTEMROOT", "C:/Windows")) / "System32" / "nvcuda.dll"
        return library if library.exists() else None
    name = ctypes.util.find_library("cuda")
    if name is None:
        return None
    places = ["/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/lib/wsl/lib"]
    places += os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    found = (Path(place) / name for place in filter(None, places))
    return next((path for path in found if path.exists()), None)


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
    return f"libatomic.so.1 is missing, which Mitsuba needs: {ATOMIC_REMEDY}"


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
