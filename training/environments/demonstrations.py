"""Demonstrations: episodes of a task's scripted expert as a LeRobot data set, for imitation learning."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from training.environments.batch import CHECKED, PERIOD_S, Batch, Options, Settings, checked
from twin.errors import TwinError, format_count
from twin.frames.lerobot import RESTS
from twin.progress import Progress, silent, stage
from twin.records.convert import open_writer
from twin.records.folder import SIDECAR, FolderWriter
from twin.records.lerobot import LeRobotWriter
from twin.records.record import About, Episode, RecordStep, digest
from twin.store import writes
from twin.types import ReadableResult

MOST_FAILED = 20
"""Largest number by which failed episodes may exceed the solved ones."""


@checked(frozen=True, config=CHECKED)
class DemonstrationPlan(Settings):
    """What is demonstrated: ``episodes`` solved episodes of a task in an environment with ``options``."""

    task: str
    options: Options = field(default_factory=Options)
    episodes: Annotated[int, Field(ge=1)] = 50
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True, repr=False)
class Demonstrations(ReadableResult):
    """A data set of demonstrations: its folder, numbers of its episodes and steps, and of the failed episodes that were left out."""

    folder: Path
    episodes: int
    steps: int
    failed: int

    @property
    def written(self) -> list[Path]:
        """The folder."""
        return [self.folder]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"{format_count(self.episodes, 'episodes')}, {format_count(self.steps, 'steps')} as a LeRobot data set"]
        return [*lines, f"{self.failed} further episodes were not solved and are left out"] if self.failed else lines


@writes(gone_on=(SIDECAR, RESTS, *LeRobotWriter.NAMES))
def demonstrate(plan: DemonstrationPlan, out: Path, *, video: bool = False, progress: Progress = silent) -> Demonstrations:
    """Record solved episodes of a scripted expert. If the folder already holds some of them, the missing ones are added.

    Each step has the frame, the pins that the pipeline finds in it, the tool's pose, the wrench, the task's goal, and the action: that of
    the environment, from -1 to 1.

    Parameters
    ----------
    plan : DemonstrationPlan
    out : Path
    video : bool
        Store pictures in videos, which lose detail.

    Raises
    ------
    OptionError
        The task has no expert, or an option can't be fulfilled.
    RecordError
        The folder holds something else.
    TwinError
        The expert solves hardly any episode.
    """
    batch = Batch(plan.task, 1, replace(plan.options, observation="pins", pictures="preview"))
    _begin(batch, plan, 0)
    names = {"action": batch.axes, "goal": batch.task.goal_names}
    numbers = {"pins": 2 * batch.sensor.pins.count, "pose": 6, "wrench": 6, **{name: len(each) for name, each in names.items()}}
    frame = batch.frame(0)
    height, width = frame.image.shape[:2]
    about = About(batch.sensor.name, frame.form, (width, height), frame.image.ndim == 2, numbers, names=names)
    failed: list[int] = []
    writer = open_writer(out, LeRobotWriter.FORMAT, about, round(1 / PERIOD_S), video=video, at_once=True)
    with writer, stage(progress, plan.task) as step:
        writer.write(_solve(batch, plan, writer, failed, lambda done: step(done, plan.episodes)))
        facts = writer.facts
    return Demonstrations(out, len(facts), sum(int(each["length"]) for each in facts), len(failed))


def _begin(batch: Batch, plan: DemonstrationPlan, number: int) -> None:
    """Begin an episode. It depends on the seed and on its number alone."""
    batch.begin(0, np.random.default_rng((plan.seed, number)))
    batch.settle(np.zeros(1, int))


def _solve(
    batch: Batch, plan: DemonstrationPlan, writer: FolderWriter, failed: list[int], done: Callable[[int], object]
) -> Iterator[Episode]:
    """Solved episodes that the writer does not hold, until there are enough. The numbers of the others are added to ``failed``."""
    held, found, options = set(writer.keys), 0, digest(plan.task, asdict(plan.options))
    for number in count():
        if found == plan.episodes:
            return
        key = f"{plan.task}-{plan.seed}-{number}-{options}"
        if key not in held:
            _begin(batch, plan, number)
            steps, solved = _play(batch)
            if not solved:
                failed.append(number)
                if len(failed) > found + MOST_FAILED:
                    raise TwinError(
                        f"the expert of {plan.task} solved {found} of {format_count(found + len(failed), 'episodes')}; give other objects "
                        "or another randomisation, or improve the task's expert"
                    )
                continue
            assert batch.eye is not None  # it makes pictures
            yield Episode(key, plan.task, partial(iter, steps), len(steps), batch.eye.view(0).at_rest.image)
        found += 1
        done(found)


def _play(batch: Batch) -> tuple[list[RecordStep], bool]:
    """The steps of the episode that has begun, and whether the expert solved it. Each step's action comes after its picture."""
    assert batch.eye is not None  # it makes pictures
    steps: list[RecordStep] = []
    while True:
        frame, felt, T, action = batch.frame(0), batch.backend.felt, batch.T_work[0], batch.expert()
        pins_px, turn = batch.eye.view(0).pipeline(frame).pins_px, Rotation.from_matrix(T[:3, :3])
        pose = np.concatenate([T[:3, 3], turn.as_euler("xyz", degrees=True)])
        wrench = np.concatenate([felt.force_n[0], felt.torque_nmm[0]])
        values = {"pins": pins_px, "pose": pose, "wrench": wrench, "goal": batch.goals_for_agents()[0], "action": action[0]}
        single = {name: np.asarray(value, np.float32) for name, value in values.items()}
        steps.append(RecordStep(frame.image, len(steps) * PERIOD_S, single))
        after = batch.step(action, np.zeros(1, int))
        if after.terminated[0] or after.truncated[0]:
            return steps, bool(after.info["is_success"][0])
