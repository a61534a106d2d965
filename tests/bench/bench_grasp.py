"""``tactip/GraspLift-v0`` and ``tactip/PegInsert-v0``: a constant grip, scripted controllers, and what PPO learns without and with touch.

With pins PPO sees the linear part of their displacement (``PinModes``): a displacement of all pins shows the load, and a spread the grip.
Its learning rate then falls to zero.

Run: PYTHONPATH=. python tests/bench/bench_grasp.py [--way ppo] [--observation pins] [--seed 0] [--steps 100000] [--out FILE]. It prints
the share of 100 new episodes that are solved, each with the policy's mean action. PPO is that of stable-baselines3 with 8 environments
and ``SETTINGS``; rewards are divided by their running standard deviation (``VecNormalize``).
"""

import argparse
import os
import sys
from pathlib import Path
from time import process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
sys.path.append(str(Path(__file__).parents[1] / "helpers"))

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from bench_baselines import ENVIRONMENTS, EPISODES, JUDGED_FROM, Curve  # noqa: E402
from peg_expert import Expert  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

import training.environments  # noqa: E402, F401
from training.mujoco.grasp import WANTED  # noqa: E402

GRIPS_N = (0.8, 1.1, 1.5, 2.0)
STEPS = 100_000
SETTINGS = {
    "n_steps": 128,
    "batch_size": 256,
    "learning_rate": 1e-3,
    "gamma": 0.95,
    "gae_lambda": 0.9,
    "policy_kwargs": {"log_std_init": -1.0},
}
"""What differs from PPO's default settings."""
PINS_RATE = 1.5e-3
"""Learning rate with pins at the start."""
MODE_SCALE = 8.0
"""Factor that makes the modes of the pins about as large as the wrenches in N."""
N_PER_ACTION = 0.15
"""Change of the force by an action of 1, about."""
LEAST_N, PER_LOAD = 0.45, 2.5
"""Grip at the start, and per load at each finger, of the controller that feels the load."""


class PinModes(BaseFeaturesExtractor):
    """State, and for each sensor the coefficients of the linear function of place that is nearest to the pins' displacements."""

    def __init__(self, space, rest_px):
        at = (rest_px - rest_px.mean(axis=0)) / np.ptp(rest_px, axis=0).max()
        basis = np.linalg.qr(np.column_stack([np.ones(len(at)), at]))[0] / np.sqrt(len(at))
        moved = space["tactile"].shape
        super().__init__(space, space["state"].shape[0] + moved[0] * moved[1] * moved[3] * basis.shape[1])
        self.register_buffer("basis", torch.tensor(MODE_SCALE * basis, dtype=torch.float32))

    def forward(self, seen):
        modes = torch.einsum("btsnc,nk->btsck", seen["tactile"], self.basis)
        return torch.cat([seen["state"], modes.flatten(1)], 1)


def solved(task, controller, episodes=EPISODES, **options):
    """Share of new episodes that are solved. A controller makes, of the environment at the start, a function of what is observed."""
    env, good = gymnasium.make(f"tactip/{task}-v0", disable_env_checker=True, **options), 0
    for seed in range(JUDGED_FROM, JUDGED_FROM + episodes):
        seen, _ = env.reset(seed=seed)
        act, over = controller(env.unwrapped), False
        while not over:
            seen, _, failed, late, info = env.step(act(seen))
            over = failed or late
        good += bool(info["is_success"])
    return good / episodes


def grip_with(grip_n):
    """The controller that grips with a force, which may depend on the environment."""
    return lambda env: lambda seen: np.array([np.clip((grip_n(env) - env.grip_n()) / N_PER_ACTION, -1, 1)])


def insert(env):
    """The scripted controller of the peg."""
    expert = Expert(env)
    return lambda seen: expert.act()


def knowing(env):
    """The grip that earns most."""
    return WANTED * env.least_n


def by_load(env):
    """A grip in proportion to the load that both sensors feel. It does not feel slip, so that it takes a friction for granted."""
    left, right = (each.force_n[0] for each in env.felt)  # the sensors' x axes point down and up
    return max(LEAST_N, PER_LOAD * (right - left) / 2)


def constant(grip_n, episodes=EPISODES):
    """The share that a constant grip solves."""
    return solved("GraspLift", grip_with(lambda env: grip_n), episodes, observation="none")


SCRIPTED = {"expert": ("GraspLift", grip_with(knowing)), "load": ("GraspLift", grip_with(by_load)), "peg": ("PegInsert", insert)}
"""Tasks and controllers by name."""


def pin_settings(env):
    """The settings with pins."""
    extractor = {"features_extractor_class": PinModes, "features_extractor_kwargs": {"rest_px": env.get_attr("rest_px")[0][0]}}
    return SETTINGS | {"learning_rate": lambda left: PINS_RATE * left, "policy_kwargs": SETTINGS["policy_kwargs"] | extractor}


def learnt(observation, seed, steps=STEPS, out=None):
    """The share that PPO solves, its steps, and the seconds of processor time that it took to learn."""
    torch.set_num_threads(1)
    given = {"env_kwargs": {"observation": observation}, "monitor_kwargs": {"info_keywords": ("is_success",)}}
    env, used = make_vec_env("tactip/GraspLift-v0", ENVIRONMENTS, seed=seed, **given), process_time()
    env = VecNormalize(env, norm_obs=False, gamma=SETTINGS["gamma"])
    learner = PPO("MultiInputPolicy", env, seed=seed, device="cpu", **(pin_settings(env) if observation == "pins" else SETTINGS))
    learner.learn(steps, callback=Curve())
    used = process_time() - used
    if out:
        learner.save(out)
    share = solved("GraspLift", lambda env: lambda seen: learner.predict(seen, deterministic=True)[0], observation=observation)
    return share, learner.num_timesteps, used


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", choices=("ppo", "constant", *SCRIPTED), default="ppo")
    parser.add_argument("--observation", default="pins")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, help="where the policy is written (a ZIP file of stable-baselines3)")
    given = parser.parse_args()
    if given.way == "constant":
        for grip_n in GRIPS_N:
            print(f"{grip_n:.1f} N solves {constant(grip_n):.0%}", flush=True)
    elif given.way == "ppo":
        share, steps, used_s = learnt(given.observation, given.seed, given.steps, given.out)
        print(f"solved {share:.0%} of {EPISODES} episodes after {steps} steps, {used_s / 60:.1f} minutes of a core")
    else:
        task, controller = SCRIPTED[given.way]
        print(f"solved {solved(task, controller, observation='none'):.0%}")
