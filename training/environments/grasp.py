"""What a policy of ``tactip/GraspLift-v0`` observes and commands: the same in MuJoCo and on two sensors of a real gripper."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.files import LONGEST_PATH, quote
from scenes.plugins import others
from twin.errors import extras_named
from twin.policy import PolicyError
from twin.types import FloatArray

PERIOD_S = 0.05
"""Time between two decisions."""
CHANGES = 10.0
"""Factor by which changes of touch are observed."""
GRIP_S, LIFT_S, HOLD_S, LOWER_S = 0.5, 2.5, 2.0, 1.0
STEPS = round((GRIP_S + LIFT_S + HOLD_S + LOWER_S) / PERIOD_S)
"""Number of decisions of an episode."""
LIFT_MM = 50.0
GRIP_MM = 0.3
"""Motion of each finger by an action of 1."""
TOUCHING_MM, MOST_CLOSED_MM = 19.0, 26.0
"""Travel of each finger at the start, and its largest travel."""
TOUCH_DEPTH_MM = 1.0
"""Depth to which each sensor is indented at the start."""
CLEAR_MM, SETTLE_STEPS = 2.0, 10
"""Gap at each sensor with open fingers, and the number of decisions for which a real gripper opens, and then closes."""
Act = Callable[[Mapping[str, FloatArray]], FloatArray]
"""Makes an action (1,) of an observation: a policy."""


def in_spacings(pins_px: Sequence[FloatArray], rest_px: Sequence[FloatArray]) -> FloatArray:
    """Displacements (S, N, 2) of several sensors' pins from rest, in spacings of the pins."""
    spacing_px = float(np.median(np.linalg.norm(np.diff(rest_px[0], axis=0), axis=1)))
    return np.stack([pins - rest for pins, rest in zip(pins_px, rest_px, strict=True)]) / spacing_px


def with_change(touch: FloatArray, before: FloatArray | None) -> FloatArray:
    """Touch (2, ...), and ``CHANGES`` times its change since the last decision, whose result was ``before`` (None at the first one)."""
    return np.stack([touch, CHANGES * (touch - (touch if before is None else before[0]))])


def as_observation(**values: FloatArray | list[float]) -> dict[str, FloatArray]:
    """The observation, within its bounds."""
    return {name: np.clip(each, -10.0, 10.0).astype(np.float32) for name, each in values.items()}


@dataclass
class GraspHand:
    """The hand, which moves by its script, and the fingers, which the agent commands.

    Attributes
    ----------
    fingers_mm, hand_mm : float
        Travel of each finger, and height of the hand.
    done : int
        Number of decisions.
    """

    fingers_mm: float = TOUCHING_MM
    hand_mm: float = 0.0
    done: int = 0

    def move(self, closing: float) -> None:
        """Follow a decision: the closing motion of the fingers, -1 to 1."""
        self.done += 1
        self.fingers_mm = float(np.clip(self.fingers_mm + GRIP_MM * closing, 0.0, MOST_CLOSED_MM))
        lifted = GRIP_S, GRIP_S + LIFT_S, GRIP_S + LIFT_S + HOLD_S, STEPS * PERIOD_S
        share = float(np.interp(self.done * PERIOD_S, lifted, [0.0, 1.0, 1.0, 0.0]))
        self.hand_mm = LIFT_MM * (1 - float(np.cos(np.pi * share))) / 2

    def state(self) -> list[float]:
        """Fingers, hand and time, as they are observed."""
        return [(self.fingers_mm - TOUCHING_MM) / 5.0, self.hand_mm / LIFT_MM, self.done / STEPS]


class GraspPolicy:
    """Decides in a loop with two sensors and a gripper on an arm.

    A policy of GraspLift commands the fingers, and the arm lifts by the script. First the fingers open, and the pins at rest are taken.
    Then they close on the object.

    Parameters
    ----------
    act : callable
    object_mm : float
        Width of the object between the fingers.
    """

    steps = 2 * SETTLE_STEPS + STEPS
    """Number of decisions."""

    def __init__(self, act: Act, object_mm: float) -> None:
        self._act, self._object_mm, self._hand = act, object_mm, GraspHand()
        self._rest_px: list[FloatArray] = []
        self._touch: FloatArray | None = None

    def __call__(self, step: Any) -> tuple[FloatArray, float]:
        """The tool's motion (6,), mm and deg, and the gripper's next width, mm, for a step (``hardware.servo.grip.GripStep``)."""
        motion, touching_mm = np.zeros(6), self._object_mm - 2 * TOUCH_DEPTH_MM
        if step.index < SETTLE_STEPS:
            return motion, self._object_mm + 2 * CLEAR_MM
        pins_px = [seen.graph.nodes_px for seen in step.pins.values()]
        if step.index == SETTLE_STEPS:
            self._rest_px = pins_px
        if step.index < 2 * SETTLE_STEPS:
            return motion, touching_mm
        self._touch, before_mm = with_change(in_spacings(pins_px, self._rest_px), self._touch), self._hand.hand_mm
        action = self._act(as_observation(state=self._hand.state(), tactile=self._touch))
        self._hand.move(float(np.clip(action, -1.0, 1.0).item()))
        motion[2] = self._hand.hand_mm - before_mm
        return motion, touching_mm - 2 * (self._hand.fingers_mm - TOUCHING_MM)


def load_grasp_policy(policy: str) -> Act:
    """A policy that another package offers by this name, or that of a ZIP file of stable-baselines3 (PPO), by its mean action.

    Such a file can contain code, which is run.

    Raises
    ------
    PolicyError
        There is none, or its observation is another one.
    """
    if policy in (there := others("policies")):
        act: Act = there[policy]
        return act
    if not Path(policy).is_file():
        names = f", or one of {', '.join(there)}" if there else ""
        raise PolicyError(f"{quote(policy, LONGEST_PATH)}: no such file; give a ZIP file of stable-baselines3{names}")
    with extras_named():
        from stable_baselines3 import PPO
    try:
        learner = PPO.load(policy, device="cpu")
    except Exception as error:  # pickled objects raise exceptions of any type
        raise PolicyError(f"{policy}: holds no PPO policy of stable-baselines3 ({type(error).__name__}: {error})") from error
    shapes = {name: space.shape for name, space in getattr(learner.observation_space, "spaces", {}).items()}
    if set(shapes) != {"state", "tactile"} or len(shapes["tactile"] or ()) != 4:
        raise PolicyError(f"{policy}: observes {shapes}; give a policy of tactip/GraspLift-v0 with the observation 'pins'")
    return lambda seen: learner.predict(dict(seen), deterministic=True)[0]
