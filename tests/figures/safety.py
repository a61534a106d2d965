"""Faults of camera, arm and program in each phase of a command that moves an emulated arm to an object."""

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from blind_runs import FAULTS, PHASES, Run, faults_of, measure

from figures.jobs import Measured, Value, job

RUNS, WORKERS = 320, 3
ARMS = {"ur": "hardware.arms.ur.driver", "ros2-twist": "hardware.arms.ros2", "ros2-pose": "hardware.arms.ros2"}
"""Further arms, and the modules of their drivers."""
ARM_RUNS = 40
"""Runs with each of them: each fault in each phase."""
WORST = {"detected_s": "s", "stands_s": "s", "towards_mm": "mm", "pressed_mm": "mm"}


def safety_job(name: str, options: str, driver: str, minutes: float) -> Callable:
    """Register a job of runs with one arm."""
    return job(
        f"safety.{name}",
        f"python tests/helpers/blind_runs.py {options}",
        sensors=("mg400-331",),
        code=(
            "hardware.servo.loop",
            "hardware.collect.collect",
            "hardware.workcell.build",
            "hardware.safety.eyes",
            driver,
            "hardware.cameras.mjpeg",
        ),
        minutes=minutes,
    )


def make_runs(work: Path, count: int, kind: str) -> list[Run]:
    """Runs with an arm, which are also kept as text."""
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        runs = list(pool.map(partial(measure, kind=kind), range(count)))
    (work / "runs.txt").write_text("\n".join(map(str, runs)) + "\n")
    return runs


def worst(name: str, some: Iterable[Run]) -> Measured:
    """The largest values of some runs."""
    return {f"{name}.{what}": Value(max(getattr(run, what) for run in some), unit) for what, unit in WORST.items()}


def counts(runs: list[Run]) -> Measured:
    """Number of runs, and of those that were not as promised."""
    return {"runs": Value(len(runs)), "wrong": Value(sum(bool(run.wrong()) for run in runs))}


@safety_job("faults", f"0 {RUNS} {WORKERS}", "hardware.arms.mg400", 10)
def faults(work: Path) -> Measured:
    """The worst of the runs of each fault and phase with an MG400, and of all."""
    runs = make_runs(work, RUNS, "mg400")
    found = counts(runs)
    for fault in FAULTS:
        for phase in PHASES:
            found |= worst(f"{fault.replace(' ', '_')}.{phase}", [run for run in runs if (run.fault, run.phase) == (fault, phase)])
    return found


def arm_faults(work: Path, *, kind: str) -> Measured:
    """The worst of the runs of each fault with another arm."""
    runs = make_runs(work, ARM_RUNS, kind)
    found = counts(runs)
    for fault in faults_of(kind):
        found |= worst(fault.replace(" ", "_"), [run for run in runs if run.fault == fault])
    return found


for arm, module in ARMS.items():
    safety_job(arm.replace("-", "_"), f"0 {ARM_RUNS} {WORKERS} {arm}", module, 2)(partial(arm_faults, kind=arm))
