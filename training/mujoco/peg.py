"""``tactip/PegInsert-v0``: insert a peg, which a gripper holds between two TacTips, into a hole that is 0.5 mm wider all around.

The hole is up to ``OFF_MM`` beside the peg's tip, and the peg is tilted by up to ``TILTED_DEG`` in the grip. Neither is observed: the agent
has to feel where the peg drops, and how it wedges.
"""

from typing import Any

import mujoco
import numpy as np

from training.mujoco.geoms import MM
from training.mujoco.task import GripperTask
from twin.types import FloatArray

STEPS = 400
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
        terms = {
            "off": 0.2 / (1 + off / NEAR_MM),
            "tilt": 0.1 / (1 + tilt / NEAR_DEG),
            "depth": 0.7 * float(np.clip(depth / DEEP_MM, 0, 1)),
        }
        reward = 0.0 if failed else sum(terms.values()) + (STEPS - self._done) * float(solved)
        info = {"is_success": solved, "off_mm": off, "depth_mm": depth, "tilt_deg": tilt, "slipped": failed, "terms": terms}
        return self._look(), reward, failed or solved, self._done >= STEPS, info

    def _drive(self) -> None:
        self.scene.data.ctrl[:4] = *self.hand[:3] / MM, np.radians(self.hand[3])

    def _look(self) -> dict[str, FloatArray]:
        return self.look([*(self.hand[:3] / 10.0), self.hand[3] / 5.0, self._done / STEPS])
