"""``tactip/GraspLift-v0``: lift an object of unknown mass and friction with a parallel gripper and two TacTips, hold it, and set it down.

The object breaks above a force that is ``CRUSH`` times the least grip that holds it. So no constant grip serves: the agent has to feel the
load and the beginning slip. An episode has three parts: lift the object by ``LIFT_MM``, hold it for ``HOLD_S``, and set it down.
"""

from typing import Any, ClassVar, Literal, cast, get_args

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

from scenes import load_sensor
from training.mujoco.geoms import MM
from training.mujoco.model import load_scene
from training.mujoco.scene import TactileScene
from twin.errors import OptionError
from twin.types import FloatArray, ImageArray

PERIOD_S, STEPS = 0.05, 160
"""Time between two decisions, and number of decisions of an episode."""
MASS_KG, FRICTION, MOST_GRIP_N = (0.05, 0.3), (0.3, 0.8), 2.3
"""Ranges of mass and friction. Objects that need more than ``MOST_GRIP_N`` at each finger are drawn again: the skin is too
soft for them."""
CRUSH = 1.8
LIFT_MM, NEAR_MM, HOLD_S = 50.0, 5.0, 2.0
GRIP_MM, LIFT_STEP_MM = 0.5, 4.0
"""Motion of the fingers and of the hand by an action of 1."""
OPEN_MM, MOST_CLOSED_MM = 18.0, 25.5
"""Travel of each finger at the start, just clear of the object, and its largest travel."""
FALLEN_MM = 12.0
"""Distance by which the object may sink in the grip. The skin alone gives way by up to 6 mm."""
Touch = Literal["pins", "wrench", "none"]
TOUCHES: tuple[str, ...] = get_args(Touch)


class GraspLift(gymnasium.Env[dict[str, FloatArray], FloatArray]):
    """Lift, hold and set down. Actions: closing motion of the fingers and motion of the hand, -1 to 1.

    Parameters
    ----------
    sensor : str
        Name or file.
    observation : {"pins", "wrench", "none"}
        Touch: displacements of both sensors' pins in spacings (2, N, 2), the wrenches on the object (2, 6) in N and 10 N mm, or nothing.
    render_mode : {None, "rgb_array"}
        ``render`` then shows the scene.

    Raises
    ------
    OptionError
        An option is not valid.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / PERIOD_S)}  # type: ignore[misc]

    def __init__(self, sensor: str = "mg400-331", observation: Touch = "pins", render_mode: str | None = None) -> None:
        if observation not in TOUCHES:
            raise OptionError(f"observation={observation!r}: expected one of {', '.join(TOUCHES)}")
        if render_mode not in (None, "rgb_array"):
            raise OptionError(f"render_mode={render_mode!r}: expected None or rgb_array")
        self.observation, self.render_mode = observation, render_mode
        spec, sensors = load_scene("gripper", load_sensor(sensor))
        self._model = spec.compile()
        self.scene = TactileScene(self._model, sensors, touchable=["block"])
        self._block, self._geom = self._model.body("block").id, self._model.geom("block").id
        self._rest_px = [self.scene.read(site).pins_px for site in sensors]
        self._spacing = float(np.median(np.linalg.norm(np.diff(self._rest_px[0], axis=0), axis=1)))
        self._inertia = self._model.body_inertia[self._block] / self._model.body_mass[self._block]
        self._renderer: mujoco.Renderer | None = None
        shapes = {"pins": (2, *self._rest_px[0].shape), "wrench": (2, 6)}
        box: dict[str, spaces.Space[Any]] = {"state": spaces.Box(-10.0, 10.0, (5,), np.float32)}
        if observation in shapes:
            box["tactile"] = spaces.Box(-10.0, 10.0, shapes[observation], np.float32)
        self.observation_space = cast(spaces.Space[dict[str, FloatArray]], spaces.Dict(box))
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Begin an episode; ``options`` can give ``mass_kg`` and ``friction``."""
        super().reset(seed=seed)
        given = options or {}
        while True:
            mass, friction = (float(self.np_random.uniform(*of)) for of in (MASS_KG, FRICTION))
            mass, friction = float(given.get("mass_kg", mass)), float(given.get("friction", friction))
            self.least_n = mass * 9.81 / (2 * friction)
            if self.least_n <= MOST_GRIP_N or given:
                break
        model, data = self._model, self.scene.data
        model.body_mass[self._block], model.body_inertia[self._block] = mass, mass * self._inertia
        model.geom_friction[self._geom, 0] = friction
        mujoco.mj_resetData(model, data)
        self._fingers, self.hand_mm, self.part, self._held, self._done = OPEN_MM, 0.0, 0, 0, 0
        data.ctrl[:] = 0.0, OPEN_MM / MM
        data.qpos[model.joint("left").qposadr[0]] = data.qpos[model.joint("right").qposadr[0]] = OPEN_MM / MM
        mujoco.mj_forward(model, data)
        self.scene.reset()
        self.scene.step(round(PERIOD_S / model.opt.timestep))
        self._from_mm = MM * float(data.xpos[self._block, 2])
        return self._look(), {"mass_kg": mass, "friction": friction}

    def step(self, action: FloatArray) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Move fingers and hand; see gymnasium. The reward of a step is at most 1, and 0 where the episode fails."""
        fingers, hand = np.clip(np.asarray(action, float), -1.0, 1.0)
        self._fingers = float(np.clip(self._fingers + GRIP_MM * fingers, 0.0, MOST_CLOSED_MM))
        self.hand_mm = float(np.clip(self.hand_mm + LIFT_STEP_MM * hand, -5.0, 120.0))
        data, model = self.scene.data, self._model
        data.ctrl[:] = self.hand_mm / MM, self._fingers / MM
        self.scene.step(round(PERIOD_S / model.opt.timestep))
        self._done += 1
        grip_n = self.grip_n()
        height = self.height_mm()
        off_mm = abs(height - self.goal_mm)
        if self.part < 2 and off_mm < NEAR_MM:
            self.part, self._held = 1, self._held + 1
            if self._held * PERIOD_S >= HOLD_S:
                self.part = 2
        crushed = grip_n > CRUSH * self.least_n
        dropped = self.part > 0 and (self.hand_mm - height > FALLEN_MM or (self.part == 1 and off_mm > 2 * NEAR_MM))
        solved = self.part == 2 and height < 1.0 and grip_n < 0.05
        failed = bool(crushed or dropped)
        reward = 0.0 if failed else (self.part + 1.0 / (1.0 + off_mm / 10.0)) / 3.0
        info = {"is_success": solved, "grip_n": grip_n, "height_mm": height, "crushed": bool(crushed), "dropped": bool(dropped)}
        return self._look(), reward + (STEPS - self._done) * float(solved), failed or solved, self._done >= STEPS, info

    @property
    def goal_mm(self) -> float:
        """Height, mm, that the present part of the episode asks for."""
        return 0.0 if self.part == 2 else LIFT_MM

    def height_mm(self) -> float:
        """Height of the object above its place at the start."""
        return MM * float(self.scene.data.xpos[self._block, 2]) - self._from_mm

    def grip_n(self) -> float:
        """The smaller of both fingers' forces along their axes, N."""
        return float(min(self.scene.read(site).force_n[2] for site in self.scene.sensors))

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

    def _look(self) -> dict[str, FloatArray]:
        of = [self.scene.read(site) for site in self.scene.sensors]
        state = [(self._fingers - OPEN_MM) / 5.0, self.hand_mm / LIFT_MM, self.goal_mm / LIFT_MM, float(self.part), self._held * PERIOD_S]
        seen: dict[str, FloatArray] = {"state": np.array(state)}
        if self.observation == "pins":
            seen["tactile"] = np.stack([each.pins_px - rest for each, rest in zip(of, self._rest_px, strict=True)]) / self._spacing
        elif self.observation == "wrench":
            seen["tactile"] = np.stack([np.concatenate([each.force_n, each.torque_nmm / 10.0]) for each in of])
        return {name: np.clip(values, -10.0, 10.0).astype(np.float32) for name, values in seen.items()}
