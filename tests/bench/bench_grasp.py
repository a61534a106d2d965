"""``tactip/GraspLift-v0`` and ``tactip/PegInsert-v0``: a constant grip, scripted controllers, and what PPO learns without and with touch.

With pins PPO sees the linear part of their displacement (``PinModes``): a displacement of all pins shows the load, and a spread the grip.
Its learning rate then falls to zero.

With ``--estimator`` a fifth of the steps are grips drawn about the least one. From them a network learns to estimate how much more the
fingers grip than is needed, from the touch of one moment (``GripEstimator``). PPO then sees the estimate in place of the touch.

Run: PYTHONPATH=. python tests/bench/bench_grasp.py [--way ppo] [--observation pins] [--estimator] [--seed 0] [--steps 100000]
[--out FILE]. It prints the share of 100 new episodes that are solved, each with the policy's mean action. PPO is that of
stable-baselines3 with 8 environments and ``SETTINGS``; rewards are divided by their running standard deviation (``VecNormalize``).
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
from training.environments.grasp import GRIP_S, PERIOD_S  # noqa: E402
from training.environments.grasp import STEPS as STEPS_OF_EPISODE  # noqa: E402
from training.mujoco.task import WANTED  # noqa: E402

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
ESTIMATOR_SHARE, EPOCHS, MODES = 0.2, 30, 32
"""Share of the steps from which the estimator learns, its passes over them, and its number of modes of each sensor's touch."""
DRAWN, ANOTHER = (-0.5, 0.65), 0.06
"""Range of the logarithm of drawn grips over the least one, and how probable another draw is at a step."""
UP = 0.3
"""Share of its way from which the hand counts as up."""
NOISE_PX, SPACING_PX = 0.1, 13.2
"""Noise of the pins, and their spacing, in which their displacements are observed."""
GAIN, WAITS = 5.0, GRIP_S / (STEPS_OF_EPISODE * PERIOD_S)
"""Action per missing logarithm of the grip, and the share of the episode in which the hand waits."""
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


class GripEstimator(BaseFeaturesExtractor):
    """State, and the mean and the standard deviation of the logarithm of grip over least grip, estimated from one moment's touch."""

    def __init__(self, space, estimate):
        super().__init__(space, space["state"].shape[0] + 2)
        self.estimate = estimate.requires_grad_(False)

    def apply(self, fn):
        """Keep the weights, which PPO would set to random ones."""
        return self

    def forward(self, seen):
        mean, log_sd = self.estimate(seen["state"], seen["tactile"][:, 0]).T
        return torch.column_stack([seen["state"], mean, log_sd.exp()])


class Estimate(torch.nn.Module):
    """A network on states (B, 3) and whitened modes of both sensors' touch (B, 2, ...).

    It gives the mean and the logarithm of the standard deviation (B, 2).

    Parameters
    ----------
    state, touch : tensor
        Those of the steps that it learns from.
    modes : int
        Largest number of principal components of each sensor's touch.
    """

    def __init__(self, state, touch, modes):
        super().__init__()
        flat = touch.flatten(2)
        scale, axes = zip(*(torch.linalg.svd(each - each.mean(0), full_matrices=False)[1:] for each in flat.unbind(1)), strict=True)
        size = (torch.stack(scale) / len(flat) ** 0.5)[:, :modes, None]
        self.register_buffer("middle", flat.mean(0))
        self.register_buffer("axes", torch.stack(axes)[:, :modes] / size)
        count = 2 * self.axes.shape[1] + state.shape[1]
        layers = torch.nn.Linear(count, 64), torch.nn.SiLU(), torch.nn.Linear(64, 64), torch.nn.SiLU(), torch.nn.Linear(64, 2)
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, state, touch):
        seen = torch.einsum("bsn,smn->bsm", touch.flatten(2) - self.middle, self.axes)
        return self.layers(torch.cat([state, seen.flatten(1)], 1)).clamp(-3.0, 3.0)


def drawn_grips(observation, seed, steps):
    """States, touches, and logarithms of grip over least grip, of steps with grips about the least one."""
    env = gymnasium.make("tactip/GraspLift-v0", disable_env_checker=True, observation=observation).unwrapped
    rng, rows, over = np.random.default_rng(seed), [], True
    while len(rows) < steps:
        if over:
            env.reset(seed=int(rng.integers(JUDGED_FROM)))
        if over or rng.random() < ANOTHER:
            wanted_n = env.least_n * np.exp(rng.uniform(*DRAWN))
        action = (wanted_n - env.grip_n()) / N_PER_ACTION + rng.normal(0.0, 0.3)
        seen, _, failed, late, _ = env.step(np.array([np.clip(action, -1, 1)]))
        over = failed or late
        rows.append((seen["state"], seen["tactile"][0], np.log(max(env.grip_n(), 0.05) / env.least_n)))
    state, touch, margin = map(np.array, zip(*rows, strict=True))
    return *map(torch.tensor, (state, touch)), torch.tensor(margin.clip(-1.5, 1.0), dtype=torch.float32)


def estimator(observation, seed, steps):
    """An ``Estimate`` that has learnt from so many steps by maximum likelihood."""
    torch.manual_seed(seed)
    state, touch, margin = drawn_grips(observation, seed, steps)
    estimate = Estimate(state, touch, MODES)
    rule = torch.optim.AdamW(estimate.parameters(), 3e-3, weight_decay=1e-2)
    falls = torch.optim.lr_scheduler.CosineAnnealingLR(rule, EPOCHS)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(margin)).split(256):
            mean, log_sd = estimate(state[rows], touch[rows]).T
            loss = torch.nn.functional.gaussian_nll_loss(mean, margin[rows], (2 * log_sd).exp())
            rule.zero_grad()
            loss.backward()
            rule.step()
        falls.step()
    return estimate


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


def by_estimate(observation):
    """What an estimator is worth: its error, that with noise of pins, the deviation of what it estimates, and a controller's share.

    Errors are root mean squares, of steps of new episodes in which the hand is up. The controller closes in proportion to what is missing.
    """
    steps = round(ESTIMATOR_SHARE * STEPS)
    estimate = estimator(observation, 0, steps)
    state, touch, margin = drawn_grips(observation, 1, steps // 4)
    up = state[:, 1] > UP

    def act(seen):
        found = estimate(torch.tensor(seen["state"])[None], torch.tensor(seen["tactile"][0])[None])[0, 0]
        waits = seen["state"][2] < WAITS
        return np.array([0.0 if waits else np.clip(GAIN * (np.log(WANTED) - float(found)), -1, 1)])

    def error(felt):
        return float((estimate(state, felt)[up, 0] - margin[up]).square().mean().sqrt())

    with torch.no_grad():
        found = {"error": error(touch), "deviation": float(margin[up].std())}
        if observation == "pins":
            noise = torch.normal(0.0, NOISE_PX / SPACING_PX, touch.shape, generator=torch.Generator().manual_seed(0))
            found["error_with_noise"] = error(touch + noise)
        return found | {"success": solved("GraspLift", lambda env: act, observation=observation)}


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


def settings(env, observation, estimate):
    """The settings of PPO: with pins, or with an estimator, the rate falls to zero."""
    if estimate is not None:
        rate, extractor, given = SETTINGS["learning_rate"], GripEstimator, {"estimate": estimate}
    elif observation == "pins":
        rate, extractor, given = PINS_RATE, PinModes, {"rest_px": env.get_attr("rest_px")[0][0]}
    else:
        return SETTINGS
    policy = SETTINGS["policy_kwargs"] | {"features_extractor_class": extractor, "features_extractor_kwargs": given}
    return SETTINGS | {"learning_rate": lambda left: rate * left, "policy_kwargs": policy}


def learnt(observation, seed, steps=STEPS, out=None, estimated=False):
    """The share that PPO solves, the steps, and the seconds of processor time that it took to learn."""
    torch.set_num_threads(1)
    used, before = process_time(), round(ESTIMATOR_SHARE * steps) if estimated else 0
    estimate = estimator(observation, seed, before) if estimated else None
    given = {"env_kwargs": {"observation": observation}, "monitor_kwargs": {"info_keywords": ("is_success",)}}
    env = make_vec_env("tactip/GraspLift-v0", ENVIRONMENTS, seed=seed, **given)
    env = VecNormalize(env, norm_obs=False, gamma=SETTINGS["gamma"])
    learner = PPO("MultiInputPolicy", env, seed=seed, device="cpu", **settings(env, observation, estimate))
    learner.learn(steps - before, callback=Curve())
    used = process_time() - used
    if out:
        learner.save(out)
    share = solved("GraspLift", lambda env: lambda seen: learner.predict(seen, deterministic=True)[0], observation=observation)
    return share, before + learner.num_timesteps, used


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", choices=("ppo", "constant", "estimate", *SCRIPTED), default="ppo")
    parser.add_argument("--observation", default="pins")
    parser.add_argument("--estimator", action="store_true", help="PPO sees the estimate of a network in place of the touch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, help="where the policy is written (a ZIP file of stable-baselines3)")
    given = parser.parse_args()
    if given.way == "constant":
        for grip_n in GRIPS_N:
            print(f"{grip_n:.1f} N solves {constant(grip_n):.0%}", flush=True)
    elif given.way == "estimate":
        print("; ".join(f"{name} {value:.3f}" for name, value in by_estimate(given.observation).items()))
    elif given.way == "ppo":
        share, steps, used_s = learnt(given.observation, given.seed, given.steps, given.out, given.estimator)
        print(f"solved {share:.0%} of {EPISODES} episodes after {steps} steps, {used_s / 60:.1f} minutes of a core")
    else:
        task, controller = SCRIPTED[given.way]
        print(f"solved {solved(task, controller, observation='none'):.0%}")
