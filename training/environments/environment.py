"""The environments in gymnasium's interface: a single one, and a vector of them in one process."""

import sys
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from training.environments.batch import Batch, Options
from twin.errors import OptionError
from twin.types import BoolArray, FloatArray, ImageArray

if TYPE_CHECKING:
    from twin.studio.modes.episode import EpisodePage

RENDER_MODES = ("rgb_array", "human")
"""Values of ``render_mode`` besides None."""
RENDER_FPS = 10
"""Pictures per second at the pace of the steps. With ``human``, steps are slowed to this pace."""

UNITS = {"n": "N"}
"""Units whose sign is not the end of a value's name."""

Seen = dict[str, Any]


def _render_mode(mode: str | None) -> str | None:
    if mode is not None and mode not in RENDER_MODES:
        raise OptionError(f"render_mode={mode!r}: expected None or {', '.join(RENDER_MODES)}; to move a contact by hand use 'twin studio'")
    return mode


class TactileEnv(gymnasium.Env[Seen, FloatArray]):
    """One environment of a task.

    Parameters
    ----------
    task : str
        EdgeFollow, SurfaceFollow, ContourFollow, GentlePress, ObjectRoll or ObjectPush.
    render_mode : {None, "rgb_array", "human"}
        With ``human`` each step is shown on a page of the studio. Its address is printed on stderr at the first ``reset``.
    options
        See ``training.environments.batch.Options``.

    Raises
    ------
    OptionError
        An option is unknown, or its value is not valid.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": RENDER_FPS}  # type: ignore[misc]

    def __init__(self, task: str, *, render_mode: str | None = None, **options: Any) -> None:
        self.render_mode = _render_mode(render_mode)
        self.batch = Batch(task, 1, Options.from_keywords(options))
        self.observation_space = self.batch.observation_space()
        self.action_space = cast(spaces.Space[FloatArray], self.batch.action_space())
        self._state = "new"
        self._page: EpisodePage | None = None
        self._shown_s = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Seen, dict[str, Any]]:
        """Begin an episode; ``options`` can name its ``object``."""
        self._require_open()
        super().reset(seed=seed)
        self.batch.begin(0, self.np_random, options)
        self.batch.settle(np.zeros(1, int))
        self._state = "begun"
        self._show(0.0)
        return _row(self.batch.observation()), _row(self.batch.begin_info())

    def step(self, action: FloatArray) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Move the tool by an action (A,) from -1 to 1, where 1 is the task's largest move, mm or deg.

        Returns observation, reward, terminated, truncated and info; see gymnasium.

        Raises
        ------
        OptionError
            ``reset`` was not called first, the action is not finite or has a wrong shape, or the environment is closed.
        """
        self._require_open()
        if self._state == "new":
            raise OptionError("step() before reset(); call reset() first")
        done = self.batch.step(self.batch.as_numbers(action, (len(self.batch.axes),))[None], np.zeros(1, int))
        known = {key: value for key, value in _row(done.info).items() if value is not None}
        info = {key: value.item() if isinstance(value, np.generic) else value for key, value in known.items()}
        self._show(float(done.reward[0]))
        return _row(self.batch.observation()), float(done.reward[0]), bool(done.terminated[0]), bool(done.truncated[0]), info

    def render(self) -> ImageArray | None:
        """The sensor's frame, (H, W, 3) uint8, if the render mode is ``rgb_array``; else None. With ``human`` each step is shown anyway.

        Raises
        ------
        OptionError
            ``reset`` was not called first, or the environment is closed.
        """
        self._require_open()
        if self.render_mode != "rgb_array":
            return None
        if self._state == "new":
            raise OptionError("render() before reset(); call reset() first")
        return self.batch.picture(0)

    def close(self) -> None:
        """End; a second call has no effect, as gymnasium requires."""
        self._state = "closed"
        page, self._page = self._page, None
        if page is not None:
            page.__exit__()

    def __getstate__(self) -> dict[str, Any]:
        """All but the page: a copy of the environment opens its own."""
        return {**self.__dict__, "_page": None}

    def _show(self, reward: float) -> None:
        """Show the newest step on the page, if the render mode is ``human``."""
        if self.render_mode != "human":
            return
        from twin.studio.modes.episode import EpisodePage, EpisodeStep

        batch = self.batch
        frame, contact = batch.frame(0), batch.contacts[0]
        assert contact is not None, "reset first"
        if self._page is None:
            self._page = EpisodePage(f"TacTip episode: {self.spec.id if self.spec else batch.sensor.name}", batch.sensor, frame.form)
            print(f"open {self._page.url} in a browser: it shows the episode", file=sys.stderr, flush=True)
        T, felt = batch.tool.object_poses(batch.T_work, batch.T_object)[0], batch.backend.felt
        foot_mm = T[:3, :3] @ batch.touch().place_mm[0] + T[:3, 3]
        goal = ", ".join(map(_in_units, batch.task.goal_names, batch.goals_for_agents()[0].tolist()))
        area = f"{felt.area_mm2[0]:.0f} mm2, {100 * felt.slip[0]:.0f} %"
        told = {"goal": goal, "contact area, slipping": area, "not computed": felt.lost[0]}
        told = {name: text for name, text in told.items() if text}
        number, pins, force_n = int(batch.steps_done[0]), batch.backend.attitude(0), felt.force_n[0].copy()
        self._page.show(EpisodeStep(number, frame, pins, contact.obj, T, force_n, foot_mm, reward, told))
        time.sleep(max(0.0, self._shown_s + 1 / RENDER_FPS - time.monotonic()))
        self._shown_s = time.monotonic()

    def _require_open(self) -> None:
        if self._state == "closed":
            raise OptionError("the environment is closed; make a new one")


class TactileVectorEnv(VectorEnv[Seen, FloatArray, FloatArray]):
    """Several environments of a task, stepped together in this process. Row i with seed s is the single environment with seed s + i.

    Parameters
    ----------
    task : str
    num_envs : int
    autoreset_mode : AutoresetMode or str
        When the next episode begins: in the step after the end of an episode (gymnasium's default), or in the same step.
    render_mode, options
        As for ``TactileEnv``, but without ``human``, because a page shows one environment.

    Raises
    ------
    OptionError
        An option is not valid, or the mode is not offered.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        if autoreset_mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, "NextStep", "SameStep"):
            raise OptionError(f"autoreset_mode={autoreset_mode!r} is not supported; give 'NextStep' or 'SameStep'")
        mode = AutoresetMode(autoreset_mode)
        if not isinstance(num_envs, int) or num_envs < 1:
            raise OptionError(f"num_envs={num_envs!r}: expected a whole number of at least 1")
        if render_mode == "human":
            raise OptionError("render_mode='human' shows one environment: make it with gymnasium.make, or give 'rgb_array'")
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": RENDER_FPS, "autoreset_mode": mode}
        self.render_mode = _render_mode(render_mode)
        self.num_envs = num_envs
        self.batch = Batch(task, num_envs, Options.from_keywords(options))
        self.single_observation_space = self.batch.observation_space()
        self.single_action_space = self.batch.action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator] = []
        self._ended = np.zeros(num_envs, bool)
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Begin an episode in every row."""
        self._require_open()
        if not self._rngs or seed is not None:
            seeds = list(seed) if isinstance(seed, Sequence) else [None if seed is None else seed + row for row in range(self.num_envs)]
            if len(seeds) != self.num_envs:
                raise OptionError(f"reset(seed=...) got {len(seeds)} seeds for {self.num_envs} environments")
            self._rngs = [seeding.np_random(one)[0] for one in seeds]
        rows = np.arange(self.num_envs)
        self._restart(rows, options)
        self._ended[:] = False
        self._begun = True
        return self.batch.observation(), _of_rows(self.batch.begin_info(), np.ones(self.num_envs, bool))

    def step(self, actions: FloatArray) -> tuple[Seen, FloatArray, Any, Any, dict[str, Any]]:
        """Step every row by its action, (B, A) from -1 to 1; a row whose episode ended begins the next one (see ``autoreset_mode``).

        Raises
        ------
        OptionError
            ``reset`` was not called first, or the environments are closed.
        """
        self._require_open()
        if not self._begun:
            raise OptionError("step() before reset(); call reset() first")
        begun = self._ended
        self._restart(np.flatnonzero(begun), None)
        done = self.batch.step(actions, np.flatnonzero(~begun))
        ended, info = done.terminated | done.truncated, _of_rows(self.batch.begin_info(), begun)
        if self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            info |= _of_rows(done.info, ~begun)
            self._ended = ended
        else:
            info |= _of_rows(done.info, ~ended) | self._end_at_once(ended, done.info)
        return self.batch.observation(), done.reward, done.terminated, done.truncated, info

    def _end_at_once(self, ended: BoolArray, told: dict[str, Any]) -> dict[str, Any]:
        """Begin an episode in the rows (B,) in which one ended. Returns the entries of ``info`` about both episodes."""
        if not ended.any():
            return {}
        last, final = self.batch.observation(), np.full(self.num_envs, None, object)
        for row in np.flatnonzero(ended):
            final[row] = {key: values[row] for key, values in last.items()}
        self._restart(np.flatnonzero(ended), None)
        info = {"final_obs": final, "_final_obs": ended.copy(), "final_info": _of_rows(told, ended), "_final_info": ended.copy()}
        return info | _of_rows(self.batch.begin_info(), ended)

    def render(self) -> tuple[ImageArray, ...] | None:
        """The frames of all rows, each (H, W, 3) uint8, if the render mode is ``rgb_array``; else None.

        Raises
        ------
        OptionError
            The environments are closed.
        """
        self._require_open()
        return tuple(self.batch.picture(row) for row in range(self.num_envs)) if self.render_mode else None

    def close_extras(self, **kwargs: Any) -> None:
        """Nothing is open, so nothing is closed."""

    def _restart(self, rows: np.ndarray, options: Mapping[str, Any] | None) -> None:
        for row in rows.tolist():
            self.batch.begin(row, self._rngs[row], options)
        self.batch.settle(rows)

    def _require_open(self) -> None:
        if self.closed:
            raise OptionError("the environments are closed; make new ones")


def _of_rows(shown: dict[str, Any], rows: np.ndarray) -> dict[str, Any]:
    """Entries of ``info`` for some rows (B,), as gymnasium gathers them: each array with the mask of the rows that have a value."""
    info: dict[str, Any] = {}
    for name, values in shown.items():
        has = rows & np.array([value is not None for value in values]) if values.dtype == object else rows.copy()
        if has.any():
            info[name], info[f"_{name}"] = np.where(has, values, None if values.dtype == object else np.zeros_like(values)), has
    return info


def _in_units(name: str, value: float) -> str:
    """A value of an observation and its name in plain units: ``angle / 10 deg`` 0.3 is "angle 3.0 deg", ``force_n`` 1 is "force 1.0 N"."""
    what, _, divisor = name.partition(" / ")
    size, _, unit = divisor.partition(" ")
    what, _, short = what.partition("_")
    return f"{what} {value * float(size or 1):.1f} {unit or UNITS.get(short, short)}".strip()


def _row(seen: Seen) -> Seen:
    """The observation of the only environment."""
    return {key: values[0] for key, values in seen.items()}
