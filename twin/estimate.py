"""Interface of a trained model: it takes a frame, and returns an estimate with its interval."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from scenes.sensor import SensorSpec
from twin.pins.pipeline import Pipeline
from twin.types import Form, Frame, Observation


class Estimate(Protocol):
    """An estimator's result on a frame (``training.estimate.estimator.PoseEstimate``)."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def value(self) -> np.ndarray: ...

    @property
    def low(self) -> np.ndarray:
        """Lower ends of the 90 % intervals."""

    @property
    def high(self) -> np.ndarray:
        """Upper ends of the 90 % intervals."""

    @property
    def valid(self) -> bool:
        """Whether the pins allow an estimate."""

    @property
    def reason(self) -> str:
        """Why it is not valid; "" if it is."""

    @property
    def seen(self) -> Observation | None:
        """The pins behind the estimate, as the model's pipeline found them; None if they are not known."""


Estimator = Callable[[Frame], Estimate]


class SensorModel(Protocol):
    """A trained model with its sensor and its pipeline: frame in, estimate out (``training.estimate.estimator.PoseEstimator``)."""

    sensor: SensorSpec
    form: Form
    pipeline: Pipeline

    @property
    def counts_from_rest(self) -> bool:
        """Whether the model can measure the pins' displacements from a frame without contact."""

    def __call__(self, frame: Frame) -> Estimate: ...

    def at_rest(self, frame: Frame) -> "SensorModel":
        """The same model; it measures the pins' displacements from a frame without contact."""

    def seeking_rest(self) -> "SensorModel":
        """The model for a stream in which no frame without contact is known. It may estimate the pins' rest positions from the contacts."""

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Raise an error if the model was not trained on frames of this sensor and form."""


def pins_in(frame: Frame, estimate: Estimate | None, pipeline: Pipeline) -> Observation:
    """The pins behind the estimate of a frame. The pipeline searches for them only if the estimate does not contain them."""
    return pipeline(frame) if estimate is None or estimate.seen is None else estimate.seen
