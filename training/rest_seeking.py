"""A model for a camera whose sensor nobody showed without contact: it gathers contacts until they tell the pins' rest places."""

import logging
from typing import Protocol

import numpy as np

from scenes.sensor import SensorSpec
from training.displacements import FEWEST_CONTACTS, MOST_CONTACTS, OTHER_UNIT
from twin.estimate import Estimate, SensorModel
from twin.pins import Pipeline
from twin.types import Form, Frame, Observation

LOG = logging.getLogger(__name__)
SAME_UNIT = "the pins at rest are, by more contacts, where they were measured on the unit that the weights are for"
UNLIKE = 0.05
"""A frame counts as another contact if its pins differ from those of every contact so far by this, rms in spacings. Three of four frames
of 40 random contacts (331 and 127 pins) differ so from the next one; a contact that is held differs by the pins' noise, 0.01."""


class RestingModel(SensorModel, Protocol):
    """A model that contacts can tell where its pins are at rest (``training.estimator.PoseEstimator``)."""

    def at_known_rest(self) -> "RestingModel": ...

    def told_rest(self, nodes_px: np.ndarray) -> tuple["RestingModel", bool]: ...


class RestSeeker:
    """A model on a stream of frames: it counts from the rest places that are known, and from those that the contacts tell once they do.

    They are asked after ``FEWEST_CONTACTS`` contacts that differ, and again, for the last time, after ``MOST_CONTACTS``. The frame at
    which that happens takes up to a second longer.

    Parameters
    ----------
    model : RestingModel

    Attributes
    ----------
    sensor, form, pipeline : SensorSpec, Form, Pipeline
        As the model's; the pipeline has the rest places that are counted from at present.
    other : bool
        Whether the contacts told other rest places than those that are known.
    """

    sensor: SensorSpec
    form: Form
    pipeline: Pipeline
    counts_from_rest = True

    def __init__(self, model: RestingModel) -> None:
        self._given, self._model, self.other = model, model.at_known_rest(), False
        self.sensor, self.form, self.pipeline = model.sensor, model.form, self._model.pipeline
        self._contacts_px: list[np.ndarray] = []
        self._unlike_px = UNLIKE * float(np.median(self.pipeline.reference.spacing_px))

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """As the model's."""
        self._model.check(sensor, form)

    def at_rest(self, frame: Frame) -> SensorModel:
        """The model, counting from a frame without contact: nothing is sought any more."""
        return self._given.at_rest(frame)

    def seeking_rest(self) -> SensorModel:
        """Itself."""
        return self

    def __call__(self, frame: Frame) -> Estimate:
        """The estimate of one frame, counted from the rest places that are known by then; raises as the model does."""
        made = self._model(frame)
        if self._gathered(made.seen) and len(self._contacts_px) in (FEWEST_CONTACTS, MOST_CONTACTS):
            told, other = self._given.told_rest(np.array(self._contacts_px))
            if other or self.other:  # else the model that remembers the frames so far goes on
                self._model, self.other, self.pipeline = told, other, told.pipeline
                made = self._model(frame)
                LOG.warning("%s, after %d contacts", OTHER_UNIT if other else SAME_UNIT, len(self._contacts_px))
        return made

    def _gathered(self, seen: Observation | None) -> bool:
        """Whether a frame's pins are those of another contact than any so far, which is then kept."""
        if seen is None or seen.graph is None or len(self._contacts_px) >= MOST_CONTACTS:
            return False
        nodes_px = seen.graph.nodes_px
        if any(np.sqrt(np.mean(np.sum((nodes_px - other) ** 2, axis=1))) < self._unlike_px for other in self._contacts_px):
            return False
        self._contacts_px.append(nodes_px)
        return True
