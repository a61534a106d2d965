"""The film of the gripper: it grips a block, lifts, holds and sets it down, beside the frames of both sensors.

Run by ``make gallery``, or: cd docs && PYTHONPATH=.. python -m generators.gripper. It needs OpenGL (``MUJOCO_GL=egl`` without a screen).
"""

from pathlib import Path

import cv2
import gymnasium
import numpy as np
from PIL import Image

import training.environments  # noqa: F401
from generators.notebooks import DOCS
from training.mujoco.task import PERIOD_S, WANTED

FILM = DOCS / "pictures" / "gripper.webp"
OBJECT = {"mass_kg": 0.18, "friction": 0.6}
EVERY, OPENING, OPEN_M, QUALITY = 5, 12, 0.012, 30
"""Decisions from picture to picture, decisions in which the hand opens at the end, how far, and the quality of the pictures."""
SIDE_PX = 120


def film() -> Path:
    """Play an episode with the right grip, and write its pictures."""
    env = gymnasium.make("tactip/GraspLift-v0", observation="none", render_mode="rgb_array").unwrapped
    env.reset(seed=0, options=OBJECT)
    pictures, over, more = [], False, OPENING
    while not over or more:
        if over:
            env.settle(targets=(0.0, OPEN_M))
            more -= 1
        else:
            *_, over, _, info = env.step(np.clip([(WANTED * env.least_n - env.grip_n()) / 0.15], -1, 1))
        pictures.append(picture(env))
    assert info["is_success"]
    first, *others = [Image.fromarray(one) for one in pictures[::EVERY]]
    first.save(FILM, save_all=True, append_images=others, duration=round(1e3 * EVERY * PERIOD_S), loop=0, quality=QUALITY, method=6)
    return FILM


def picture(env: gymnasium.Env) -> np.ndarray:
    """The scene, and beside it the frames of the left (above) and the right sensor."""
    scene = cv2.resize(env.render(), (8 * SIDE_PX // 3, 2 * SIDE_PX), interpolation=cv2.INTER_AREA)
    frames = [cv2.resize(env.scene.frame(site).image, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_AREA) for site in env.scene.sensors]
    frames = [cv2.cvtColor(one, cv2.COLOR_GRAY2RGB) if one.ndim == 2 else one for one in frames]
    return np.hstack([scene, np.vstack(frames)])


if __name__ == "__main__":
    print(film())
