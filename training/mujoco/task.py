"""What the environments in MuJoCo scenes have in common: two sensors on a gripper, kinds of observation, and pictures."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, cast, get_args

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from scenes import load_sensor
from training.environments.grasp import PERIOD_S, as_observation, in_spacings, with_change
from training.mujoco.model import load_scene
from training.mujoco.scene import TactileReading, TactileScene
from twin.errors import OptionError
from twin.types import FloatArray, ImageArray

Touch = Literal["pins", "wrench", "none"]
TOUCHES: tuple[str, ...] = get_args(Touch)


class GripperTask(gymnasium.Env[dict[str, FloatArray], FloatArray]):
    """An environment with a gripper and two sensors.

    Parameters
    ----------
    sensor : str
        Name or file.
    observation : {"pins", "wrench", "none"}
        Touch: displacements of both sensors' pins in spacings (2, 2, N, 2), the wrenches on the object (2, 2, 6) in N and 10 N mm, or
        nothing. The second half is ``CHANGES`` times their change since the last decision.
    render_mode : {None, "rgb_array"}
        ``render`` then shows the scene.
    surrogate : str, optional
        File that ``twin surrogate`` wrote, for a sensor of which the package has none.

    Attributes
    ----------
    rest_px : list of (N, 2) float
        Places of each sensor's pins without contact, px of its frames.

    Raises
    ------
    OptionError
        An option is not valid.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / PERIOD_S)}  # type: ignore[misc]
    world: ClassVar[str]
    held: ClassVar[str]
    """The scene, and the geom that the sensors touch."""
    shape: ClassVar[tuple[int, int]]
    """Numbers of values of the state and of an action."""
    timestep_s: ClassVar[float] = 0.002

    def __init__(
        self, sensor: str = "mg400-331", observation: Touch = "pins", render_mode: str | None = None, surrogate: str | None = None
    ) -> None:
        if observation not in TOUCHES:
            raise OptionError(f"observation={observation!r}: expected one of {', '.join(TOUCHES)}")
        if render_mode not in (None, "rgb_array"):
            raise OptionError(f"render_mode={render_mode!r}: expected None or rgb_array")
        self.observation, self.render_mode = observation, render_mode
        tip = load_sensor(sensor)
        spec, sensors = load_scene(self.world, tip)
        self._model = spec.compile()
        self._model.opt.timestep = self.timestep_s
        self.scene = TactileScene(self._model, sensors, touchable=[self.held], surrogates={tip.name: surrogate} if surrogate else None)
        self._geom = self._model.geom(self.held).id
        self._object = int(self._model.geom_bodyid[self._geom])
        self._inertia = self._model.body_inertia[self._object] / self._model.body_mass[self._object]
        self.felt: list[TactileReading] = []
        self.rest_px = [self.scene.read(site).pins_px for site in sensors]
        self._renderer: mujoco.Renderer | None = None
        shapes = {"pins": (2, 2, *self.rest_px[0].shape), "wrench": (2, 2, 6)}
        box: dict[str, spaces.Space[Any]] = {"state": spaces.Box(-10.0, 10.0, self.shape[:1], np.float32)}
        if observation in shapes:
            box["tactile"] = spaces.Box(-10.0, 10.0, shapes[observation], np.float32)
        self.observation_space = cast(spaces.Space[dict[str, FloatArray]], spaces.Dict(box))
        self.action_space = spaces.Box(-1.0, 1.0, self.shape[1:], np.float32)

    def as_action(self, action: FloatArray) -> FloatArray:
        """An action as numbers in [-1, 1].

        Raises
        ------
        OptionError
            It has another shape, or is not finite, or no episode has begun.
        """
        if not self.felt:
            raise OptionError("step() before reset(); call reset() first")
        numbers = np.asarray(action, float)
        if numbers.shape != self.shape[1:] or not np.isfinite(numbers).all():
            raise OptionError(f"an action of {self.shape[1]} finite numbers is expected, got {numbers}")
        return np.clip(numbers, -1.0, 1.0)

    @staticmethod
    def require_choices(options: dict[str, Any] | None, least: float = -np.inf, **shapes: tuple[int, ...]) -> None:
        """Refuse what ``reset(options=...)`` has not, or what is not finite numbers of a shape, above a least one."""
        for name, value in (options or {}).items():
            if name not in shapes:
                raise OptionError(f"reset(options=...) has no {name!r}; it takes {', '.join(shapes)}")
            try:
                numbers = np.asarray(value, float)
            except (TypeError, ValueError):
                numbers = np.array(np.nan)
            if numbers.shape != shapes[name] or not (np.isfinite(numbers) & (numbers > least)).all():
                above = f" above {least:g}" if np.isfinite(least) else ""
                raise OptionError(f"reset(options=...): {name}={value!r}: expected {math.prod(shapes[name])} finite number(s){above}")

    def begin(self, fingers_mm: float) -> None:
        """Set the model to its start, with the fingers closed so far."""
        mujoco.mj_resetData(self._model, self.scene.data)
        self._touch: FloatArray | None = None
        for finger in ("left", "right"):
            self.scene.data.joint(finger).qpos[0] = fingers_mm / 1e3
        self.scene.data.ctrl[-1] = fingers_mm / 1e3

    def settle(self, seconds: float = PERIOD_S, targets: Sequence[float] | None = None) -> None:
        """Let time pass, in which the actuators' targets change evenly to new ones, and feel."""
        ctrl, steps = self.scene.data.ctrl, round(seconds / self._model.opt.timestep)
        for row in np.linspace(ctrl, ctrl if targets is None else targets, steps + 1)[1:]:
            ctrl[:] = row
            self.scene.step()
        self.felt = [self.scene.read(site) for site in self.scene.sensors]
        if self.observation == "pins":
            touch = in_spacings([of.pins_px for of in self.felt], self.rest_px)
        else:
            touch = np.stack([np.concatenate([of.force_n, of.torque_nmm / 10.0]) for of in self.felt])
        self._touch = with_change(touch, self._touch)

    def look(self, state: list[float]) -> dict[str, FloatArray]:
        """The observation: ``state`` and touch."""
        touch = {} if self.observation == "none" or self._touch is None else {"tactile": self._touch}
        return as_observation(state=state, **touch)

    def render(self) -> ImageArray | None:
        """The scene, (480, 640, 3) uint8, if the render mode is ``rgb_array``; else None."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self._model, 480, 640)
        self._renderer.update_scene(self.scene.data)
        return self._renderer.render()

    def close(self) -> None:
        """Close the renderer."""
        if self._renderer is not None:
            self._renderer.close()
