"""``tactip/GraspLift-v0``: lift an object of unknown mass and friction with a parallel gripper and two TacTips, hold it, and set it down.

The object breaks above a force that is ``CRUSH`` times the least grip that holds it. So no constant grip serves: the agent has to feel the
load and the beginning slip. An episode has three parts: lift the object by ``LIFT_MM``, hold it for ``HOLD_S``, and set it down.
"""

from typing import Any

import mujoco
import numpy as np

from training.mujoco.geoms import MM
from training.mujoco.task import PERIOD_S, GripperTask
from twin.types import FloatArray

STEPS = 160
"""Number of decisions of an episode."""
MASS_KG, FRICTION, MOST_GRIP_N = (0.05, 0.3), (0.3, 0.8), 2.3
"""Ranges of mass and friction. Objects that need more than ``MOST_GRIP_N`` at each finger are drawn again: the skin is too
soft for them."""
CRUSH = 1.8
LIFT_MM, NEAR_MM, HOLD_S = 50.0, 5.0, 2.0
GRIP_MM, LIFT_STEP_MM = 0.2, 4.0
"""Motion of the fingers and of the hand by an action of 1."""
OPEN_MM, MOST_CLOSED_MM = 18.0, 25.5
"""Travel of each finger at the start, just clear of the object, and its largest travel."""
FALLEN_MM = 12.0
"""Distance by which the object may sink in the grip. The skin alone gives way by up to 6 mm."""


class GraspLift(GripperTask):
    """Lift, hold and set down. Actions: closing motion of the fingers and motion of the hand, -1 to 1. See ``GripperTask``."""

    world, held, shape = "gripper", "block", (5, 2)

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
        model.body_mass[self._object], model.body_inertia[self._object] = mass, mass * self._inertia
        model.geom_friction[self._geom, 0] = friction
        self._fingers, self.hand_mm, self.part, self._held, self._done = OPEN_MM, 0.0, 0, 0, 0
        self.begin(OPEN_MM)
        mujoco.mj_forward(model, data)
        self.scene.reset()
        self.settle()
        self._from_mm = MM * float(data.xpos[self._object, 2])
        return self._look(), {"mass_kg": mass, "friction": friction}

    def step(self, action: FloatArray) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Move fingers and hand; see gymnasium. The reward of a step is at most 1, and 0 where the episode fails."""
        fingers, hand = np.clip(np.asarray(action, float), -1.0, 1.0)
        self._fingers = float(np.clip(self._fingers + GRIP_MM * fingers, 0.0, MOST_CLOSED_MM))
        self.hand_mm = float(np.clip(self.hand_mm + LIFT_STEP_MM * hand, -5.0, 120.0))
        self.scene.data.ctrl[:] = self.hand_mm / MM, self._fingers / MM
        self.settle()
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
        held = min(grip_n / self.least_n, 1.0) if self.part < 2 else 1.0
        terms = {"part": self.part / 3.0, "grip": held / 6.0, "height": 1.0 / (1.0 + off_mm / 10.0) / 6.0}
        reward = 0.0 if failed else sum(terms.values())
        info = {
            "is_success": solved,
            "grip_n": grip_n,
            "height_mm": height,
            "crushed": bool(crushed),
            "dropped": bool(dropped),
            "terms": terms,
        }
        return self._look(), reward + (STEPS - self._done) * float(solved), failed or solved, self._done >= STEPS, info

    @property
    def goal_mm(self) -> float:
        """Height, mm, that the present part of the episode asks for."""
        return 0.0 if self.part == 2 else LIFT_MM

    def height_mm(self) -> float:
        """Height of the object above its place at the start."""
        return MM * float(self.scene.data.xpos[self._object, 2]) - self._from_mm

    def grip_n(self) -> float:
        """The smaller of both fingers' forces along their axes, N."""
        return float(min(each.force_n[2] for each in self.readings()))

    def _look(self) -> dict[str, FloatArray]:
        state = [(self._fingers - OPEN_MM) / 5.0, self.hand_mm / LIFT_MM, self.goal_mm / LIFT_MM, float(self.part), self._held * PERIOD_S]
        return self.look(state)
