"""Faults of camera, arm and program in each phase of a command that moves an emulated arm to an object."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from blind_runs import FAULTS, PHASES, measure

from figures.jobs import Measured, Value, job

RUNS, WORKERS = 320, 3
WORST = {"detected_s": "s", "stands_s": "s", "towards_mm": "mm", "pressed_mm": "mm"}


@job(
    "safety.faults",
    f"python tests/helpers/blind_runs.py 0 {RUNS} {WORKERS}",
    sensors=("mg400-331",),
    code=(
        "hardware.servo.loop",
        "hardware.collect.collect",
        "hardware.workcell.mover",
        "hardware.safety.eyes",
        "hardware.arms.mg400",
        "hardware.cameras.mjpeg",
    ),
    minutes=10,
)
def faults(work: Path) -> Measured:
    """The worst of the runs of each fault and phase, and of all."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(measure, range(RUNS)))
    (work / "runs.txt").write_text("\n".join(map(str, runs)) + "\n")
    found = {"runs": Value(len(runs)), "wrong": Value(sum(bool(run.wrong()) for run in runs))}
    for fault in FAULTS:
        for phase in PHASES:
            some = [run for run in runs if (run.fault, run.phase) == (fault, phase)]
            name = f"{fault.replace(' ', '_')}.{phase}"
            found |= {f"{name}.{what}": Value(max(getattr(run, what) for run in some), unit) for what, unit in WORST.items()}
    return found
