"""Time contacts: against the first version of the solver, and against unknowns, load-step size, a mesh's triangles and processes.

Run by ``make bench``, or: PYTHONPATH=. python tests/bench/bench_mechanics.py [--repeats 3] [--out out/bench]. Times are CPU seconds on
one thread, the least of the repeats, so that what is compiled on the first is left out. The first version is taken from this repository's
history and runs in a process of its own, on the same contacts; without that history only absolute figures are printed.
"""

import argparse
import io
import json
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
from multiprocessing import active_children
from pathlib import Path
from time import perf_counter, process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
ROOT = Path(__file__).parents[2]

import numpy as np  # noqa: E402
import trimesh  # noqa: E402

import twin  # noqa: E402
from scenes import load_object, load_sensor  # noqa: E402
from twin.errors import ContactError  # noqa: E402
from twin.mechanics.path import ContactPose  # noqa: E402
from twin.mechanics.solver import SkinSolver  # noqa: E402

if (Path(twin.__file__).parent / "stimulus").is_dir():  # this file also runs in the tree of the first version
    from twin.stimulus.mesh_field import sample_mesh
else:
    from twin.objects.mesh_field import sample_mesh

FIRST_VERSION = "c3e0227"
SENSOR = "mg400-331"
MATERIAL = {"skin": (0.7, 0.47), "gel": (0.02, 0.47)}  # held, whatever the sensor's is now: Young's modulus (MPa), Poisson's ratio
FRICTION = 0.5
TAP_AND_SHEAR = ContactPose(4.0, tilt_deg=(0.0, 10.0), shear_mm=(1.5, 0.0))
BALL = "sphere as 20480 triangles"
CONTACTS = {
    "plane, tap and shear": ("plane", TAP_AND_SHEAR),
    "sphere": ("sphere", ContactPose(3.5)),
    BALL: (BALL, ContactPose(3.5)),
    "mesh-can": ("mesh-can", ContactPose(3.0)),
}
ACROSS, STEPS_MM = (8, 12, 16, 20, 24), (0.15, 0.3, 0.4, 0.6, 1.2)
JOBS, PROCESSES = 12, (1, 2)


def plain_sensor():
    """The sensor with rubber that every version knows."""
    spec, parts = load_sensor(SENSOR), {}
    for name, (young, poisson) in MATERIAL.items():
        part = getattr(spec, name)
        shape = {key: getattr(part, key) for key in ("outer_radius_mm", "thickness_mm", "rim_z_mm") if hasattr(part, key)}
        parts[name] = type(part)(young_modulus_mpa=young, poisson_ratio=poisson, **shape)
    return spec.model_copy(update=parts)


def time_path(solver, stimulus, pose, repeats, **options):
    """CPU seconds for a path, its number of states, and the force at its end in N; what went wrong instead of the force."""
    best = np.inf
    for _ in range(repeats):
        start, forces_n = process_time(), []
        try:
            for _, state in solver.path(stimulus, pose, friction=FRICTION, **options):
                forces_n.append(float(state.force_n[2]))
        except ContactError as error:
            return process_time() - start, max(len(forces_n), 1), str(error)
        best = min(best, process_time() - start)
    return best, len(forces_n), forces_n[-1]


def time_contacts(repeats):
    """``time_path`` of every contact with whichever version of the program is imported, and the seconds to sample the mesh."""
    solver, out = SkinSolver(plain_sensor()), {}
    ball = trimesh.creation.icosphere(subdivisions=5, radius=load_object("sphere").shape.radius_mm)
    ball.apply_translation([0, 0, -ball.bounds[0, 2]])
    start = process_time()
    field = sample_mesh(ball)
    out["sampling"] = process_time() - start
    for title, (name, pose) in CONTACTS.items():
        out[title] = time_path(solver, field if name == BALL else load_object(name), pose, repeats)
    return out


def in_child(repeats, folder=None):
    """``time_contacts`` in a fresh process, of the program in a folder."""
    environment = dict(os.environ) | {"PYTHONPATH": str(folder or ROOT)}
    command = [sys.executable, __file__, "--only-times", "--repeats", str(repeats)]
    done = subprocess.run(command, env=environment, cwd=folder or ROOT, stdout=subprocess.PIPE, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    if Path(found.pop("where")) != Path(folder or ROOT).resolve():
        raise SystemExit(f"timed another program than the one in {folder}")
    return found


def first_version(repeats):
    """``time_contacts`` of the first version; None where there is no history."""
    try:
        archive = subprocess.run(["git", "-C", ROOT, "archive", FIRST_VERSION, "twin", "scenes"], capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
            tar.extractall(folder, filter="data")
        return in_child(repeats, Path(folder))


def print_contacts(repeats):
    """Table of the contacts, beside the first version's."""
    now, first = in_child(repeats), first_version(repeats)
    if first is None:
        print(f"no git history with {FIRST_VERSION} here: no ratio to the first version, absolute figures only")
    beside = f"{'first: s':>10s}{'states':>8s}{'ratio':>7s}{'per state':>11s}" if first else ""
    print(f"{'contact':28s}{'s to the end':>14s}{'states':>8s}{'ms per state':>14s}{beside}")
    for title in CONTACTS:
        seconds, states, end = now[title]
        line, failed = f"{title:28s}{seconds:14.2f}{states:8d}{1e3 * seconds / states:14.0f}", [end] * isinstance(end, str)
        if first:
            first_seconds, first_states, end = first[title]
            line += f"{first_seconds:10.2f}{first_states:8d}{first_seconds / seconds:7.1f}"
            line += f"{first_seconds / first_states / seconds * states:11.1f}"
            failed += [f"first: {end}"] * isinstance(end, str)
        print(line + "".join(f"  not to the end, {why}" for why in failed))
    (mesh_s, _, mesh_n), (ball_s, _, ball_n) = now[BALL], now["sphere"]
    print(f"mesh / analytic sphere: {mesh_s / ball_s:.2f} times the cost, end: {mesh_n} / {ball_n} N; ", end="")
    print(f"sampling the mesh, once: {now['sampling']:.2f} s")


def print_scaling(repeats, out):
    """Tables and a chart: cost against unknowns, and against the size of the load steps."""
    from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

    from twin.geometry.solid import Resolution, build_solid
    from twin.report.charts import new_figure

    spec, plane = plain_sensor(), load_object("plane")
    head = f"{'s to the end':>14s}{'states':>8s}{'ms per state':>14s}{'normal force, N':>17s}"

    def row(seconds, states, force_n):
        end = f"{force_n:17.4f}" if isinstance(force_n, float) else f"  {force_n}"
        return f"{seconds:14.2f}{states:8d}{1e3 * seconds / states:14.0f}{end}"

    print(f"\nplane, tap and shear\n{'across':>8s}{'unknowns':>10s}{head}")
    unknowns, by_unknowns, by_step = [], [], []
    for across in ACROSS:
        resolution = Resolution(across=across)
        unknowns.append(3 * int(np.count_nonzero(~build_solid(spec.geometry, resolution=resolution).fixed)))
        by_unknowns.append(time_path(SkinSolver(spec, resolution=resolution), plane, TAP_AND_SHEAR, repeats))
        print(f"{across:8d}{unknowns[-1]:10d}{row(*by_unknowns[-1])}", flush=True)
    print(f"\n{'step, mm':>8s}{head}")
    solver = SkinSolver(spec)
    for step_mm in STEPS_MM:
        by_step.append(time_path(solver, plane, TAP_AND_SHEAR, repeats, step_mm=step_mm))
        print(f"{step_mm:8.2f}{row(*by_step[-1])}", flush=True)

    figure, (left, right) = new_figure(2)
    left.loglog(*zip(*[(n, run[0]) for n, run in zip(unknowns, by_unknowns, strict=True) if isinstance(run[2], float)], strict=True), "o-")
    left.set(title="plane, tap and shear", xlabel="unknowns", ylabel="CPU s to the end")
    left.set_xticks(unknowns, unknowns)
    done = [(step_mm, run) for step_mm, run in zip(STEPS_MM, by_step, strict=True) if isinstance(run[2], float)]
    right.loglog([step_mm for step_mm, _ in done], [run[0] for _, run in done], "o-", label="to the end")
    right.loglog([step_mm for step_mm, _ in done], [run[0] / run[1] for _, run in done], "s--", label="per state")
    right.set(title="size of the load steps", xlabel="mm", ylabel="CPU s")
    right.set_xticks(STEPS_MM, STEPS_MM)
    right.legend()
    for ax in (left, right):
        ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "mechanics.png", dpi=120)
    print(f"chart: {out / 'mechanics.png'}")


def print_processes():
    """Wall-clock time of many contacts with one process and with two."""
    from twin.mechanics.solver import ContactJob, press_many

    spec, plane = plain_sensor(), load_object("plane")
    tilts = np.linspace(-20, 20, JOBS).round(1).tolist()
    jobs = [ContactJob(plane, ContactPose(3.0, tilt_deg=(0.0, tilt), shear_mm=(1.0, 0.0)), FRICTION) for tilt in tilts]
    print(f"\n{JOBS} contacts\n{'processes':>10s}{'wall s':>8s}{'from the first on':>19s}{'speed-up':>10s}{'CPU s':>8s}{'failed':>8s}")
    base = None
    for processes in PROCESSES:
        start, cpu, ends, failed = perf_counter(), sum(os.times()[:4]), [], 0
        for outcome in press_many(spec, jobs, processes=processes):
            ends.append(perf_counter() - start)
            failed += bool(outcome.error)
        for child in active_children():
            child.join()  # its CPU time counts from then on
        running = ends[-1] - ends[0]  # without the start of the processes
        base, cpu = base or running, sum(os.times()[:4]) - cpu
        print(f"{processes:10d}{ends[-1]:8.1f}{running:19.1f}{base / running:10.2f}{cpu:8.1f}{failed:8d}", flush=True)


def machine() -> str:
    """This machine's processor, and how busy it is."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores, load average {os.getloadavg()[0]:.1f}"


def main():
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "bench")
    parser.add_argument("--only-times", action="store_true", help="print the contacts' times as JSON, of whatever program is on PYTHONPATH")
    options = parser.parse_args()
    if options.only_times:
        print(json.dumps(time_contacts(options.repeats) | {"where": str(Path(list(twin.__path__)[0]).parent)}))
        return
    print(f"{SENSOR}, CPU time on one thread, {machine()}")
    print_contacts(options.repeats)
    print_scaling(options.repeats, options.out)
    print_processes()


if __name__ == "__main__":
    main()
