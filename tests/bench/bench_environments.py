"""Time the steps of the environments: single, batched, on finite elements, and beside a rigid sensor's depth image.

Run by ``make bench``, or: PYTHONPATH=. python tests/bench/bench_environments.py [--seconds 3] [--out out/bench]. Rates are the best of some
repeats: steps in a second of processor time, and on the clock. A rigid simulator presses no skin; a step of one is here the depth of the
object behind each of 128 x 128 places of the undeformed dome, on one core, without physics and without drawing.
"""

import argparse
import json
import os
from pathlib import Path
from time import perf_counter, process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402

import training.environments  # noqa: E402, F401
from scenes import load_object, load_sensor  # noqa: E402
from twin.objects import build_field  # noqa: E402

TASKS = ("SurfaceFollow", "EdgeFollow")
ROWS = 64
REPEATS = 3
IMAGE_PX = 128


def rates(step, each, seconds):
    """Steps in a second of processor time and on the clock, the best of the repeats; ``step`` makes ``each`` of them."""
    best = np.zeros(2)
    step()
    for _ in range(REPEATS):
        used, clock, done = process_time(), perf_counter(), 0
        while perf_counter() - clock < seconds:
            step()
            done += each
        best = np.maximum(best, done / np.array([process_time() - used, perf_counter() - clock]))
    return best


def single(task, seconds, **options):
    """Of one environment with small random actions."""
    env, rng = gymnasium.make(f"tactip/{task}-v0", disable_env_checker=True, **options), np.random.default_rng(0)
    env.reset(seed=0)

    def step():
        *_, terminated, truncated, _ = env.step(rng.uniform(-0.3, 0.3, env.action_space.shape))
        if terminated or truncated:
            env.reset()

    return rates(step, 1, seconds)


def batched(task, seconds):
    """Of many environments stepped together."""
    env, rng = gymnasium.make_vec(f"tactip/{task}-v0", num_envs=ROWS), np.random.default_rng(0)
    env.reset(seed=0)
    return rates(lambda: env.step(rng.uniform(-0.3, 0.3, env.action_space.shape)), ROWS, seconds)


def rigid(seconds):
    """Of a rigid sensor's depth image."""
    radius = load_sensor("mg400-331").skin.outer_radius_mm
    across = np.linspace(-0.7, 0.7, IMAGE_PX) * radius
    x, y = (values.ravel() for values in np.meshgrid(across, across))
    dome, rng = np.column_stack([x, y, np.sqrt(radius**2 - x**2 - y**2)]), np.random.default_rng(0)
    fields = [build_field(load_object(name)) for name in ("plane", "can", "ball-80", "ball-40")]

    def step():
        place = np.array([rng.uniform(-1, 1), 0.0, radius - rng.uniform(1, 3)])
        np.maximum(-fields[rng.integers(len(fields))].distance(dome - place), 0.0).astype(np.float32)

    return rates(step, 1, seconds)


def measured(seconds):
    """All rates by name, (2,) each."""
    found = {}
    for task in TASKS:
        found[f"{task} single"] = single(task, seconds)
        found[f"{task} {ROWS} together"] = batched(task, seconds)
    found["SurfaceFollow fem"] = single("SurfaceFollow", seconds, backend="fem")
    found["rigid depth image"] = rigid(seconds)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    given = parser.parse_args()
    table = measured(given.seconds)
    for name, (used, clock) in table.items():
        print(f"{name:32} {used:8.0f} steps a second of processor time, {clock:8.0f} on the clock")
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "environments.json").write_text(json.dumps({name: list(pair) for name, pair in table.items()}, indent=1))
