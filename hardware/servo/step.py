"""Settings and hooks of a servo loop, and the record of each of its steps."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twin.estimate import Estimate, Estimator
from twin.types import Frame


@dataclass(frozen=True, slots=True)
class StepRecord:
    """The record of one step.

    Attributes
    ----------
    index : int
    time_s : float
        ``time.monotonic()`` when the command was given.
    sequence : int
        Sequence number of the frame on which the step was decided.
    frame_s : float
        Time of the frame's exposure.
    age_s : float
        Age of the frame when the loop received it.
    fresh : bool
        Whether no earlier step used the frame.
    latency_s : float
        Time from the exposure to the command.
    compute_s : float
        Time from receiving the frame to the command.
    names : tuple of str
        Names of the estimated labels.
    value, low, high : (K,) float
        The estimate and the limits of its interval; NaN if the estimate is not valid.
    depth_mm, angle_deg : float
        Estimated depth of the tool, and estimated angle between the tool and the surface's normal.
    pose : (6,) float
        The pose from which the step was decided: where the arm is, or the end of its present move.
    exposed_pose : (6,) float
        The arm's pose at the frame's exposure.
    joints_deg : (J,) float
    sent : (6,) float
        The pose that was commanded.
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


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the loop.

    Attributes
    ----------
    steps : int
    blocking : bool
        If true, the loop waits for the end of each move and takes a frame that was exposed after it. Otherwise it decides on the newest
        frame every ``period_s``.
    period_s : float
    frame_timeout_s : float
        Longest wait for a frame. It applies with ``blocking``, and to the first frame in any case.
    give_up_s : float
        The loop ends with an error after it has held still for this time.
    """

    steps: int
    blocking: bool = True
    period_s: float = 0.1
    frame_timeout_s: float = 3.0
    give_up_s: float = 3.0


@dataclass(frozen=True)
class LoopHooks:
    """Functions that a loop calls.

    Attributes
    ----------
    law : callable, optional
        Replaces the servo law: gives the next pose (6,) from the arm's pose (6,) and the estimate.
    take_rest : callable, optional
        Gets a frame without contact, taken clear of the object, and returns the estimator to use from then on.
    on_step : callable, optional
        Called with each record, its frame and its estimate after the move was commanded.
    on_estimate : callable, optional
        Called with each used frame and its estimate, valid or not. It must return at once.
    """

    law: Callable[[np.ndarray, Estimate], np.ndarray] | None = None
    take_rest: Callable[[Frame], Estimator] | None = None
    on_step: Callable[[StepRecord, Frame, Estimate], object] | None = None
    on_estimate: Callable[[Frame, Estimate], object] | None = None
