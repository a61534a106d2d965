"""Several environments of one task, stepped together; a single environment is a batch of one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from difflib import get_close_matches
from os import PathLike
from typing import Annotated, Any, Literal, Self

import numpy as np
from gymnasium import spaces
from pydantic import BeforeValidator, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass as checked

from scenes import ObjectSpec, RandomisationSpec, SensorSpec, load_experiment, load_object, load_randomisation, load_sensor
from scenes.base import problem_text
from scenes.files import quote
from training.environments.observe import IMAGE_PX, Eye, Kind, Pictures
from training.environments.tasks import TASKS, StepOutcome, WorldState, add_tasks
from training.environments.world import AXES, Axis, Surfaces, Tool, motions
from training.generation.config import draw_friction, draw_sensor
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.model import is_mechanical, surrogate_of
from training.surrogate.reading import Backend, EpisodeContact, FiniteElements
from twin.errors import ContactError, OptionError
from twin.rig.contact import contact_law
from twin.rig.touch import TrueTouch
from twin.types import BoolArray, FloatArray, Frame, ImageArray, IntArray

BackendName = Literal["surrogate", "fem"]
"""Names of the contact solvers."""
PERIOD_S = 0.1
"""Duration of a step, s: an agent decides ten times per second."""
MOST_STACK = 16
"""Most observations that can be stacked."""
MOST_ORACLE = 100.0
"""Largest size of the values that only a simulation knows. Larger values are clipped."""
RESET_OPTIONS = ("object",)
"""Keys that ``reset(options=...)`` accepts."""


def require_task(task: str) -> None:
    """Raise ``OptionError`` if there is no task of this name."""
    add_tasks()
    if task not in TASKS:
        near = get_close_matches(str(task).lower(), [name.lower() for name in TASKS], n=1)
        hint = "".join(f"did you mean {name!r}? " for name in TASKS if name.lower() in near)
        raise OptionError(f"there is no task {task!r}; {hint}tasks are {', '.join(TASKS)}")


def _as_name(given: Any) -> str:
    if not isinstance(given, str | PathLike):
        raise ValueError("expected a name or a file")
    return str(given)


def _as_tuple(given: Any) -> Any:
    several = (given,) if isinstance(given, str | PathLike) else tuple(given) if isinstance(given, Iterable) else ()
    if not several:
        raise ValueError("expected a name or several")
    return several


CHECKED = ConfigDict(strict=True, allow_inf_nan=False, extra="forbid")
Named = Annotated[str, BeforeValidator(_as_name)]
Several = BeforeValidator(_as_tuple)
FORMER_OPTIONS = {"friction_memory": "friction_history"}
"""Present names of options by their names in version 1."""


@checked(frozen=True, config=CHECKED)
class Settings:
    """Base of settings: values of a wrong kind, or out of range, raise ``OptionError``."""

    @model_validator(mode="wrap")
    @classmethod
    def _name_option(cls, given: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return check(given)
        except ValidationError as error:
            found, known = error.errors(include_url=False)[0], [field.name for field in fields(cls)]
            if not found["loc"]:  # no settings at all: the plan that holds them names them
                raise
            if found["type"] == "missing":
                raise OptionError(f"`{found['loc'][0]}` is missing") from error
            name, said = str(found["loc"][0]), problem_text(found)
            if name not in known:
                near = get_close_matches(name, known, n=1)
                said = f"no such option; did you mean {near[0]!r}?" if near else f"no such option; there are {', '.join(known)}"
            raise OptionError(f"{name}={quote(repr(found['input']))}: {said}") from error


@checked(frozen=True, config=CHECKED)
class Options(Settings):
    """Options of an environment, given by keyword.

    Attributes
    ----------
    sensor : str
        Name or file.
    observation : {"pins", "oracle", "graph", "image", "pose"}
        Content of ``tactile``: displacements of the pins in spacings (N, 2); values that no sensor measures; the graph's node features
        (N, 5); a small gray picture (128, 128); the pose of the shipped estimator.
    stack : int
        Number of newest observations that are given together, the newest last.
    axes : tuple of str, optional
        Axes that the agent moves, of x, y, z, Rx, Ry, Rz in the tool's work frame; the task's by default.
    backend : {"surrogate", "fem"}
        The surrogate (a fast approximation with a stated error), or finite elements.
    surrogate : str, optional
        File of ``twin surrogate``; the shipped one by default.
    objects : tuple of str, optional
        Names or files of objects. One of them is sampled for each episode. The task's objects by default.
    randomise : str, optional
        Name or file of a randomisation of friction, camera and other properties of the sensor, and noise of the pins. Values are sampled
        for each episode.
    pictures : {"none", "preview", "traced"}
        Find the pins with the real pipeline in rendered frames. Observation "image" uses previews if the value is "none".
    friction_history : bool
        With False each step forgets the object's earlier path (only for ``surrogate``; it serves to measure the memory's effect).
    steps : int, optional
        Number of steps of an episode; the task's by default.
    """

    sensor: Named = "mg400-331"
    observation: Kind = "pins"
    stack: Annotated[int, Field(ge=1, le=MOST_STACK)] = 1
    axes: Annotated[tuple[Axis, ...], Several] | None = None
    backend: BackendName = "surrogate"
    surrogate: Named | None = None
    objects: Annotated[tuple[Named, ...], Several] | None = None
    randomise: Named | None = None
    pictures: Pictures = "none"
    friction_history: bool = True
    steps: Annotated[int, Field(ge=1)] | None = None

    def __post_init__(self) -> None:
        if len(set(self.axes or ())) < len(self.axes or ()):
            raise OptionError(f"axes={self.axes!r}: expected each axis once")
        if self.backend == "fem" and not self.friction_history:
            raise OptionError("friction_history=False needs backend='surrogate': finite elements always have history-dependent friction")

    @classmethod
    def from_keywords(cls, options: Mapping[str, Any]) -> "Options":
        """Options from keywords.

        Raises
        ------
        OptionError
            There is no such option, or a value is not valid.
        """
        return cls(**{FORMER_OPTIONS.get(name, name): value for name, value in options.items()})


def require_known(how: RandomisationSpec | None) -> None:
    """Raise ``OptionError`` for a randomisation of values that are fixed in a surrogate."""
    if how and (drawn := [key for key in how.sensor if is_mechanical(*key.split("."))]):
        raise OptionError(
            f"randomise={how.name!r} samples {drawn[0]}, which the surrogate keeps fixed; use backend='fem', "
            "or a randomisation of friction, camera and noise, such as 'moves'"
        )


def _ends(how: RandomisationSpec | None) -> tuple[float | None, ...]:
    """Limits of the friction that a randomisation draws; None if the friction stays that of the rig or object."""
    if how is None or how.friction is None:
        return (None,)
    return how.friction.high, how.friction.stick if how.friction.stick_share else how.friction.low


@dataclass(frozen=True)
class Stepped:
    """Result of a step of B environments, as in gymnasium; each entry of ``info`` is an array (B,), with None for rows without a value."""

    reward: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    info: dict[str, Any]


class Batch:
    """``count`` environments of one task.

    Parameters
    ----------
    task : str
        Name of the task, of ``TASKS``.
    count : int
    options : Options

    Raises
    ------
    OptionError, SpecError, ContactError
        An option can't be fulfilled.
    """

    def __init__(self, task: str, count: int, options: Options) -> None:
        require_task(task)
        self.options, self.count = options, count
        self.task = TASKS[task]()
        self.task.prepare(count)
        self.sensor = load_sensor(options.sensor)
        self.tool = Tool.of(self.sensor, load_experiment(self.task.experiment))
        self.objects = {name: load_object(name) for name in options.objects or self.task.objects}
        for obj in self.objects.values():
            self.task.require(obj)
        self.randomisation = load_randomisation(options.randomise) if options.randomise else None
        self.steps = options.steps or self.task.steps
        self._surfaces = Surfaces()
        if options.backend == "fem":
            self.backend: Backend = FiniteElements(self.sensor, count)
        else:
            require_known(self.randomisation)
            found = surrogate_of(self.sensor, options.surrogate)
            self.backend = SurrogateContacts(found, self.sensor, count, friction_history=options.friction_history)
        for name, obj in list(self.objects.items()):
            try:
                for friction in _ends(self.randomisation):
                    self.backend.require(self._contact(self.sensor, obj, friction))
            except ContactError:
                if options.objects is not None or len(self.objects) == 1:
                    raise
                del self.objects[name]  # of the task's own objects, only those that the backend knows remain
        noise_px = self.randomisation.pin_noise_px if self.randomisation else 0.0
        pictures: Pictures = "preview" if options.observation == "image" and options.pictures == "none" else options.pictures
        self.eye: Eye | None = None
        if options.observation != "oracle":
            self.eye = Eye(self.sensor, count, options.observation, pictures=pictures, pin_noise_px=noise_px)
        self._shows = self.eye or Eye(self.sensor, count, "pins", pictures="none", pin_noise_px=0.0)
        self.axes = options.axes or self.task.axes
        self.action_scale = np.array([self.task.largest_deg if axis.startswith("R") else self.task.largest_mm for axis in self.axes])
        self._rngs: list[np.random.Generator] = [np.random.default_rng(0)] * count
        self.contacts: list[EpisodeContact | None] = [None] * count
        self.T_work, self.T_object = np.tile(np.eye(4), (2, count, 1, 1))
        self.goal = np.zeros((count, len(self.task.goal_names)))
        self.steps_done = np.zeros(count, int)
        self._good = np.zeros(count, int)
        self._action = np.zeros((count, len(self.axes)))
        self._seen: FloatArray | ImageArray | None = None

    def action_space(self) -> spaces.Box:
        """Action space of one environment."""
        return spaces.Box(-1.0, 1.0, (len(self.axes),), np.float32)

    def observation_space(self) -> spaces.Dict:
        """Observation space of one environment: ``tactile`` and ``goal``."""
        goal = spaces.Box(-100.0, 100.0, (len(self.task.goal_names),), np.float32)
        stack = self.options.stack
        if self.options.observation == "image":
            return spaces.Dict({"tactile": spaces.Box(0, 255, (IMAGE_PX, IMAGE_PX, stack), np.uint8), "goal": goal})
        shape = (len(self.task.oracle_names),) if self.eye is None else self.eye.shape
        limit = MOST_ORACLE if self.eye is None else self.eye.limit
        return spaces.Dict({"tactile": spaces.Box(-limit, limit, (stack, *shape), np.float32), "goal": goal})

    def begin(self, row: int, rng: np.random.Generator, wanted: Mapping[str, Any] | None = None) -> None:
        """Draw an episode of one environment: object, friction, sensor, start and goal. ``settle`` then makes the first contact."""
        if not isinstance(wanted, Mapping | None):
            raise OptionError(f"reset(options={quote(repr(wanted))}): expected a dict, such as {{'object': 'can'}}")
        wanted = dict(wanted or {})
        for name in wanted:
            if name not in RESET_OPTIONS:
                raise OptionError(f"reset(options=...) has no {name!r}; it takes {', '.join(RESET_OPTIONS)}")
        if not isinstance(wanted.get("object", ""), str | PathLike):
            raise OptionError(f"reset(options=...): object={wanted['object']!r}: expected a name or a file")
        name = str(wanted.get("object") or rng.choice(list(self.objects)))
        obj = self.objects.get(name) or load_object(name)
        self.task.require(obj)
        how = self.randomisation
        friction = draw_friction(how.friction, rng) if how and how.friction else None
        sensor = draw_sensor(self.sensor, how, rng)[0] if how and how.sensor else self.sensor
        contact = self._contact(sensor, obj, friction)
        self.backend.begin(row, contact)
        self._shows.begin(row, sensor)
        start = self.task.begin(row, self.tool, obj, self._surfaces, rng)
        self.T_work[row], self.T_object[row], self.goal[row] = start.T_work, start.T_object, start.goal
        self._rngs[row], self.contacts[row] = rng, contact
        self.steps_done[row] = self._good[row] = 0
        self._action[row] = 0.0

    def _contact(self, sensor: SensorSpec, obj: ObjectSpec, friction: float | None) -> EpisodeContact:
        return EpisodeContact(sensor, obj, contact_law(sensor.rig, self.tool.mounting, obj, friction=friction))

    def settle(self, rows: IntArray) -> None:
        """Make the first contact of the rows that ``begin`` drew, and fill their stacks of observations."""
        self._move(rows)
        self._look(rows, first=True)

    def as_numbers(self, action: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """The action of one row, or those of all rows, as numbers of the shape that the caller's action space has.

        Raises
        ------
        OptionError
            It is no array of numbers, or has another shape.
        """
        expected = f"an action of shape {shape} is expected ({', '.join(self.axes)})"
        try:
            numbers = np.asarray(action, float)
        except (TypeError, ValueError):
            raise OptionError(f"{expected}, got {quote(repr(action))}") from None
        if numbers.shape != shape:
            raise OptionError(f"{expected}, got {numbers.shape}")
        return numbers

    def step(self, actions: FloatArray, rows: IntArray) -> Stepped:
        """Move the tools of some rows by actions (B, A); the other rows of the results are zero.

        Raises
        ------
        OptionError
            An action is not finite or has a wrong shape.
        """
        actions = self.as_numbers(actions, self._action.shape)
        if not np.isfinite(actions[rows]).all():
            raise OptionError(f"an action is not a finite number: {actions[rows]}; look for NaN in the policy")
        self._action[rows] = np.clip(actions[rows], -1.0, 1.0)
        steps = np.zeros((self.count, 6))
        steps[:, [AXES.index(axis) for axis in self.axes]] = self._action * self.action_scale
        steps[:, :3] += self.task.feed_mm
        before = self.T_work.copy()
        self.T_work[rows] = before[rows] @ motions(steps)[rows]
        carried = self.task.carry_object(self.backend.felt, self.T_work, before, self.T_object)
        self.T_object[rows] = carried[rows]
        self.steps_done[rows] += 1
        self._move(rows)
        pushed = self.task.push_object(self.backend.felt, self.T_work, self.T_object, self.tool)
        if pushed is not None:
            self.T_object[rows] = pushed[rows]
            self._move(rows)
        self._look(rows, first=False)
        return self._evaluate_step(rows)

    def observation(self) -> dict[str, FloatArray | ImageArray]:
        """The newest observations of all rows; copies."""
        assert self._seen is not None, "settle first"
        seen = np.moveaxis(self._seen, 1, -1) if self.options.observation == "image" else self._seen
        return {"tactile": seen.copy(), "goal": self.goals_for_agents().astype(np.float32)}

    def goals_for_agents(self) -> FloatArray:
        """Goals of the episodes as the agents get them, (B, G), by the task's ``goal_names``."""
        return self.task.goals_for_agents(self.goal, self.T_work)

    def oracle(self) -> FloatArray:
        """Values of the newest states that no real sensor measures, (B, K), by the task's ``oracle_names``."""
        return np.clip(self.task.oracle(self._observe_world()), -MOST_ORACLE, MOST_ORACLE)

    def expert(self) -> FloatArray:
        """Actions (B, A) of the task's scripted expert in the newest states.

        Raises
        ------
        OptionError
            The task has no expert, or other axes than the task's were chosen.
        """
        if self.axes != self.task.axes:
            raise OptionError(f"axes={self.axes!r}: the expert moves {', '.join(self.task.axes)}; leave this option out")
        return np.clip(self.task.expert(self._observe_world()) / self.action_scale, -1.0, 1.0)

    def picture(self, row: int) -> ImageArray:
        """(H, W, 3) uint8: the sensor's frame of one environment."""
        image = self.frame(row).image
        return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)

    def frame(self, row: int) -> Frame:
        """The sensor's frame of one environment."""
        return self._shows.frame(row, self.backend.attitude(row), np.random.default_rng(int(self.steps_done[row])))

    def begin_info(self) -> dict[str, Any]:
        """Entries of ``info`` at the beginning of the episodes: names (B,) of the objects."""
        return {"object": np.array([None if contact is None else contact.obj.name for contact in self.contacts], object)}

    def touch(self) -> TrueTouch:
        """Contact of the tools if the sensors were rigid, in all rows."""
        T = self.tool.object_poses(self.T_work, self.T_object)
        parts = {field.name: np.zeros((self.count, 3) if field.name == "place_mm" else self.count) for field in fields(TrueTouch)}
        things = [None if contact is None else contact.obj for contact in self.contacts]
        for obj in {id(one): one for one in things if one is not None}.values():
            rows = [row for row, one in enumerate(things) if one is obj]
            found = self._surfaces[obj].depth_and_angle(self.tool.mounting, T[rows])
            for key, values in parts.items():
                values[rows] = getattr(found, key)
        return TrueTouch(**parts)

    def _observe_world(self) -> WorldState:
        return WorldState(self.touch(), self.backend.felt, self.T_work, self.T_object, self.goal, self._action)

    def _evaluate_step(self, rows: IntArray) -> Stepped:
        seen = self._observe_world()
        active = np.zeros(self.count, bool)
        active[rows] = True
        kept = self.task.kept.copy()
        judged: StepOutcome = self.task.evaluate(seen)
        self.task.kept[~active] = kept[~active]  # rows that only begin, or rest, made no step, so the task's memory of them is kept
        lost = np.array([bool(why) for why in self.backend.felt.lost])
        failed, reached = (judged.failed | lost) & active, judged.reached & active & ~lost
        late = self.steps_done > self.steps // 2
        self._good += judged.good & active & late
        ended = (self.steps_done >= self.steps) & active
        enough = self._good >= self.task.success_share * np.maximum(self.steps_done - self.steps // 2, 1)
        success = reached | (ended & ~failed & enough & (self.task.success_share > 0))
        reward = np.where(active, np.where(failed, self.task.failed_reward, judged.reward), 0.0)
        why = np.full(self.count, None, object)
        for row in np.flatnonzero(lost & active):
            why[row] = self.backend.felt.lost[row]
        force_n = np.linalg.norm(seen.reading.force_n, axis=1)
        info: dict[str, Any] = {"indent_mm": seen.touch.indent_mm, "angle_deg": seen.touch.angle_deg, "force_n": force_n}
        info |= {"slip": seen.reading.slip.copy(), "is_success": success, "outside": why, **judged.terms}
        return Stepped(reward, failed | reached, ended & ~(failed | reached), info)

    def _move(self, rows: IntArray) -> None:
        T = self.tool.object_poses(self.T_work, self.T_object)
        self.backend.move(rows, T[rows], self.steps_done[rows] * PERIOD_S)

    def _look(self, rows: IntArray, *, first: bool) -> None:
        newest: FloatArray | ImageArray
        if not len(rows):
            return
        if self.eye is None:
            newest = self.oracle()[rows].astype(np.float32)
            valid = np.ones(len(rows), bool)
        else:
            newest, valid = self.eye.look(self.backend, rows, self._rngs)
        if self._seen is None:
            self._seen = np.zeros((self.count, self.options.stack, *newest.shape[1:]), newest.dtype)
        if first:
            self._seen[rows] = newest[:, None]
            return
        kept = np.where(valid.reshape(-1, *[1] * (newest.ndim - 1)), newest, self._seen[rows, -1])
        self._seen[rows] = np.concatenate([self._seen[rows, 1:], kept[:, None]], axis=1)
