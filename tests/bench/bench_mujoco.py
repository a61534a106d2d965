"""Time a MuJoCo scene of a gripper with two TacTips: beside MuJoCo's rigid contacts in the same run, and beside real time.

Run by ``make bench``, or: PYTHONPATH=. python tests/bench/bench_mujoco.py [--repeats 3]. The gripper closes on a block, lifts it, and
shakes it: contacts begin, stick and slip. A step of 2 ms includes wrench and pins of both sensors; the rigid scene is the same, and its
skins are colliding meshes. Times are of one core's processor time, the best of some repeats.
"""

import argparse
import os
from time import process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import gymnasium  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402

import training.environments  # noqa: E402, F401
from scenes import load_sensor  # noqa: E402
from training.mujoco import TactileScene  # noqa: E402
from training.mujoco.model import load_scene  # noqa: E402

SENSOR = "mg400-331"
OPEN_M, CLOSED_M, LIFT_M = 0.018, 0.0235, 0.05
STEPS = 1500
BETWEEN_FRAMES = 50
REPEATS = 3


def control(step):
    """Wanted height of the hand and travel of the fingers: close for 0.6 s, lift for 0.8 s, then shake."""
    closed, lifted = np.clip(step / 300, 0, 1), np.clip((step - 300) / 400, 0, 1)
    shaken = 0.005 * np.sin(0.04 * max(step - 700, 0))
    return LIFT_M * lifted + shaken, OPEN_M + (CLOSED_M - OPEN_M) * closed


def start(model, data):
    """The gripper open around the block."""
    mujoco.mj_resetData(model, data)
    for finger in ("left", "right"):
        data.qpos[model.joint(finger).qposadr[0]] = OPEN_M
    mujoco.mj_forward(model, data)


def rigid_ms():
    """Of a step with MuJoCo's own contacts."""
    spec, _ = load_scene("gripper", load_sensor(SENSOR))
    for side in ("left", "right"):
        spec.geom(f"{side}_skin").contype = spec.geom(f"{side}_skin").conaffinity = 1
    model = spec.compile()
    data = mujoco.MjData(model)
    start(model, data)
    begun = process_time()
    for step in range(STEPS):
        data.ctrl[:] = control(step)
        mujoco.mj_step(model, data)
    assert data.body("block").xpos[2] > 0.06, "the block was not lifted"
    return 1e3 * (process_time() - begun) / STEPS


def tactile_ms(scene, *, pins=True, frames=False):
    """Of a step with the surrogate's contacts; ``frames`` renders both frames at 10 Hz."""
    start(scene.model, scene.data)
    scene.reset()
    begun = process_time()
    for step in range(STEPS):
        scene.data.ctrl[:] = control(step)
        scene.step()
        for site in scene.sensors:
            if pins:
                scene.read(site)
            if frames and step % BETWEEN_FRAMES == 0:
                scene.frame(site)
    used = process_time() - begun
    assert scene.data.body("block").xpos[2] > 0.06, "the block was not lifted"
    return 1e3 * used / STEPS


def lift_rate(observation="pins"):
    """Steps of ``tactip/GraspLift-v0`` in a second: episodes that grip, lift, and end by themselves."""
    env = gymnasium.make("tactip/GraspLift-v0", observation=observation, disable_env_checker=True)
    env.reset(seed=0)
    done, begun = 0, process_time()
    for _ in range(300):
        wanted = 1.4 * env.unwrapped.least_n
        *_, failed, late, _ = env.step(np.clip([(wanted - env.unwrapped.grip_n()) / 0.15], -1, 1))
        done += 1
        if failed or late:
            env.reset()
    return done / (process_time() - begun)


def measured(repeats=REPEATS):
    """Times of a step, ms, and steps of the environment in a second."""
    spec, sensors = load_scene("gripper", load_sensor(SENSOR))
    scene = TactileScene(spec.compile(), sensors, touchable=["block"])
    tactile_ms(scene, frames=True)  # compiles, and draws the views' rest
    lift_rate()
    kinds = {
        "rigid": rigid_ms,
        "wrench": lambda: tactile_ms(scene, pins=False),
        "pins": lambda: tactile_ms(scene),
        "frames": lambda: tactile_ms(scene, frames=True),
    }
    found = {name: min(of() for _ in range(repeats)) for name, of in kinds.items()}
    return found | {"lift": max(lift_rate() for _ in range(repeats))}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    table = measured(parser.parse_args().repeats)
    for name in ("rigid", "wrench", "pins", "frames"):
        ms = table[name]
        print(f"{name:8} {ms:.3f} ms a step: {2 / ms:.1f} times real time, {ms / table['rigid']:.1f} times the rigid contacts' time")
    print(f"GraspLift {table['lift']:.0f} environment steps in a second")
