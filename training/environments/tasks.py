"""The tasks: start of an episode, goal, and reward of a state. All are computed for B environments at once."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from scenes.object import ObjectSpec, SphereShape
from scenes.plugins import others
from training.environments.world import Surfaces, Tool, motions, standing_on, turn_about
from training.surrogate.reading import ContactReading
from twin.errors import OptionError
from twin.rig.touch import TrueTouch
from twin.types import BoolArray, FloatArray

LOST_MM = -1.0
"""Indentation, mm, at which a sensor counts as having lost its object: it is 1 mm away from it."""
DEEPEST_MM = 5.5
"""Indentation, mm, at which an episode ends as failed. The published recordings go to 5 mm."""
STEEPEST_DEG = 40.0
"""Angle from the surface's normal, deg, at which an episode ends as failed."""
FORCE_N = 1.0
"""Force, N, that is written as 1 in observations."""
TURN_DEG = 10.0
"""Angle, deg, that is written as 1 in observations and rewards."""


@dataclass(frozen=True)
class Start:
    """The start of an episode.

    Attributes
    ----------
    T_work : (4, 4) float
        Work frame of the tool in the world; the object's frame is the world's at the start, unless ``T_object`` is given.
    goal : tuple of float
        The goal, by the task's ``goal_names``.
    T_object : (4, 4) float
    """

    T_work: FloatArray
    goal: tuple[float, ...]
    T_object: FloatArray


@dataclass(frozen=True)
class WorldState:
    """The world after a step, for a task to evaluate. Rows are environments.

    Attributes
    ----------
    touch : Touch
        Contact of the tools if the sensors were rigid.
    reading : ContactReading
    T_work, T_object : (B, 4, 4) float
    goal : (B, G) float
    action : (B, A) float
        Actions in [-1, 1].
    """

    touch: TrueTouch
    reading: ContactReading
    T_work: FloatArray
    T_object: FloatArray
    goal: FloatArray
    action: FloatArray


@dataclass(frozen=True)
class StepOutcome:
    """A task's judgement of a state.

    Attributes
    ----------
    reward : (B,) float
        Reward of the states that do not fail: at least the task's ``failed_reward``.
    failed : (B,) bool
        Whether the episode ends as failed: the object is lost, the sensor is too deep or too oblique, or, of some tasks, the goal is
        out of reach.
    reached : (B,) bool
        Whether the episode ends as successful.
    good : (B,) bool
        Whether the state itself is good. In a successful episode most states of the second half are good.
    terms : dict of str to (B,) float
        What the reward is made of, for ``info``.
    """

    reward: FloatArray
    failed: BoolArray
    reached: BoolArray
    good: BoolArray
    terms: dict[str, FloatArray] = field(default_factory=dict)


class Task(ABC):
    """One task. Its memory of an episode is ``kept`` (B, columns), which ``begin`` sets to zero.

    Attributes
    ----------
    name : str
    experiment : str
        Experiment that defines the approach, and with it the work frame.
    objects : tuple of str
        Objects of which one is sampled for each episode.
    axes : tuple of str
        Axes that an agent moves by default.
    goal_names, oracle_names : tuple of str
        Names of the values in the observations ``goal`` and ``oracle``.
    steps : int
        Number of steps of an episode.
    feed_mm : (3,) float
        Motion in the work frame that every step adds to the agent's.
    largest_mm, largest_deg : float
        Motion of a step, along and about each axis, by an action of 1.
    success_share : float
        Least share of good states in the second half of a successful episode. With 0 only ``reached`` counts.
    failed_reward : float
        Reward of a step that fails. No other step has less, so an agent never gains by failing.
    """

    name: str
    experiment: str
    objects: tuple[str, ...]
    axes: tuple[str, ...]
    goal_names: tuple[str, ...]
    oracle_names: tuple[str, ...] = ("indent_mm", "angle / 10 deg", "force_n x", "force_n y", "force_n z", "area / 100 mm2", "slip share")
    steps: int = 60
    feed_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    largest_mm: float = 1.0
    largest_deg: float = 5.0
    success_share: float = 0.9
    failed_reward: float = 0.0
    columns = 1

    def require(self, obj: ObjectSpec) -> None:
        """Raise ``OptionError`` if the task can't be done with an object. Most tasks can be done with any object."""
        return

    def prepare(self, count: int) -> None:
        """Allocate the memory of ``count`` environments."""
        self.kept = np.zeros((count, self.columns))

    @abstractmethod
    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        """Draw the start of an episode."""

    @abstractmethod
    def evaluate(self, seen: WorldState) -> StepOutcome:
        """Evaluate the state after a step."""

    def expert(self, seen: WorldState) -> FloatArray:
        """Motions (B, A) along the task's ``axes``, mm and deg, of a scripted expert that knows the true state.

        Raises
        ------
        OptionError
            The task has no expert.
        """
        raise OptionError(f"{self.name} has no scripted expert; give its class a method of this name: expert")

    def push_object(self, reading: ContactReading, T_work: FloatArray, T_object: FloatArray, tool: Tool) -> FloatArray | None:
        """The object's poses (B, 4, 4) after it gave way to the skin's forces, or None if no object moves."""
        return None

    def carry_object(self, reading: ContactReading, T_work: FloatArray, before: FloatArray, T_object: FloatArray) -> FloatArray:
        """The object's poses (B, 4, 4) after tools with this ``reading`` moved from ``before`` to ``T_work``. Held objects do not move."""
        return T_object

    def goals_for_agents(self, goal: FloatArray, T_work: FloatArray) -> FloatArray:
        """The goals (B, G), by ``goal_names``, as the agents get them with the tools at ``T_work`` (B, 4, 4)."""
        return goal

    def oracle(self, seen: WorldState) -> FloatArray:
        """Values that a real sensor can't know, (B, K), by ``oracle_names``."""
        felt, touch = seen.reading, seen.touch
        columns = [touch.indent_mm, touch.angle_deg / TURN_DEG, felt.force_n / FORCE_N, felt.area_mm2 / 100.0, felt.slip]
        return np.column_stack(columns)


def closeness(off: FloatArray) -> FloatArray:
    """Reward of states that are ``off`` (B,) a goal: 1 at the goal, 1/2 at 1, and more than 0 and falling at any distance."""
    return 1.0 / (1.0 + off)


def lost_or_deep(touch: TrueTouch) -> BoolArray:
    """Rows (B,) where the object is lost, or the sensor too deep."""
    return (touch.indent_mm < LOST_MM) | (touch.indent_mm > DEEPEST_MM)


def out_of_touch(touch: TrueTouch) -> BoolArray:
    """Rows (B,) where the object is lost, or the sensor too deep or too steep."""
    return lost_or_deep(touch) | (np.abs(touch.angle_deg) > STEEPEST_DEG)


class SurfaceFollow(Task):
    """Follow a surface: hold depth and angle while the sensor moves along it."""

    name, experiment = "SurfaceFollow", "surface-2d"
    objects: tuple[str, ...] = ("plane", "can", "ball-80", "ball-40")
    axes = ("z", "Ry")
    goal_names = ("indent_mm", "angle / 10 deg")
    feed_mm = (1.0, 0.0, 0.0)
    indents_mm = (2.0, 3.5)
    off_mm, off_deg, beside_mm = 1.0, 12.0, 5.0
    good_mm, good_deg = 0.5, 5.0

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        self.kept[row] = 0.0
        goal = float(rng.uniform(*self.indents_mm))
        indent = max(goal + rng.uniform(-self.off_mm, self.off_mm), 0.8)
        beside = rng.uniform(-self.beside_mm, self.beside_mm)
        T = standing_on(tool, surfaces[obj], beside, indent, rng.uniform(-self.off_deg, self.off_deg))
        return Start(T, (goal, 0.0), np.eye(4))

    def evaluate(self, seen: WorldState) -> StepOutcome:
        off_mm = np.abs(seen.touch.indent_mm - seen.goal[:, 0])
        off_deg = np.abs(seen.touch.angle_deg - TURN_DEG * seen.goal[:, 1])
        failed = out_of_touch(seen.touch)
        good = (off_mm <= self.good_mm) & (off_deg <= self.good_deg)
        reward = closeness(off_mm + off_deg / TURN_DEG)
        return StepOutcome(reward, failed, np.zeros(len(failed), bool), good, {"off_mm": off_mm, "off_deg": off_deg})

    def expert(self, seen: WorldState) -> FloatArray:
        off_mm, off_deg = seen.goal[:, 0] - seen.touch.indent_mm, seen.touch.angle_deg - TURN_DEG * seen.goal[:, 1]
        return np.column_stack([off_mm, off_deg])


class ContourFollow(SurfaceFollow):
    """Go once around an object of the paper, and hold depth and angle."""

    name = "ContourFollow"
    objects = ("can", "mesh-can", "square", "prism", "tin-box")
    steps = 900
    feed_mm = (0.5, 0.0, 0.0)
    """Half of the value for a plain surface, mm. Around a corner of 2 mm even a sensor that knows its angle lags by 31 deg with 1 mm, and
    by 16 deg with this value."""
    indents_mm = (3.0, 3.0)
    beside_mm = 45.0
    """Largest distance, mm, of an episode's start from the object's origin along x. A start beside the object is moved onto its surface,
    so that episodes begin on faces and corners alike."""
    covered_share = 0.98
    success_share = 0.0
    columns = 5  # path length covered, total length, the place (x, z) that was touched last, and the largest length covered

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        start, surface = super().begin(row, tool, obj, surfaces, rng), surfaces[obj]
        touch = surface.depth_and_angle(tool.mounting, tool.object_poses(start.T_work[None], start.T_object[None]))
        self.kept[row, 1] = np.linalg.norm(np.diff(surface.outline, axis=0), axis=1).sum()
        self.kept[row, 2:4] = touch.place_mm[0, [0, 2]]
        return start

    def evaluate(self, seen: WorldState) -> StepOutcome:
        judged = super().evaluate(seen)
        covered, length, x, z, farthest = self.kept.T
        place = seen.touch.place_mm[:, [0, 2]]
        moved = place - np.column_stack([x, z])
        ahead = np.sign((moved * seen.T_work[:, [0, 2], 0]).sum(axis=1))  # a way back and forth covers nothing
        covered = covered + np.where(judged.failed, 0.0, ahead * np.minimum(np.linalg.norm(moved, axis=1), 2 * self.feed_mm[0] + 2.0))
        gain_mm = np.maximum(covered - farthest, 0.0)
        self.kept = np.column_stack([covered, length, place, farthest + gain_mm])
        reached = (covered >= self.covered_share * length) & ~judged.failed
        reward = judged.reward * gain_mm / self.feed_mm[0]
        return StepOutcome(reward, judged.failed, reached, judged.good, judged.terms | {"gain_mm": gain_mm})


class EdgeFollow(Task):
    """Follow an edge under the sensor: hold the place across it and its direction while the sensor moves along it."""

    name, experiment = "EdgeFollow", "edge-2d"
    objects = ("edge",)
    axes = ("x", "Rz")
    goal_names = ("across_mm", "direction / 10 deg")
    oracle_names = ("across_mm", "direction / 10 deg", *Task.oracle_names[2:])
    feed_mm = (0.0, 1.0, 0.0)
    indent_mm = 3.0
    off_mm, off_deg = 3.0, 25.0
    good_mm, good_deg = 1.0, 6.0
    farthest_mm = 6.0

    def require(self, obj: ObjectSpec) -> None:
        if obj.shape.kind != "edge":
            raise OptionError(f"EdgeFollow follows edges; {obj.name} is none, give objects such as 'edge'")

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        dome = tool.T_work_sensor[:3, 3]
        T = turn_about((0, 0, 1), rng.uniform(-self.off_deg, self.off_deg))
        centre = np.array([rng.uniform(-self.off_mm, self.off_mm), 0.0, self.indent_mm - tool.mounting.skin_apex_mm])
        T[:3, 3] = centre - T[:3, :3] @ dome
        return Start(T, (0.0, 0.0), np.eye(4))

    def place(self, seen: WorldState) -> tuple[FloatArray, FloatArray]:
        """Place of the dome's apex across the edge (B,), mm, and angle between the sensor and the edge (B,), deg."""
        turn = np.degrees(np.arctan2(seen.T_work[:, 1, 0], seen.T_work[:, 0, 0]))
        return seen.T_work[:, 0, 3], turn

    def evaluate(self, seen: WorldState) -> StepOutcome:
        across, turn = self.place(seen)
        off_mm, off_deg = np.abs(across - seen.goal[:, 0]), np.abs(turn - TURN_DEG * seen.goal[:, 1])
        failed = (off_mm > self.farthest_mm) | (np.abs(turn) > STEEPEST_DEG + self.off_deg) | lost_or_deep(seen.touch)
        good = (off_mm <= self.good_mm) & (off_deg <= self.good_deg) & (seen.touch.indent_mm > 0)
        reward = closeness((off_mm + off_deg / TURN_DEG) / 2)
        return StepOutcome(reward, failed, np.zeros(len(failed), bool), good, {"off_mm": off_mm, "off_deg": off_deg})

    def oracle(self, seen: WorldState) -> FloatArray:
        across, turn = self.place(seen)
        return np.column_stack([across, turn / TURN_DEG, super().oracle(seen)[:, 2:]])

    def expert(self, seen: WorldState) -> FloatArray:
        across, turn = self.place(seen)
        return np.column_stack([seen.goal[:, 0] - across, TURN_DEG * seen.goal[:, 1] - turn])


class GentlePress(Task):
    """Approach an object, reach a force and hold it without slip."""

    name, experiment = "GentlePress", "surface-2d"
    objects = ("plane", "can", "ball-40", "sphere", "cylinder")
    axes = ("x", "z")
    goal_names = ("force / 0.1 N",)
    steps = 40
    largest_mm = 0.3
    """Motion of a step by an action of 1, mm: twice that of the fastest object, and about 0.3 N."""
    forces_n = (0.5, 1.5)
    """Range of the goals, N. All objects press with them before the sensor is too deep; the smallest ball's 1.5 N needs 5.2 mm."""
    off_deg = 10.0
    drift_mm = 0.15
    good_n, slip_share = 0.1, 0.5
    """Largest error of the force, N, about that of the twin's forces against a load cell; and largest share of the contact that slides."""
    soft_mm_per_n = 1.2
    """Motion of the expert, mm, per N that the force lacks."""
    columns = 1  # sideways drift per step
    success_share = 0.8

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        self.kept[row] = rng.uniform(-self.drift_mm, self.drift_mm)
        T = standing_on(tool, surfaces[obj], 0.0, -0.5, rng.uniform(-self.off_deg, self.off_deg))
        return Start(T, (float(rng.uniform(*self.forces_n)),), np.eye(4))

    def goals_for_agents(self, goal: FloatArray, T_work: FloatArray) -> FloatArray:
        """The forces in units of their largest error, so that a network sees as much of the goal as it must know."""
        return goal / self.good_n

    def carry_object(self, reading: ContactReading, T_work: FloatArray, before: FloatArray, T_object: FloatArray) -> FloatArray:
        drifted = T_object.copy()
        drifted[:, 0, 3] += self.kept[:, 0]
        return drifted

    def evaluate(self, seen: WorldState) -> StepOutcome:
        force, goal = np.linalg.norm(seen.reading.force_n, axis=1), seen.goal[:, 0]
        off_n, gap_mm = np.abs(force - goal), np.maximum(-seen.touch.indent_mm, 0.0)
        slips = (seen.reading.slip > self.slip_share) & (force > 0.2)
        failed = (seen.touch.indent_mm > DEEPEST_MM) | (seen.touch.indent_mm < 2 * LOST_MM)
        good = (off_n <= self.good_n) & ~slips
        reward = closeness(off_n / (2 * self.good_n) + gap_mm + seen.reading.slip / self.slip_share)
        return StepOutcome(reward, failed, np.zeros(len(failed), bool), good, {"off_n": off_n, "gap_mm": gap_mm})

    def expert(self, seen: WorldState) -> FloatArray:
        force, gap_mm = np.linalg.norm(seen.reading.force_n, axis=1), -seen.touch.indent_mm
        pressed = self.soft_mm_per_n * (seen.goal[:, 0] - force)
        return np.column_stack([self.kept[:, 0], np.where(gap_mm > 0, gap_mm + self.soft_mm_per_n * FORCE_N / 5, pressed)])


class ObjectRoll(Task):
    """Roll a ball between the sensor and a table to a place under the dome. The ball rolls on both without sliding."""

    name, experiment = "ObjectRoll", "edge-2d"
    objects = ("ball-10", "sphere")
    axes = ("x", "y")
    goal_names = ("x_mm", "y_mm")
    oracle_names = ("ball x_mm", "ball y_mm", *Task.oracle_names[2:])
    steps = 60
    """Number of steps. A ball moves half as far as the tool, so it takes 16 steps at full speed to cross the range of places."""
    within_mm = 4.0
    """Largest distance of starts and goals from the apex, mm."""
    indents_mm = (1.5, 2.5)
    """Indentations, mm, of a ball under the apex. At the ends of the range of places they are 0.4 mm smaller. Below 1 mm the contact is
    hardly visible."""
    farthest_mm = 6.0
    near_mm = 0.6
    holds_n = 1e-3
    """Least force of the skin, N, on a ball that rolls with it."""
    columns = 1  # radius of the ball

    def require(self, obj: ObjectSpec) -> None:
        if obj.shape.kind != "sphere":
            raise OptionError(f"ObjectRoll rolls balls; {obj.name} is none, give objects such as 'ball-10'")

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        assert isinstance(obj.shape, SphereShape)  # required
        self.kept[row] = obj.shape.radius_mm
        self._apex = tool.T_work_sensor[:2, 3]
        indent = rng.uniform(*self.indents_mm)
        away, toward = self.within_mm * np.sqrt(rng.uniform(size=2)), rng.uniform(0.0, 2 * np.pi, 2)
        start, goal = np.column_stack([away * np.cos(toward), away * np.sin(toward)])  # uniform in a disc
        T, T_object = np.tile(np.eye(4), (2, 1, 1))
        T[:3, 3] = [0.0, 0.0, indent - tool.mounting.skin_apex_mm] - tool.T_work_sensor[:3, 3]
        T_object[:2, 3] = start  # the ball lies beside the dome's apex, at the same depth as under it
        return Start(T, tuple(map(float, goal)), T_object)

    def carry_object(self, reading: ContactReading, T_work: FloatArray, before: FloatArray, T_object: FloatArray) -> FloatArray:
        held = np.linalg.norm(reading.force_n, axis=1, keepdims=True) > self.holds_n
        moved = 0.5 * held * (T_work[:, :3, 3] - before[:, :3, 3])  # a ball between two plates moves half as far as the upper one
        turn = np.cross([0.0, 0.0, -1.0], moved)  # about its middle, which lies one radius along z from its pole
        step = np.concatenate([np.zeros_like(moved), np.degrees(turn / self.kept)], axis=1)
        out = T_object.copy()
        middle = T_object[:, :3, 3] + self.kept * T_object[:, :3, 2] + moved * [1.0, 1.0, 0.0]
        out[:, :3, :3] = motions(step)[:, :3, :3] @ T_object[:, :3, :3]
        out[:, :3, 3] = middle - self.kept * out[:, :3, 2]
        return out

    def place(self, seen: WorldState) -> FloatArray:
        """Place of the ball's middle relative to the dome's apex, (B, 2) mm, in the work frame."""
        middle = seen.T_object[:, :3, 3] + self.kept * seen.T_object[:, :3, 2]
        turned: FloatArray = np.einsum("bji,bj->bi", seen.T_work[:, :3, :3], middle - seen.T_work[:, :3, 3])
        return turned[:, :2] - self._apex

    def evaluate(self, seen: WorldState) -> StepOutcome:
        place = self.place(seen)
        off_mm = np.linalg.norm(place - seen.goal, axis=1)
        failed = (np.linalg.norm(place, axis=1) > self.farthest_mm) | lost_or_deep(seen.touch)
        good = (off_mm <= self.near_mm) & (seen.touch.indent_mm > 0)
        return StepOutcome(closeness(off_mm / 2), failed, np.zeros(len(failed), bool), good, {"off_mm": off_mm})

    def oracle(self, seen: WorldState) -> FloatArray:
        return np.column_stack([self.place(seen), super().oracle(seen)[:, 2:]])

    def expert(self, seen: WorldState) -> FloatArray:
        off_mm: FloatArray = seen.goal - self.place(seen)
        return -2.0 * off_mm  # a ball rolls half as far as the tool moves


class ObjectPush(Task):
    """Push a block over a table to a place with the sensor held level. The block slides if the push exceeds its friction.

    The friction of the block's support is an ellipsoid in the space of force and torque (Goyal, Ruina & Papadopoulos 1991): inside it
    the block rests; on it the block moves along the ellipsoid's normal.
    """

    name, experiment = "ObjectPush", "surface-2d"
    objects = ("square-rod", "round-bar", "square")
    axes = ("x", "Ry")
    goal_names = ("goal x_mm / 10", "goal z_mm / 10")
    oracle_names = ("block to goal x_mm / 10", "block to goal z_mm / 10", *Task.oracle_names)
    steps = 80
    feed_mm = (0.0, 0.0, 1.0)
    near_mm = 3.0
    holds_n = (0.6, 1.5)
    """Range of the support's friction force, N. One value is sampled for each episode."""
    lever_mm = 15.0
    """Lever of the support's friction, mm: largest friction torque divided by the friction force."""
    give_mm_per_n = 1.0
    """Displacement of a block, mm, per N by which the push exceeds the support's friction: about what the skin gives way."""
    ahead, sliding_share = 0.85, 0.9
    """Share of the tool's motion along the push by which a sliding block moves before its contact is solved, and share of its friction from
    which it counts as sliding. The contact's force then corrects the block once. Its force is within some 0.07 N of its friction."""
    columns = 2  # friction force of the support, and the least distance to the goal so far
    success_share = 0.0
    reached_reward = 10.0

    def begin(self, row: int, tool: Tool, obj: ObjectSpec, surfaces: Surfaces, rng: np.random.Generator) -> Start:
        T = standing_on(tool, surfaces[obj], 0.0, 0.5, rng.uniform(-8.0, 8.0))
        goal = np.array([rng.uniform(-12.0, 12.0), rng.uniform(40.0, 60.0)])
        self._turn = tool.T_work_sensor[:3, :3]
        self.kept[row] = rng.uniform(*self.holds_n), np.linalg.norm(goal - self._middle(np.eye(4)[None])[0, [0, 2]])
        return Start(T, (float(goal[0]), float(goal[1])), np.eye(4))

    def goals_for_agents(self, goal: FloatArray, T_work: FloatArray) -> FloatArray:
        """The goals' places relative to the tools, whose own poses a robot reports."""
        return _shift_in_plane(goal - T_work[:, [0, 2], 3], T_work)

    def carry_object(self, reading: ContactReading, T_work: FloatArray, before: FloatArray, T_object: FloatArray) -> FloatArray:
        force = (before[:, :3, :3] @ self._turn @ reading.force_n[:, :, None])[:, :, 0] * [1.0, 0.0, 1.0]
        size = np.maximum(np.linalg.norm(force, axis=1), 1e-9)
        along = ((T_work - before)[:, :3, 3] * force).sum(axis=1) / size
        shift = self.ahead * np.maximum(along, 0.0) * (size >= self.sliding_share * self.kept[:, 0]) / size
        out = T_object.copy()
        out[:, :3, 3] += shift[:, None] * force
        return out

    def push_object(self, reading: ContactReading, T_work: FloatArray, T_object: FloatArray, tool: Tool) -> FloatArray | None:
        T_sensor = T_work @ tool.T_work_sensor
        turn = T_sensor[:, :3, :3]
        force = (turn @ reading.force_n[:, :, None])[:, :, 0]
        middle = self._middle(T_object)
        arm = T_sensor[:, :3, 3] - middle
        torque = (turn[:, 1] * reading.torque_nmm).sum(axis=1) + arm[:, 2] * force[:, 0] - arm[:, 0] * force[:, 2]  # about its middle
        load = np.stack([force[:, 0], force[:, 2], torque / self.lever_mm], axis=1)
        size = np.sqrt((load * load).sum(axis=1))
        over = np.maximum(size - self.kept[:, 0], 0.0)
        if not over.any():
            return None
        way = (self.give_mm_per_n * over / np.maximum(size, 1e-9))[:, None] * load
        step = np.zeros((len(way), 6))
        step[:, 4] = np.degrees(way[:, 2] / self.lever_mm)
        turned = motions(step)
        turned[:, [0, 2], 3] = way[:, :2]
        about = np.tile(np.eye(4), (2, len(way), 1, 1))
        about[:, :, :3, 3] = middle, -middle
        return about[0] @ turned @ about[1] @ T_object

    def _middle(self, T_object: FloatArray) -> FloatArray:
        """Centre of a block's weight: ``lever_mm`` behind its touched face, (B, 3)."""
        return T_object[:, :3, 3] + self.lever_mm * T_object[:, :3, 2]

    def place(self, seen: WorldState) -> FloatArray:
        """Vector from the block's middle to the goal, (B, 2) mm: x and z of the world."""
        return seen.goal - self._middle(seen.T_object)[:, [0, 2]]

    def evaluate(self, seen: WorldState) -> StepOutcome:
        place = self.place(seen)
        off_mm = np.linalg.norm(place, axis=1)
        failed = out_of_touch(seen.touch) | (place[:, 1] < -self.near_mm)
        reached = (off_mm <= self.near_mm) & ~failed
        gain_mm = np.maximum(self.kept[:, 1] - off_mm, 0.0)  # so neither waiting nor a way back and forth gives a reward
        miss_mm = np.abs(10.0 * _shift_in_plane(place, seen.T_work)[:, 0])
        self.kept[:, 1] -= gain_mm
        reward = gain_mm * closeness(miss_mm / self.near_mm) + self.reached_reward * reached
        return StepOutcome(reward, failed, reached, reached, {"off_mm": off_mm, "gain_mm": gain_mm, "miss_mm": miss_mm})

    def oracle(self, seen: WorldState) -> FloatArray:
        return np.column_stack([_shift_in_plane(self.place(seen), seen.T_work), super().oracle(seen)])

    def expert(self, seen: WorldState) -> FloatArray:
        """It pushes beside the block's middle and obliquely, so that the block turns towards the goal."""
        beside, ahead = 10.0 * _shift_in_plane(self.place(seen), seen.T_work).T
        bearing_deg = np.degrees(np.arctan2(beside, np.maximum(ahead, 1.0)))
        aside_mm = -0.3 * np.clip(bearing_deg, -12.0, 12.0)
        return np.column_stack([aside_mm - seen.touch.place_mm[:, 0], seen.touch.angle_deg + 0.5 * bearing_deg])


def _shift_in_plane(away_mm: FloatArray, T_work: FloatArray) -> FloatArray:
    """Shifts (B, 2) along x and z of the world, relative to tools at ``T_work`` (B, 4, 4), in cm."""
    turned = np.column_stack([away_mm[:, 0], np.zeros(len(away_mm)), away_mm[:, 1]])
    here: FloatArray = np.einsum("bji,bj->bi", T_work[:, :3, :3], turned)
    return here[:, [0, 2]] / 10.0


TASKS: dict[str, type[Task]] = {task.name: task for task in (EdgeFollow, SurfaceFollow, ContourFollow, GentlePress, ObjectRoll, ObjectPush)}
"""All tasks by their names."""


def add_tasks() -> None:
    """Add the tasks that other packages offer."""
    TASKS.update(others("tasks", TASKS, is_one=lambda part: isinstance(part, type) and issubclass(part, Task)))
