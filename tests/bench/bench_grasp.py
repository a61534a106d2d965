"""``tactip/GraspLift-v0`` and ``tactip/PegInsert-v0`` as a stranger would solve them: a constant grip, the scripted expert, and PPO.

Run: PYTHONPATH=. python tests/bench/bench_grasp.py [--task GraspLift] [--way ppo] [--observation pins] [--seed 0] [--steps 100000]. It
prints the share of 100 new episodes that are solved. PPO is that of stable-baselines3 with default settings and 8 environments, and acts
with its mean action.
"""

import argparse
import os
from time import process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from bench_baselines import ENVIRONMENTS, EPISODES, JUDGED_FROM, Curve  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402

import training.environments  # noqa: E402, F401

GRIPS_N = (0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.2)
STEPS = 100_000


def solved(task, act, episodes=EPISODES, **options):
    """Share of new episodes that a function of the environment and its observation solves."""
    env, good = gymnasium.make(f"tactip/{task}-v0", disable_env_checker=True, **options), 0
    for seed in range(JUDGED_FROM, JUDGED_FROM + episodes):
        seen, _ = env.reset(seed=seed)
        over = False
        while not over:
            seen, _, failed, late, info = env.step(act(env.unwrapped, seen))
            over = failed or late
        good += bool(info["is_success"])
    return good / episodes


def lift_with(grip_n):
    """Actions that grip with a force, which may depend on the environment, lift, hold and set down."""

    def act(env, seen):
        wanted, force, hand = grip_n(env), env.grip_n(), env.goal_mm - env.height_mm()
        if env.part == 2 and env.height_mm() < 0.5:
            return np.array([-1.0, 0.0])
        ready = force > 0.9 * wanted
        return np.clip([3.0 * (wanted - force), ready * hand / 4], [-1, -0.5], [1, 0.5])

    return act


def best_constant(episodes=EPISODES):
    """The best constant grip, N, and the share that it solves."""
    shares = {grip: solved("GraspLift", lift_with(lambda env, grip=grip: grip), episodes, observation="none") for grip in GRIPS_N}
    for grip, share in shares.items():
        print(f"{grip:.1f} N solves {share:.0%}", flush=True)
    return max(shares.items(), key=lambda pair: pair[1])


def learnt(task, observation, seed, steps=STEPS):
    """The share that PPO solves, its steps, and the seconds of processor time that it took to learn."""
    torch.set_num_threads(1)
    given = {"env_kwargs": {"observation": observation}, "monitor_kwargs": {"info_keywords": ("is_success",)}}
    env, used = make_vec_env(f"tactip/{task}-v0", ENVIRONMENTS, seed=seed, **given), process_time()
    learner = PPO("MultiInputPolicy", env, seed=seed, device="cpu")
    learner.learn(steps, callback=Curve())
    used = process_time() - used
    return solved(task, lambda _, seen: learner.predict(seen, deterministic=True)[0], observation=observation), learner.num_timesteps, used


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="GraspLift")
    parser.add_argument("--way", choices=("ppo", "constant", "expert"), default="ppo")
    parser.add_argument("--observation", default="pins")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args()
    if given.way == "constant":
        print("the best constant grip, {:.1f} N, solves {:.0%}".format(*best_constant()))
    elif given.way == "expert":
        print(f"the expert solves {solved(given.task, lift_with(lambda env: 1.35 * env.least_n), observation='none'):.0%}")
    else:
        share, steps, used_s = learnt(given.task, given.observation, given.seed, given.steps)
        print(f"solved {share:.0%} of {EPISODES} episodes after {steps} steps, {used_s / 60:.1f} minutes of a core")
