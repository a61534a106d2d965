"""Learning of a policy by proximal policy optimisation (stable-baselines3), and evaluating it on either backend.

The network's input is not the displacement of some hundred pins, but its principal components in random motions. From the same motions, a
second network, the state estimator, is trained to predict the values that only the simulation has, such as place and force. Its estimates
are also an input of the policy.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from pydantic import Field
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from training.environments.baselines import BaselinesVecEnv
from training.environments.batch import CHECKED, Options, Settings, checked, require_task
from training.environments.environment import TactileVectorEnv
from training.environments.observe import Pictures
from training.environments.policy_domain import with_domain
from twin.policy import Policy, flatten
from twin.progress import Progress, Step, silent, stage
from twin.report.charts import new_figure, save_figure
from twin.store import Layers, text_file, write_json, writes
from twin.types import FloatArray, ReadableResult

COMPONENTS, ROUGH_COMPONENTS = 48, 24
"""Numbers of principal components of the pins' motion that a network gets, with and without the state estimator."""
RANDOM_STEPS = 400
"""Random steps of each environment, from which the components are computed and the state estimator is trained."""
SIGHT_LAYERS = (256, 256)
"""Neurons of the hidden layers of the state estimator, with tanh. Its error in a rolling ball's place is 0.09 mm; with 24 components and 64
neurons it is 0.22 mm."""
SIGHT_EPOCHS, SIGHT_BATCH, SIGHT_RATE = 30, 256, 2e-3
"""Training of the state estimator by Adam: epochs, batch, and learning rate, which falls to 0."""
LEAST_DEVIATION = 1e-3
"""Least scale of a value that the state estimator predicts, so that a constant value does not lead to a division by 0."""
LEAST_SPREAD, ROUGH_SPREAD = 0.01, 0.02
"""Least scale of a component, with and without the state estimator, as a share of the largest component's spread. Smaller components are
noise."""
NETWORK = {"net_arch": [64, 64], "log_std_init": -0.7}
"""Neurons of the policy's hidden layers, with tanh, and logarithm of the first standard deviation of its actions."""
PPO_SETTINGS: dict[str, Any] = {"n_epochs": 8, "learning_rate": 7e-4, "gamma": 0.95, "gae_lambda": 0.9, "ent_coef": 0.0}
"""Settings of proximal policy optimisation."""
ROLLOUT = 32
"""Steps of each environment between two updates."""
WINDOW = 100
"""Number of newest episodes from which the share of success is computed during the learning."""
ENOUGH = 0.97
"""Share of success that ends the learning."""
ROWS_JUDGED = 8
"""Number of episodes that are evaluated together on the surrogate."""


@checked(frozen=True, config=CHECKED)
class LearnPlan(Settings):
    """Settings of the learning of a policy.

    Attributes
    ----------
    task : str
        Name of the task, of ``TASKS``.
    options : Options
    minutes : float
        Longest time.
    environments : int
        Number of environments that are stepped together.
    seed : int
    episodes : int
        Number of episodes in which the policy is evaluated at the end, on the backend of its training.
    fem_episodes : int
        Number of episodes on finite elements, with rasterised frames and the real pipeline; 0: none.
    sight : bool
        First train to estimate the values that only the simulation has. This makes a policy precise on the backend of its training.
        But the policy then depends on small motions of the pins, in which a surrogate has errors.
    """

    task: str
    options: Options = field(default_factory=Options)
    minutes: Annotated[float, Field(gt=0)] = 30.0
    environments: Annotated[int, Field(ge=2)] = 32
    seed: Annotated[int, Field(ge=0)] = 0
    episodes: Annotated[int, Field(ge=1)] = 100
    fem_episodes: Annotated[int, Field(ge=0)] = 0
    sight: bool = True

    def __post_init__(self) -> None:
        require_task(self.task)


@dataclass(frozen=True, repr=False)
class Learnt(ReadableResult):
    """The result of the learning. ``curve`` holds (steps, seconds, share of success, mean reward) after each update."""

    policy: Policy
    curve: list[tuple[int, float, float, float]]
    success: dict[str, float]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        steps, seconds = self.curve[-1][:2] if self.curve else (0, 0.0)
        results = ", ".join(f"{share:.0%} of the episodes on {where}" for where, share in self.success.items())
        return [f"{steps} steps in {seconds / 60:.1f} min; solved {results}"]


class SteppedTogether(BaselinesVecEnv):
    """A ``TactileVectorEnv`` in stable-baselines3's interface, with observations reduced to the network's input."""

    def __init__(self, vector: TactileVectorEnv, policy: Policy) -> None:
        self.policy = policy
        super().__init__(vector)

    def seen_space(self) -> spaces.Box:
        """See ``BaselinesVecEnv``."""
        return spaces.Box(-np.inf, np.inf, (self.seen(self.vector.batch.observation()).shape[1],), np.float32)

    def seen(self, observed: dict[str, Any]) -> FloatArray:
        """See ``BaselinesVecEnv``."""
        return self.policy.reduce_inputs(observed["tactile"], observed["goal"])


class _Watch(BaseCallback):
    """Records the learning curve, and ends the learning when the success is high enough or the time is over."""

    def __init__(self, plan: LearnPlan, step: Step, begun_s: float) -> None:
        super().__init__()
        self._plan, self._step, self._begun = plan, step, begun_s
        self._ended: list[bool] = []
        self._rewards: list[float] = []
        self.curve: list[tuple[int, float, float, float]] = []

    def _on_step(self) -> bool:
        self._ended += [info["is_success"] for info in self.locals["infos"] if "terminal_observation" in info]
        self._rewards.append(float(np.mean(self.locals["rewards"])))
        enough = len(self._ended) >= 2 * WINDOW and float(np.mean(self._ended[-WINDOW:])) >= ENOUGH
        return time.monotonic() - self._begun < 60.0 * self._plan.minutes and not enough

    def _on_rollout_end(self) -> None:
        seconds = time.monotonic() - self._begun
        share = float(np.mean(self._ended[-WINDOW:])) if self._ended else 0.0
        self.curve.append((self.num_timesteps, seconds, share, float(np.mean(self._rewards[-ROLLOUT:]))))
        self._step(seconds, 60.0 * self._plan.minutes, f"{share:.0%} solved")


@writes("policy.safetensors", "learning.csv", "learning.png", "result.json")
def learn_policy(plan: LearnPlan, out: Path, *, progress: Progress = silent) -> Learnt:
    """Learn a policy and write it to ``out``, with its learning curve.

    Raises
    ------
    OptionError
        An option can't be fulfilled.
    """
    torch.set_num_threads(1)
    begun_s, used_s = time.monotonic(), time.process_time()
    vector = TactileVectorEnv(plan.task, plan.environments, autoreset_mode=AutoresetMode.SAME_STEP, **asdict(plan.options))
    blank = _untrained_inputs(plan, vector)
    env = SteppedTogether(vector, blank)
    env.seed(plan.seed)
    batch = max(plan.environments * ROLLOUT // 4, 2)
    ppo = PPO("MlpPolicy", env, n_steps=ROLLOUT, batch_size=batch, policy_kwargs=NETWORK, seed=plan.seed, device="cpu", **PPO_SETTINGS)
    with stage(progress, f"learning {plan.task}") as step:
        watch = _Watch(plan, step, begun_s)
        ppo.learn(10**9, callback=watch)
    used_s = time.process_time() - used_s
    made = replace(blank, layers=_layers_of([*ppo.policy.mlp_extractor.policy_net, ppo.policy.action_net]))
    made = with_domain(made, vector, seed=plan.seed)
    written = [out / "policy.safetensors", out / "learning.csv", out / "learning.png", out / "result.json"]
    made.save(written[0])  # saved before it is evaluated, because evaluating takes long and may be interrupted
    _write_curve(watch.curve, written[1], written[2])
    judged = evaluate_policy(made, plan.task, plan.options, plan.episodes, seed=10_000 + plan.seed)
    success: dict[str, float] = {str(plan.options.backend): judged}
    if not plan.options.friction_history:
        remembering = replace(plan.options, friction_history=True)
        success["surrogate, friction history"] = evaluate_policy(made, plan.task, remembering, plan.episodes, seed=10_000 + plan.seed)
    if plan.fem_episodes:
        true = on_finite_elements(plan.options, tuple(vector.batch.objects))
        success["finite elements, rasterised frames"] = evaluate_policy(made, plan.task, true, plan.fem_episodes, seed=20_000 + plan.seed)
    steps, seconds = watch.curve[-1][:2] if watch.curve else (ppo.num_timesteps, time.monotonic() - begun_s)
    results = {"success": success, "steps": steps, "minutes": round(seconds / 60, 2), "core_minutes": round(used_s / 60, 2)}
    write_json(written[3], {"task": plan.task, "options": asdict(plan.options), **results})
    return Learnt(made, watch.curve, success, written)


def on_finite_elements(options: Options, objects: tuple[str, ...]) -> Options:
    """The same environment and objects on finite elements, with rasterised frames and the real pipeline."""
    seen: Pictures = "preview" if options.observation != "oracle" else "none"
    return replace(options, backend="fem", surrogate=None, friction_history=True, pictures=seen, objects=objects)


def _write_curve(curve: Sequence[tuple[int, float, float, float]], table: Path, picture: Path) -> None:
    with text_file(table) as file:
        file.write("steps,seconds,success,reward\n")
        file.writelines(f"{steps},{seconds:.1f},{share:.4f},{reward:.4f}\n" for steps, seconds, share, reward in curve)
    figure, axes = new_figure(2, 1)
    for ax, column, name in zip(axes, (2, 3), ("episodes solved", "mean reward of a step"), strict=True):
        ax.plot([row[0] for row in curve], [row[column] for row in curve])
        ax.set(xlabel="steps", ylabel=name)
    save_figure(picture, figure)


def evaluate_policy(policy: Policy, task: str, options: Options, episodes: int, *, seed: int = 0) -> float:
    """Share of episodes that a policy solves, with its mean action, eight at a time (one on finite elements).

    Of B rows, row k evaluates the episodes k, k + B, ... If instead the first episodes that end were counted, short failures would replace
    long successes.
    """
    rows = min(episodes, ROWS_JUDGED if options.backend == "surrogate" else 1)
    vector = TactileVectorEnv(task, rows, autoreset_mode="SameStep", **asdict(options))
    seen, _ = vector.reset(seed=seed)
    share = np.array([len(range(row, episodes, rows)) for row in range(rows)])
    ended = solved = np.zeros(rows, int)
    while (ended < share).any():
        seen, _, terminated, truncated, results = vector.step(policy.act(seen["tactile"], seen["goal"]))
        counted = (terminated | truncated) & (ended < share)
        if counted.any():
            ended, solved = ended + counted, solved + (counted & results["final_info"]["is_success"])
    return float(solved.sum() / episodes)


def _untrained_inputs(plan: LearnPlan, vector: TactileVectorEnv) -> Policy:
    """The policy's inputs (components and state estimator) from random motions, without the network of the actions."""
    batch, task = vector.batch, vector.batch.task
    rng = np.random.default_rng(plan.seed)
    vector.reset(seed=plan.seed)
    rows, goals, truths = [], [], []
    drift = np.zeros((vector.num_envs, *(vector.single_action_space.shape or ())))
    for _ in range(RANDOM_STEPS):
        drift = np.clip(0.8 * drift + 0.4 * rng.normal(size=drift.shape), -1, 1)
        seen, *_ = vector.step(drift)
        rows.append(flatten(seen["tactile"]))
        goals.append(seen["goal"])
        truths.append(batch.oracle())
    flat, goal = np.concatenate(rows).astype(np.float32), np.concatenate(goals)
    mean = flat.mean(axis=0)
    variance, basis = np.linalg.eigh(np.cov(flat - mean, rowvar=False).reshape(flat.shape[1], -1))
    count, least = (COMPONENTS, LEAST_SPREAD) if plan.sight else (ROUGH_COMPONENTS, ROUGH_SPREAD)
    largest = np.argsort(variance)[::-1][:count]
    spread = np.sqrt(np.maximum(variance[largest], least**2 * variance.max()))
    about: dict[str, Any] = {"task": plan.task, "experiment": task.experiment, "sensor": batch.sensor.model_dump(mode="json")}
    about |= {"observation": plan.options.observation, "stack": plan.options.stack, "axes": list(batch.axes)}
    about |= {"scale": batch.action_scale.tolist(), "feed_mm": list(task.feed_mm), "goal_names": list(task.goal_names)}
    about |= {"goal": np.median(goal, axis=0).tolist(), "trained": {**asdict(plan.options), "seed": plan.seed}}
    blank = Policy(about, mean, basis[:, largest].T / spread[:, None], ())
    if plan.options.observation == "oracle" or not plan.sight:
        return blank
    return replace(blank, sight=_train_state_estimator(((flat - mean) @ blank.basis.T, goal), np.concatenate(truths), plan.seed))


def _train_state_estimator(given: Sequence[FloatArray], truth: FloatArray, seed: int) -> Layers:
    """A network that estimates the values that only a simulation knows (S, O), scaled to about 1, from the inputs (S, ...)."""
    inputs = torch.tensor(np.concatenate(given, axis=1), dtype=torch.float32)
    wanted = torch.tensor((truth - truth.mean(axis=0)) / np.maximum(truth.std(axis=0), LEAST_DEVIATION), dtype=torch.float32)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        sizes = (inputs.shape[1], *SIGHT_LAYERS, wanted.shape[1])
        linear = [torch.nn.Linear(size, following) for size, following in pairwise(sizes)]
        network = torch.nn.Sequential(*[part for layer in linear for part in (layer, torch.nn.Tanh())][:-1])
        adam = torch.optim.Adam(network.parameters(), SIGHT_RATE)
        for epoch in range(SIGHT_EPOCHS):
            adam.param_groups[0]["lr"] = SIGHT_RATE * (1.0 - epoch / SIGHT_EPOCHS)
            for some in torch.randperm(len(inputs)).split(SIGHT_BATCH):
                adam.zero_grad()
                torch.nn.functional.mse_loss(network(inputs[some]), wanted[some]).backward()
                adam.step()
    return _layers_of(linear)


def _layers_of(parts: Sequence[torch.nn.Module]) -> Layers:
    """The weights and offsets of a network's linear parts."""
    linear = [part for part in parts if isinstance(part, torch.nn.Linear)]
    return tuple((layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()) for layer in linear)
