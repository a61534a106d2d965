"""Interface of a trained model: it takes a frame, and returns an estimate with its interval."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from scenes.sensor import SensorSpec
from twin.pins.pipeline import Pipeline
from twin.types import Form, Frame, Observation

LEVEL = {"pose_1": "offset", "pose_2": "depth", "pose_6": "angle", "move_1": "shear", "move_6": "twist"}
"""Roles of labels of an arm that holds the sensor level."""
UPRIGHT = {"pose_1": "offset x", "pose_2": "offset y", "pose_3": "depth", "pose_4": "tilt x", "pose_5": "tilt y", "pose_6": "angle"}
UPRIGHT |= {"move_1": "shear x", "move_2": "shear y", "move_6": "twist"}
"""Roles of labels of an arm that holds the sensor upright: these have the depth in ``pose_3``."""
NAMED = {"pose_z": "depth", "pose_Rx": "tilt x", "pose_Ry": "tilt y", "Fx": "force x", "Fy": "force y", "Fz": "force z"}
"""Roles of labels that name their axis."""


def readable_labels(names: Sequence[str]) -> list[str]:
    """Readable names of a model's labels, by their role: ``pose_2`` and ``pose_6`` of an MG400 are 'depth' and 'angle'."""
    roles = NAMED | (UPRIGHT if "pose_3" in names else LEVEL)
    return [roles.get(name, name.replace("_", " ")) for name in names]


class Estimate(Protocol):
    """An estimator's result on a frame (``training.estimate.estimator.PoseEstimate``)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the labels."""

    @property
    def units(self) -> tuple[str, ...]: ...

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


@dataclass(frozen=True)
class PinsFound:
    """The pins of a frame, without an estimate. The attributes are those of ``Estimate``."""

    seen: Observation
    reason: str
    names: tuple[str, ...] = ()
    value: np.ndarray = field(default_factory=lambda: np.zeros(0))
    valid: bool = False

    @property
    def units(self) -> tuple[str, ...]:
        """No units."""
        return ("",) * len(self.names)

    @property
    def low(self) -> np.ndarray:
        """NaN, because there are no intervals."""
        return np.full(len(self.names), np.nan)

    high = low


class PinsAlone:
    """Takes a model's place where there is none: it finds the pins of a frame and estimates nothing.

    Parameters
    ----------
    sensor : SensorSpec
    form : Form
    reason : str
        Why there is no estimate.
    """

    counts_from_rest = False

    def __init__(self, sensor: SensorSpec, form: Form, reason: str) -> None:
        self.sensor, self.form, self._reason = sensor, form, reason
        self.pipeline = Pipeline(sensor, form)

    def __call__(self, frame: Frame) -> PinsFound:
        return PinsFound(self.pipeline(frame), self._reason)

    def at_rest(self, frame: Frame) -> "PinsAlone":
        """The same; nothing is measured from the frame."""
        return self

    def seeking_rest(self) -> "PinsAlone":
        """The same; nothing is sought."""
        return self

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Accept all frames: the pipeline refuses those that are not the sensor's."""


def pins_in(frame: Frame, estimate: Estimate | None, pipeline: Pipeline) -> Observation:
    """The pins behind the estimate of a frame. The pipeline searches for them only if the estimate does not contain them."""
    return pipeline(frame) if estimate is None or estimate.seen is None else estimate.seen
