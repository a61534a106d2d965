"""What a servo loop is told, and what it tells of each of its decisions."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol, Self

import numpy as np

from hardware.arms.arm import ArmState
from scenes.sensor import SensorSpec
from twin.pins.pipeline import Pipeline
from twin.types import Form, Frame


class Estimate(Protocol):
    """What an estimator makes of a frame (``training.estimator.PoseEstimate``)."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def value(self) -> np.ndarray: ...

    @property
    def low(self) -> np.ndarray: ...

    @property
    def high(self) -> np.ndarray: ...

    @property
    def valid(self) -> bool: ...

    @property
    def reason(self) -> str: ...


Estimator = Callable[[Frame], Estimate]


class SensorModel(Protocol):
    """A trained model with its sensor and its pipeline: frame in, estimate out (``training.estimator.PoseEstimator``)."""

    sensor: SensorSpec
    form: Form
    pipeline: Pipeline

    @property
    def counts_from_rest(self) -> bool:
        """Whether it counts pins from a frame without contact, where it is given one."""

    def __call__(self, frame: Frame) -> Estimate: ...

    def at_rest(self, frame: Frame) -> Self:
        """The same model, counting pins from a frame without contact."""

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Raise an error where frames of that sensor and form are not what the model was trained on."""


Guard = Callable[[ArmState, np.ndarray], np.ndarray]  # state and target (6,) to what may be sent; raises to refuse


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One decision.

    Attributes
    ----------
    index : int
    time_s : float
        ``time.monotonic()`` when the command was given.
    sequence : int
        Of the frame behind it, ``frame_s`` its exposure, ``age_s`` its age then, ``fresh`` whether it was not used before.
    latency_s : float
        From exposure to command, and ``compute_s`` from having the frame to the command.
    names : tuple of str
    value, low, high : (K,) float
        The estimate and its interval; NaN where not valid.
    depth_mm, angle_deg : float
        What they mean for the law.
    pose, joints_deg : (6,), (J,) float
        From where it decided (the arm's place, or the end of the move it is on), ``exposed_pose``: at the frame's exposure.
    sent : (6,) float
        What the arm was told.
    """

    index: int
    time_s: float
    sequence: int
    frame_s: float
    age_s: float
    fresh: bool
    latency_s: float
    compute_s: float
    names: tuple[str, ...]
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    depth_mm: float
    angle_deg: float
    pose: np.ndarray
    exposed_pose: np.ndarray
    joints_deg: np.ndarray
    sent: np.ndarray

    def plain(self) -> dict[str, Any]:
        """For a session's line."""
        return asdict(self)


@dataclass(frozen=True)
class LoopSettings:
    """How the loop runs.

    Attributes
    ----------
    steps : int
    blocking : bool
        Wait for each move and take a frame exposed after it; else a decision every ``period_s`` on the newest frame.
    period_s : float
    frame_timeout_s : float
        For so long a frame is waited for where one is (blocking, and at the start).
    give_up_s : float
        After holding for so long the loop ends with an error.
    """

    steps: int
    blocking: bool = True
    period_s: float = 0.1
    frame_timeout_s: float = 3.0
    give_up_s: float = 3.0
