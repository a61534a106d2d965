"""Learn a task as a stranger would: PPO or SAC of stable-baselines3 with default settings, 8 environments, 200,000 steps; then evaluate it.

Run: PYTHONPATH=. python tests/bench/bench_baselines.py --task SurfaceFollow [--seed 0] [--algorithm SAC] [--blind] [--steps 200000]
[--out out/bench]. It prints the learning curve, and the share of 100 new episodes that the policy's mean action solves. With --blind the
pins stay at rest, so that the policy knows its goal only.
"""

import argparse
import os
from pathlib import Path
from time import process_time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from stable_baselines3 import PPO, SAC  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor  # noqa: E402

from training.environments.baselines import BaselinesVecEnv  # noqa: E402
from twin.report.charts import new_figure, save_figure  # noqa: E402

ALGORITHMS = {"PPO": PPO, "SAC": SAC}
ENVIRONMENTS = 8
EVERY = 10_000  # steps between two rows of a curve, at least
EPISODES = 100
JUDGED_FROM = 10_000  # seed of the first episode in which a policy is evaluated; learning begins with small ones


class Curve(BaseCallback):
    """Steps, and means of the newest 100 episodes: their rewards' sum, their length, and the share that was solved."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        newest = list(self.model.ep_info_buffer)
        if not newest or (self.rows and self.num_timesteps < self.rows[-1][0] + EVERY):
            return
        self.rows.append((self.num_timesteps, *(float(np.mean([one[key] for one in newest])) for key in ("r", "l", "is_success"))))
        print("{:7d} steps: reward {:.2f}, length {:.0f}, solved {:.0%}".format(*self.rows[-1]), flush=True)


class Blind(VecEnvWrapper):
    """Pins that stay at rest."""

    def reset(self):
        return self._without(self.venv.reset())

    def step_wait(self):
        seen, reward, done, infos = self.venv.step_wait()
        for row in np.flatnonzero(done):
            infos[row]["terminal_observation"] = self._without(infos[row]["terminal_observation"])
        return self._without(seen), reward, done, infos

    @staticmethod
    def _without(seen):
        return seen | {"tactile": np.zeros_like(seen["tactile"])}


def learnt(task, seed, steps, algorithm="PPO", blind=False, **options):
    """The learner, its curve, and the seconds of processor time that it took."""
    torch.set_num_threads(1)
    env = BaselinesVecEnv(gymnasium.make_vec(f"twin:tactip/{task}-v0", num_envs=ENVIRONMENTS, **options))
    env, curve, used = VecMonitor(Blind(env) if blind else env, info_keywords=("is_success",)), Curve(), process_time()
    learner = ALGORITHMS[algorithm]("MultiInputPolicy", env, seed=seed, device="cpu")
    learner.learn(steps, callback=curve)
    return learner, curve.rows, process_time() - used


def solved(learner, episodes=EPISODES):
    """Share of new episodes that the learner's mean action solves; of B rows, row k evaluates the episodes k, k + B, ..."""
    env = learner.get_env()
    env.seed(JUDGED_FROM)
    seen, good = env.reset(), 0
    left = np.array([len(range(row, episodes, env.num_envs)) for row in range(env.num_envs)])
    while left.any():
        seen, _, done, infos = env.step(learner.predict(seen, deterministic=True)[0])
        for row in np.flatnonzero(done & (left > 0)):
            left[row] -= 1
            good += bool(infos[row]["is_success"])
    return good / episodes


def draw(rows, path):
    """The learning curve."""
    figure, axes = new_figure(2, 1)
    steps, reward, _, share = np.transpose(rows)
    for ax, values, name in zip(axes, (reward, share), ("sum of an episode's rewards", "episodes solved, with exploration"), strict=True):
        ax.plot(steps, values)
        ax.set(xlabel="steps", ylabel=name)
    save_figure(path, figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="SurfaceFollow")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--algorithm", choices=ALGORITHMS, default="PPO")
    parser.add_argument("--blind", action="store_true")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    given = parser.parse_args()
    learner, rows, used_s = learnt(given.task, given.seed, given.steps, given.algorithm, given.blind)
    print(f"solved {solved(learner):.0%} of {EPISODES} episodes after {learner.num_timesteps} steps, {used_s / 60:.1f} minutes of a core")
    given.out.mkdir(parents=True, exist_ok=True)
    draw(rows, given.out / f"baselines-{given.task}-{given.algorithm}{'-blind' * given.blind}-{given.seed}.png")
