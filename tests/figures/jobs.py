"""A job measures some figures; ``figures.json`` keeps what it found until its inputs change.

A job's inputs are the sensors' specifications, shipped files such as weights, and the code that it runs: its own function, and the modules
that it names with all that these import. ``fingerprint`` is the one place that says what code counts.
"""

import hashlib
import inspect
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from time import perf_counter
from unittest.mock import patch

from bench_gpu import gpu_name

from scenes import SensorSpec, load_sensor
from twin import store
from twin.evaluation.pictures.aligned import with_changes
from twin.optics.relief import DETAILS, without
from twin.store.fingerprint import CodeOf

ROOT = Path(__file__).parents[2]
FIGURES = ROOT / "figures.json"
WORK = ROOT / "out" / "figures"
TAIL = 2000  # characters of a failed command's output that are shown


class FiguresError(Exception):
    """A figure can't be measured or named; says why and what to do."""


@dataclass(frozen=True)
class Value:
    """A measured number and its unit ("" for a plain number; shares are fractions)."""

    value: float
    unit: str = ""


Measured = dict[str, Value]


@dataclass(frozen=True)
class Job:
    """How some figures are measured.

    Attributes
    ----------
    name : str
        ``family.what``; figures are called ``name.figure``.
    measure : callable
        From the job's own folder, which is kept between runs, to its figures.
    command : str
        What a reader would type to get the same.
    sensors : tuple of str
        Whose specifications it depends on.
    beside : tuple of str
        What it does not depend on: parts of these specifications, and packages of code (``NO_PICTURES``, ``NO_RESIDUAL``).
    code : tuple of str
        Modules that compute the figures (a package: all of its modules). All that they import counts, too. Benches are named as well.
    shipped : tuple of str
        Files or folders of the packages, such as weights, whose content it depends on.
    recordings : tuple of str
        Folders of ``TACTIP_REAL`` that it needs.
    minutes : float
        About how long it takes on two cores.
    gpu : bool
        Whether it needs a GPU.
    """

    name: str
    measure: Callable[[Path], Measured]
    command: str
    sensors: tuple[str, ...]
    code: tuple[str, ...]
    recordings: tuple[str, ...]
    minutes: float
    shipped: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    gpu: bool = False

    @property
    def family(self) -> str:
        """The name's first part."""
        return self.name.split(".")[0]


JOBS: dict[str, Job] = {}


def job(
    name: str,
    command: str,
    *,
    sensors: tuple[str, ...] = (),
    code: tuple[str, ...],
    shipped: tuple[str, ...] = (),
    recordings: tuple[str, ...] = (),
    minutes: float = 1.0,
    beside: tuple[str, ...] = (),
    gpu: bool = False,
) -> Callable:
    """Register a function as the job of that name."""

    def register(measure: Callable[[Path], Measured]) -> Callable[[Path], Measured]:
        if name in JOBS:
            raise FiguresError(f"two jobs are called {name!r}")
        JOBS[name] = Job(name, measure, command, sensors, code, recordings, minutes, shipped, beside, gpu)
        return measure

    return register


def real_folder(recording: str = "") -> Path:
    """A folder of the real recordings."""
    return Path(os.environ.get("TACTIP_REAL", ROOT / "../shared/real")) / recording


def run_twin(work: Path, *arguments: object) -> str:
    """``twin ARGUMENTS`` in a process of its own; its output, which is also kept in ``work/log.txt``.

    Raises
    ------
    FiguresError
        It fails.
    """
    work.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", "from twin.cli import main; main()", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=ROOT)
    (work / "log.txt").write_text(f"twin {' '.join(map(str, arguments))}\n\n{done.stdout}\n{done.stderr}")
    if done.returncode:
        raise FiguresError(f"twin {' '.join(map(str, arguments))}\nended with {done.returncode}: {done.stderr[-TAIL:]}")
    return done.stdout


NO_RESIDUAL = ("residual",)
"""``Job.beside`` of a job that uses no residual network, or teaches one."""
RENDERING = "twin.optics"
NO_PICTURES = (*DETAILS, *NO_RESIDUAL, RENDERING)
"""``Job.beside`` of a job that renders nothing: neither measured details of pictures, a residual network nor the renderer's code change its
figures. While such a job runs, rendering is an error (`without_rendering`)."""


def specification_digest(sensors: tuple[str, ...], beside: tuple[str, ...] = ()) -> str:
    """Digest of the resolved specifications, however their files are laid out, without the parts ``beside``."""
    text = "\n".join(_shortened(load_sensor(name), beside).model_dump_json() for name in sensors)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _shortened(spec: SensorSpec, beside: tuple[str, ...]) -> SensorSpec:
    """A specification without some of its parts."""
    if "residual" in beside:
        spec = with_changes(spec, response={"residual": None})
    return without(spec, [name for name in beside if name in DETAILS])


DRAWN = ("twin.optics.sampling",)
"""``Job.beside`` of a job whose pictures are rasterised: the random numbers of the picture that shading is fitted to change no figure."""
UNMEASURED = ("twin.cli", "twin.report")
"""Packages whose code changes no figure: the command line's words and the pages' looks."""


def code_behind(*names: str, beside: tuple[str, ...] = ()) -> CodeOf:
    """The code that may change a figure of a job which names these modules and packages: modules, and versions of libraries.

    Parameters
    ----------
    names
        As in ``Job.code``.
    beside
        As ``Job.beside``: code of these packages does not count.

    Raises
    ------
    FiguresError
        There is no such package or module.
    """
    modules: list[str] = []
    for name in names:
        place = ROOT / name.replace(".", "/")
        files = sorted(place.rglob("*.py")) or [path for path in (place.with_suffix(".py"),) if path.is_file()]
        if not files and name not in sys.modules:
            raise FiguresError(f"a figure depends on the code of {name!r}, which is no module; name one such as 'training.surrogate'")
        found = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in files]
        modules += found or [name]  # a bench, which lies outside of the packages
    found = store.code_of(*modules)
    unneeded = tuple(f"{package}." for package in (*UNMEASURED, *beside))
    return replace(found, modules={name: digest for name, digest in found.modules.items() if not f"{name}.".startswith(unneeded)})


def shipped_digest(names: tuple[str, ...]) -> str:
    """Of the content of files, and of all files in folders."""
    digest = hashlib.sha256()
    for name in names:
        place = ROOT / name
        files = sorted(path for path in place.rglob("*") if path.is_file()) or [place]
        for path in files:
            digest.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def fingerprint(made: Job) -> str:
    """Of the code that a job runs: the modules that it names with all that they import, its own function, and what is bound to it."""
    measure, bound = made.measure, ""
    if isinstance(measure, partial):
        measure, bound = measure.func, repr(sorted(measure.keywords.items()))
    behind = code_behind(*made.code, beside=made.beside)
    if made.gpu:  # PyTorch is another build there; ``machine`` says which
        behind = replace(behind, libraries={})
    code, shipped = behind.fingerprint, shipped_digest(made.shipped)
    return hashlib.sha256(f"{code}\n{inspect.getsource(measure)}\n{bound}\n{shipped}".encode()).hexdigest()[:16]


def key_of(made: Job) -> dict[str, str]:
    """What must not have changed for a job's figures to count."""
    return {"specification": specification_digest(made.sensors, made.beside), "fingerprint": fingerprint(made)}


def read(path: Path = FIGURES) -> dict[str, dict]:
    """What is kept, by job."""
    return json.loads(path.read_text())["jobs"] if path.is_file() else {}


def values(path: Path = FIGURES) -> dict[str, Value]:
    """Every kept figure by its whole name."""
    kept = read(path)
    return {f"{name}.{figure}": Value(**found) for name, entry in kept.items() for figure, found in entry["figures"].items()}


def is_kept(made: Job, path: Path = FIGURES) -> bool:
    """Whether a job's figures are there and its inputs are what they were."""
    entry = read(path).get(made.name)
    return entry is not None and {key: entry[key] for key in ("specification", "fingerprint")} == key_of(made)


def lacking(made: Job) -> str:
    """What a job needs and this machine does not have; "" if nothing."""
    absent = [name for name in made.recordings if not real_folder(name).is_dir()]
    if absent:
        return f"recordings {', '.join(absent)} (set TACTIP_REAL)"
    return "a GPU" if made.gpu and not gpu_name() else ""


def run(made: Job, path: Path = FIGURES, work: Path = WORK) -> Measured:
    """Measure a job's figures and keep them; others stay as they are."""
    key, started = key_of(made), perf_counter()
    folder = work / made.name / key["fingerprint"]
    folder.mkdir(parents=True, exist_ok=True)
    with without_rendering() if RENDERING in made.beside else nullcontext():
        found = made.measure(folder)
    entry = {
        "command": made.command,
        **key,
        "commit": _commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(made.gpu),
        "minutes": round((perf_counter() - started) / 60, 2),
        "figures": {name: asdict(value) for name, value in found.items()},
    }
    _write(path, read(path) | {made.name: entry})
    return found


def without_rendering() -> AbstractContextManager[object]:
    """Context in which the renderer refuses to trace a path, in this process and in all that it starts."""
    return patch.dict(os.environ, TACTIP_VARIANT="none, because this figure is said to need no picture")


def machine(gpu: bool = False) -> str:
    """Processor and number of cores, and on request the GPU and PyTorch's version."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    more = f", {gpu_name()}, PyTorch {metadata.version('torch')}" if gpu else ""
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores{more}"


def _commit() -> str:
    """The commit, with ``+`` where the tree differs from it; "" without history."""
    try:
        commit, changed = (
            subprocess.run(["git", "-C", str(ROOT), *command], capture_output=True, text=True, check=True).stdout.strip()
            for command in (("rev-parse", "--short=12", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit + "+" * bool(changed)


def _write(path: Path, jobs: dict[str, dict]) -> None:
    """Whole or not at all."""
    text = json.dumps({"jobs": dict(sorted(jobs.items()))}, indent=1) + "\n"
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=f"{path.name}.", suffix=".part", delete=False) as file:
        file.write(text)
    Path(file.name).chmod(0o644)
    os.replace(file.name, path)
