"""The errors that the shipped surrogates state, how fast the environments step, and what is trained from scratch."""

import json
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import bench_baselines
import bench_environments
import bench_geoms
import bench_grasp
import bench_surrogate
import numpy as np

from figures.jobs import DRAWN, NO_PICTURES, Measured, Value, job, real_folder, run_twin
from scenes import load_sensor
from training.environments import OWN
from training.surrogate.model import surrogate_of

SENSORS = {"mg400-331": "tac-vgnn-331", "mg400-127": "tac-vgnn-127", "ur5-331": "ur5-331-surface-3d-tap"}
"""The recording with whose contacts each sensor's surrogate is compared."""
DEPTHS = ("pose_2", "pose_3")
"""Labels in mm; the others are angles."""
SECONDS = 2.0
UNITS = {"pins_px": "px"}


def stated_errors(work: Path, *, sensor: str) -> Measured:
    """Errors on the paths that were kept from the training, of all states and by object; they were measured when it was made."""
    told = surrogate_of(load_sensor(sensor)).about["errors"]
    found = {"paths": Value(told["paths"])}
    for name, part in {"all": told["all"], **told["by"]["object"]}.items():
        found |= {f"{name}_{key}": Value(part[key], UNITS.get(key, "")) for key in ("pins_px", "pins_share_95", "force_share", "slip")}
    return found


def on_real_contacts(work: Path, *, sensor: str) -> Measured:
    """Surrogate and finite elements on recorded contacts: how far their pins are from the frames', and errors of the poses from them."""
    found = bench_surrogate.measured(sensor, real_folder(SENSORS[sensor]))
    depth = np.array([name in DEPTHS for name in found.names])
    values = {"frames": Value(found.frames), "fem_px": Value(found.fem_px, "px"), "pins_px": Value(found.surrogate_px, "px")}
    for who, errors in (("fem_", found.fem_mae), ("", found.surrogate_mae)):
        values |= {f"{who}mm": Value(float(errors[depth].mean()), "mm"), f"{who}deg": Value(float(errors[~depth].mean()), "deg")}
    return values | {"pins_more": Value(found.surrogate_px / found.fem_px - 1)}


for name, recording in SENSORS.items():
    job(
        f"surrogate.real.{name}",
        f"tests/bench/bench_surrogate.py --sensor {name} --data {recording}",
        sensors=(name,),
        code=("bench_surrogate", "training.surrogate"),
        shipped=("training/surrogates",),
        recordings=(recording,),
        minutes=1,
        beside=NO_PICTURES,
    )(partial(on_real_contacts, sensor=name))
    command = f"twin surrogate --sensor {name} --out mine.safetensors"
    job(
        f"surrogate.{name}",
        command,
        sensors=(name,),
        code=("training.surrogate.model",),
        shipped=("training/surrogates",),
        minutes=0.1,
        beside=NO_PICTURES,
    )(partial(stated_errors, sensor=name))


@job(
    "environments.speed",
    "tests/bench/bench_environments.py",
    sensors=("mg400-331",),
    code=("bench_environments", "training.environments"),
    shipped=("training/surrogates",),
    minutes=2,
    beside=DRAWN,
)
def speed(work: Path) -> Measured:
    """Steps in a second of one core's time, of the slower task, and on the clock; against a rigid sensor's depth image in the same run."""
    found = bench_environments.measured(SECONDS)
    kinds = ("single", f"{bench_environments.ROWS} together")
    (single, _), (together, clock) = (np.min([found[f"{task} {kind}"] for task in bench_environments.TASKS], axis=0) for kind in kinds)
    rigid = found["rigid depth image"][0]
    return {
        "single": Value(float(single), "1/s"),
        "together": Value(float(together), "1/s"),
        "together_clock": Value(float(clock), "1/s"),
        "fem": Value(float(found["SurfaceFollow fem"][0]), "1/s"),
        "rigid": Value(float(rigid), "1/s"),
        "share_of_rigid": Value(float(together / rigid)),
    }


LEARNT = {
    "EdgeFollow.seeing": ("--randomise moves --fem 20", 12),
    "EdgeFollow.pins": ("--randomise moves --no-state-estimator --fem 20", 12),
    "EdgeFollow.oracle": ("--observation oracle", 2),
    "EdgeFollow.image": ("--observation image", 20),
    "EdgeFollow.forgetful": ("--randomise moves --no-state-estimator --no-friction-history --fem 20", 12),
    "SurfaceFollow.pins": ("--no-state-estimator --fem 20", 8),
    "SurfaceFollow.oracle": ("--observation oracle", 3),
    "ContourFollow.pins": ("", 5),
    "ObjectRoll.pins": ("--minutes 8", 10),
    "ObjectPush.pins": ("", 30),
    "GentlePress.pins": ("--no-state-estimator --minutes 15", 16),
}
"""Options of ``twin learn``, and about how many minutes it takes with all evaluating, by task and what the policy sees."""
WHERE = {"surrogate": "", "surrogate, friction history": "remembers_", "finite elements, rasterised frames": "fem_"}
"""Beginnings of the figures' names, by where ``twin learn`` evaluated the policy."""


def learnt(work: Path, *, name: str) -> Measured:
    """Shares of the episodes that a policy solves, which was trained from scratch by one command, and how long that took."""
    task, options = name.split(".")[0], LEARNT[name][0].split()
    run_twin(work, "learn", "--task", task, "--sensor", "mg400-331", *options, "--out", work / "learnt", "--force")
    told = json.loads((work / "learnt" / "result.json").read_text())
    shares = {f"{WHERE[where]}success": Value(share) for where, share in told["success"].items()}
    return shares | {
        "steps": Value(told["steps"]),
        "minutes": Value(told["minutes"], "min"),
        "core_minutes": Value(told["core_minutes"], "min"),
    }


for name, (options, minutes) in LEARNT.items():
    command = f"twin learn --task {name.split('.')[0]} --sensor mg400-331 {options} --out out/learnt".replace("  ", " ")
    job(
        f"policies.{name}",
        command,
        sensors=("mg400-331",),
        code=("training.environments.learn",),
        shipped=("training/surrogates/mg400-331.safetensors",),
        minutes=minutes,
        beside=DRAWN,
    )(partial(learnt, name=name))

BASELINE_SEEDS, BASELINE_STEPS, BASELINE_SAC = (0, 1, 2), 200_000, ("SurfaceFollow", "EdgeFollow")


def baseline(work: Path, *, task: str, seed: int, algorithm: str = "PPO", blind: bool = False) -> Measured:
    """What stable-baselines3 learns with default settings, and the share of new episodes that it solves."""
    learner, _, used_s = bench_baselines.learnt(task, seed, BASELINE_STEPS, algorithm, blind)
    share = bench_baselines.solved(learner)
    return {"success": Value(share), "steps": Value(learner.num_timesteps), "core_minutes": Value(used_s / 60, "min")}


def baseline_job(name: str, task: str, seed: int, options: str = "", **given: object) -> None:
    """Register what one run of a bench measures."""
    job(
        f"baselines.{name}",
        f"tests/bench/bench_baselines.py --task {task} --seed {seed}{options}",
        sensors=("mg400-331",),
        code=("bench_baselines", "training.environments.baselines"),
        shipped=("training/surrogates/mg400-331.safetensors",),
        minutes=6,
        beside=DRAWN,
    )(partial(baseline, task=task, seed=seed, **given))


for task in OWN:
    for seed in BASELINE_SEEDS:
        baseline_job(f"{task}.seed{seed}", task, seed)
    baseline_job(f"{task}.blind", task, 0, " --blind", blind=True)
for task in BASELINE_SAC:
    baseline_job(f"{task}.sac", task, 0, " --algorithm SAC", algorithm="SAC")


@job(
    "geoms.press",
    "tests/bench/bench_geoms.py",
    sensors=("mg400-331",),
    code=("bench_geoms", "training.mujoco.scene"),
    shipped=("training/surrogates/mg400-331.safetensors",),
    minutes=1,
    beside=DRAWN,
)
def geoms(work: Path) -> Measured:
    """Presses by a robot scene and by the finite elements, by kind of geom."""
    found = {}
    for kind, (force, share, off, moved) in bench_geoms.measured().items():
        found |= {f"{kind}_n": Value(force, "N"), f"{kind}_share": Value(share)}
        found |= {f"{kind}_mm": Value(off, "mm"), f"{kind}_moved_mm": Value(moved, "mm")}
    return found


GRASP_SEEDS, GRASP_MINUTES = (0, 1), 25


def grasp_job(name: str, options: str, measure: Callable[[Path], Measured], minutes: float) -> None:
    """Register what one run of the bench of grippers measures."""
    job(
        f"grasp.{name}",
        f"tests/bench/bench_grasp.py {options}",
        sensors=("mg400-331",),
        code=("bench_grasp", "training.mujoco.scene", "training.mujoco.task"),
        shipped=("training/surrogates/mg400-331.safetensors", "training/mujoco/scenes"),
        minutes=minutes,
        beside=DRAWN,
    )(measure)


def grasp_constant(work: Path) -> Measured:
    """The best constant grip."""
    shares = {grip_n: bench_grasp.constant(grip_n) for grip_n in bench_grasp.GRIPS_N}
    best = max(shares, key=lambda grip_n: shares[grip_n])
    return {"success": Value(shares[best]), "grip_n": Value(best, "N")}


def grasp_scripted(work: Path, *, way: str) -> Measured:
    """A scripted controller."""
    task, controller = bench_grasp.SCRIPTED[way]
    return {"success": Value(bench_grasp.solved(task, controller, observation="none"))}


def grasp_learnt(work: Path, *, observation: str, seed: int, estimated: bool = False) -> Measured:
    """What PPO learns."""
    share, steps, used_s = bench_grasp.learnt(observation, seed, out=work / "policy.zip", estimated=estimated)
    return {"success": Value(share), "steps": Value(steps), "core_minutes": Value(used_s / 60, "min")}


def grasp_estimate(work: Path, *, observation: str) -> Measured:
    """How well the touch of one moment tells how much more the fingers grip than is needed, and what a controller solves by it."""
    return {name: Value(each) for name, each in bench_grasp.by_estimate(observation).items()}


grasp_job("constant", "--way constant", grasp_constant, 5)
for way in bench_grasp.SCRIPTED:
    grasp_job(way, f"--way {way}", partial(grasp_scripted, way=way), 3)
for observation, seed in product(("none", "wrench", "pins"), GRASP_SEEDS):
    options = f"--observation {observation} --seed {seed}"
    grasp_job(f"{observation}.seed{seed}", options, partial(grasp_learnt, observation=observation, seed=seed), GRASP_MINUTES)
for observation, seed in product(("wrench", "pins"), GRASP_SEEDS):
    options = f"--observation {observation} --estimator --seed {seed}"
    measure = partial(grasp_learnt, observation=observation, seed=seed, estimated=True)
    grasp_job(f"estimator.{observation}.seed{seed}", options, measure, GRASP_MINUTES)
for observation in ("wrench", "pins"):
    grasp_job(f"estimate.{observation}", f"--way estimate --observation {observation}", partial(grasp_estimate, observation=observation), 6)
