"""``tactip/GraspLift-v0``: hold an object of unknown mass and friction in a parallel gripper with two TacTips.

The hand moves by itself: it waits for ``GRIP_S`` with the fingers lightly closed, lifts the object, holds it, and sets it down. The agent
commands the grip. The object breaks above a force that is ``CRUSH`` times the least grip that holds it. So no constant grip serves: the
agent has to feel the load and the beginning slip.
"""

from typing import Any

import mujoco
import numpy as np

from training.environments.grasp import STEPS, TOUCHING_MM, GraspHand
from training.mujoco.geoms import MM
from training.mujoco.task import GripperTask
from twin.types import FloatArray

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
TIMESTEP_S = 0.005


class GraspLift(GripperTask):
    """Hold while the hand lifts and lowers. Action: closing motion of the fingers, -1 to 1. See ``GripperTask``."""

    world, held, shape = "gripper", "block", (3, 1)
    timestep_s = TIMESTEP_S

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
