"""The environments in MuJoCo scenes, and what they have in common: two sensors on a gripper, kinds of observation, and pictures.

``tactip/GraspLift-v0``: hold an object of unknown mass and friction in a parallel gripper with two TacTips.

The hand moves by itself: it waits for ``GRIP_S`` with the fingers lightly closed, lifts the object, holds it, and sets it down. The agent
commands the grip. The object breaks above a force that is ``CRUSH`` times the least grip that holds it. So no constant grip serves: the
agent has to feel the load and the beginning slip.

``tactip/PegInsert-v0``: insert a peg, which a gripper holds between two TacTips, into a hole that is 0.5 mm wider all around.

The hole is up to ``OFF_MM`` beside the peg's tip, and the peg is tilted by up to ``TILTED_DEG`` in the grip. Neither is observed: the agent
has to feel where the peg drops, and how it wedges.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, cast, get_args

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from scenes import load_sensor
from training.environments.grasp import PERIOD_S, STEPS, TOUCHING_MM, GraspHand, as_observation, in_spacings, with_change
from training.mujoco.model import MM, load_scene
from training.mujoco.scene import TactileReading, TactileScene
from twin.errors import OptionError
from twin.types import FloatArray, ImageArray

Touch = Literal["pins", "wrench", "none"]
TOUCHES: tuple[str, ...] = get_args(Touch)
MASS_KG, FRICTION = (0.05, 0.3), (0.3, 0.8)
"""Ranges of mass and friction."""
LEAST_N = 0.32, 2.0
"""Range of the least grip. The skin is too soft for more."""
CRUSH, WANTED = 2.0, 1.4
"""Multiples of the least grip: at which the object breaks, and which earns most."""
FALLEN_MM = 12.0
"""Distance by which the object may sink in the grip. The skin alone gives way by up to 6 mm."""
STANDS_MM = 1.0
"""Height below which the object counts as set down."""
BONUS = 20.0
"""Reward for an object that was set down."""
PEG_STEPS = 400
OFF_MM, TILTED_DEG = 5.0, 5.0
GRIP_MM = 24.0
"""Travel of each finger. The grip is some 2.5 N."""
STEP_MM, STEP_DEG = (1.0, 1.0, 1.0), 0.5
"""Motion of the hand by an action of 1."""
ABOVE_MM, TOP_MM, TIP_MM, DEEP_MM = 3.0, 40.0, 56.0, 25.0
"""Height of the tip above the hole's rim at the start, height of the rim, distance of the tip from the handle's middle, and the depth that
counts as inserted."""
SLIPPED_MM, SLIPPED_DEG = 15.0, 20.0
"""Motions of the peg in the grip from which on it counts as lost."""
NEAR_MM, NEAR_DEG = 2.0, 2.0
"""Errors at which their terms of the reward are half."""


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
            self.scene.data.joint(finger).qpos[0] = fingers_mm / MM
        self.scene.data.ctrl[-1] = fingers_mm / MM

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


class GraspLift(GripperTask):
    """Hold while the hand lifts and lowers. Action: closing motion of the fingers, -1 to 1. See ``GripperTask``."""

    world, held, shape = "gripper", "block", (3, 1)
    timestep_s = 0.005

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Begin an episode; ``options`` can give ``mass_kg`` and ``friction``.

        All ratios of least grips are equally probable; mass and friction are drawn from those that need the drawn grip.
        """
        self.require_choices(options, 0.0, mass_kg=(), friction=())
        super().reset(seed=seed)
        least_n = float(np.exp(self.np_random.uniform(*np.log(LEAST_N))))
        friction = self.np_random.uniform(*np.clip(np.array(MASS_KG) * 9.81 / (2 * least_n), *FRICTION))
        drawn = {"mass_kg": 2 * friction * least_n / 9.81, "friction": friction} | (options or {})
        mass, friction = float(drawn["mass_kg"]), float(drawn["friction"])
        self.least_n = mass * 9.81 / (2 * friction)
        model, data = self._model, self.scene.data
        model.body_mass[self._object], model.body_inertia[self._object] = mass, mass * self._inertia
        model.geom_friction[self._geom, 0] = friction
        self._hand = GraspHand()
        self.begin(TOUCHING_MM)
        mujoco.mj_forward(model, data)
        self.scene.reset()
        self.settle()
        self._from_mm = MM * float(data.xpos[self._object, 2])
        return self._look(), {"mass_kg": mass, "friction": friction}

    def step(self, action: FloatArray) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Move fingers and hand; see gymnasium. The reward of a step is at most 1, and 0 where the episode fails."""
        closing = self.as_action(action)[0]
        self._hand.move(closing)
        self.settle(targets=(self._hand.hand_mm / MM, self._hand.fingers_mm / MM))
        seen, grip_n, height = self._look(), self.grip_n(), self.height_mm()
        crushed, dropped = grip_n > CRUSH * self.least_n, self._hand.hand_mm - height > FALLEN_MM
        over, failed = self._hand.done == STEPS, crushed or dropped
        solved = over and not failed and height < STANDS_MM
        ratio = max(grip_n, 1e-3) / (WANTED * self.least_n)
        terms = {"grip": 0.0 if failed else min(ratio, 1 / ratio), "set_down": BONUS * solved}
        info = {"is_success": solved, "grip_n": grip_n, "height_mm": height, "crushed": crushed, "dropped": dropped, "terms": terms}
        return seen, sum(terms.values()), failed or over, False, info

    def height_mm(self) -> float:
        """Height of the object above its place at the start."""
        return MM * float(self.scene.data.xpos[self._object, 2]) - self._from_mm

    def grip_n(self) -> float:
        """The smaller of both fingers' forces along their axes, N."""
        return float(min(each.force_n[2] for each in self.felt))

    def _look(self) -> dict[str, FloatArray]:
        return self.look(self._hand.state())


class PegInsert(GripperTask):
    """Insert a peg. Actions: motion of the hand along x, y, z, and its tilt about x, -1 to 1. See ``GripperTask``."""

    world, held, shape = "peg", "handle", (5, 4)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Begin an episode; ``options`` can give ``off_mm`` (x, y) and ``tilt_deg``."""
        self.require_choices(options, off_mm=(2,), tilt_deg=())
        super().reset(seed=seed)
        angle, off = self.np_random.uniform(0.0, 2 * np.pi), OFF_MM * np.sqrt(self.np_random.uniform())
        given = {"off_mm": off * np.array([np.cos(angle), np.sin(angle)]), "tilt_deg": self.np_random.uniform(-TILTED_DEG, TILTED_DEG)}
        given |= options or {}
        model, data = self._model, self.scene.data
        tilt = np.radians(float(given["tilt_deg"]))
        self._hole_mm = np.asarray(given["off_mm"], float) + [0.0, TIP_MM * np.sin(tilt)]
        model.body("hole").pos[:2] = self._hole_mm / MM
        self.begin(GRIP_MM)
        self.hand, self._done = np.array([0.0, 0.0, ABOVE_MM + TOP_MM + TIP_MM - 100.0, 0.0]), 0
        data.joint("z").qpos[0] = self.hand[2] / MM
        data.joint("peg").qpos[2:5] = 0.1 + self.hand[2] / MM, np.cos(tilt / 2), np.sin(tilt / 2)
        self._drive()
        mujoco.mj_forward(model, data)
        self.scene.reset()
        self.settle(0.1)
        return self._look(), given

    def step(self, action: FloatArray) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Move the hand; see gymnasium. The reward of a step is at most 1, and 0 where the episode fails."""
        moved_to = self.as_action(action) * [*STEP_MM, STEP_DEG] + self.hand
        self.hand = np.clip(moved_to, [-15.0, -15.0, -50.0, -12.0], [15.0, 15.0, 20.0, 12.0])
        self._drive()
        self.settle()
        self._done += 1
        T = self.scene.data.xmat[self._object].reshape(3, 3)
        at = MM * self.scene.data.xpos[self._object]
        tip = at - TIP_MM * T[:, 2]
        off, depth = float(np.linalg.norm(tip[:2] - self._hole_mm)), TOP_MM - float(tip[2])
        tilt = float(np.degrees(np.arccos(min(T[2, 2], 1.0))))
        moved = float(np.linalg.norm(at - self.hand[:3] - [0.0, 0.0, 100.0]))
        failed, solved = moved > SLIPPED_MM or tilt > SLIPPED_DEG, depth >= DEEP_MM
        sunk = float(np.clip(depth / DEEP_MM, 0, 1))
        terms = {"off": 0.2 / (1 + off / NEAR_MM), "tilt": 0.1 / (1 + tilt / NEAR_DEG), "depth": 0.7 * sunk}
        reward = 0.0 if failed else sum(terms.values()) + (PEG_STEPS - self._done) * float(solved)
        info = {"is_success": solved, "off_mm": off, "depth_mm": depth, "tilt_deg": tilt, "slipped": failed, "terms": terms}
        return self._look(), reward, failed or solved, self._done >= PEG_STEPS, info

    def _drive(self) -> None:
        self.scene.data.ctrl[:4] = *self.hand[:3] / MM, np.radians(self.hand[3])

    def _look(self) -> dict[str, FloatArray]:
        return self.look([*(self.hand[:3] / 10.0), self.hand[3] / 5.0, self._done / PEG_STEPS])
