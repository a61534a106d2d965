"""A vector of environments as stable-baselines3 takes it, for ``PPO("MultiInputPolicy", BaselinesVecEnv(gymnasium.make_vec(...)))``."""

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from stable_baselines3.common.vec_env import VecEnv

from training.environments.environment import Seen, TactileVectorEnv
from twin.errors import OptionError
from twin.types import FloatArray


class BaselinesVecEnv(VecEnv):
    """A ``TactileVectorEnv`` in stable-baselines3's interface: rows are stepped together, and begin again in the step that ends them.

    Parameters
    ----------
    vector : VectorEnv
        What ``gymnasium.make_vec`` makes of a task's id, without wrappers. Its ``autoreset_mode`` becomes ``SAME_STEP``.

    Raises
    ------
    OptionError
        The vector is no ``TactileVectorEnv``, or is wrapped.
    """

    def __init__(self, vector: VectorEnv[Any, Any, Any]) -> None:
        if isinstance(vector, VectorWrapper) and isinstance(vector.unwrapped, TactileVectorEnv):
            raise OptionError(f"{vector!r} would be lost; give vector.unwrapped, and use a VecEnvWrapper of stable-baselines3")
        if not isinstance(vector, TactileVectorEnv):
            raise OptionError(
                f"{vector!r} is not a vector of this program's environments; use gymnasium.make_vec('twin:tactip/EdgeFollow-v0')"
            )
        self.vector = vector
        self._actions: FloatArray = np.zeros(0)
        self.vector.metadata["autoreset_mode"] = AutoresetMode.SAME_STEP
        super().__init__(vector.num_envs, self.seen_space(), vector.single_action_space)

    def seen_space(self) -> spaces.Space[Any]:
        """Space of one row of ``seen``."""
        return self.vector.single_observation_space

    def seen(self, observed: Seen) -> Any:
        """What the learner gets of the observations of all rows."""
        return observed

    def reset(self) -> Any:
        """See ``VecEnv``. Row i gets the i-th of the seeds that ``seed`` set."""
        seeds = list(self._seeds)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        observed, _ = self.vector.reset(seed=None if None in seeds else seeds)
        self._reset_seeds()
        return self.seen(observed)

    def step_async(self, actions: FloatArray) -> None:
        """See ``VecEnv``."""
        self._actions = actions

    def step_wait(self) -> Any:
        """See ``VecEnv``."""
        observed, reward, terminated, truncated, told = self.vector.step(self._actions)
        done = terminated | truncated
        infos = _by_row(told, self.num_envs)
        for row in np.flatnonzero(done):
            last = self.seen({name: part[None] for name, part in told["final_obs"][row].items()})
            infos[row] = _by_row(told["final_info"], self.num_envs)[row] | {
                "terminal_observation": {name: part[0] for name, part in last.items()} if isinstance(last, dict) else last[0],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return self.seen(observed), reward.astype(np.float32), done, infos

    def close(self) -> None:
        """See ``VecEnv``."""
        self.vector.close()

    def get_images(self) -> list[Any]:
        """See ``VecEnv``."""
        return list(self.vector.render() or [])

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """See ``VecEnv``."""
        return [getattr(self.vector, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """The environments have nothing to set."""
        raise OptionError(f"{attr_name} can't be set")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """The environments have no methods of their own."""
        raise OptionError(f"the environments have no method {method_name}")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """See ``VecEnv``."""
        return [False for _ in self._get_indices(indices)]


def _by_row(told: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """The ``info`` of each row, of arrays with masks."""
    infos: list[dict[str, Any]] = [{} for _ in range(count)]
    for name in told:
        if f"_{name}" in told and name not in ("final_obs", "final_info"):
            for row in np.flatnonzero(told[f"_{name}"]):
                infos[row][name] = told[name][row]
    return infos
