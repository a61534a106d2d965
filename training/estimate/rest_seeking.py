"""A model for a camera whose sensor was never shown without contact. It collects contacts until these determine the pins at rest."""

import logging
from time import perf_counter
from typing import Protocol

import numpy as np

from scenes.sensor import SensorSpec
from training.estimate.displacements import FEWEST_CONTACTS, MOST_CONTACTS, OTHER_UNIT
from training.models.part import Unseen
from twin.errors import FrameError
from twin.estimate import Estimate, SensorModel
from twin.pins import Pipeline
from twin.types import Form, Frame, Observation

LOG = logging.getLogger(__name__)
SAME_UNIT = "after more contacts, the pins at rest are where they were measured on the unit of the weights"
UNLIKE = 0.05
"""Least rms difference, in spacings, between the pins of a frame and those of every collected contact, for the frame to count as another
contact. Of 40 random contacts (331 and 127 pins), three of four differ by this much from the next one. A held contact differs by the pins'
noise, 0.01."""


class RestingModel(SensorModel, Protocol):
    """A model whose pins at rest can be estimated from contacts (``training.estimate.estimator.PoseEstimator``)."""

    def at_known_rest(self) -> "RestingModel": ...

    def rest_from_contacts(self, nodes_px: np.ndarray, name: str) -> tuple["RestingModel", bool]: ...

    def estimate_without_pose(self, seen: Unseen, started: float) -> Estimate: ...


class RestSeeker:
    """A model on a stream of frames. It starts with the known rest places, and changes to those estimated from the contacts as soon as
    possible.

    The rest places are estimated after ``FEWEST_CONTACTS`` different contacts, and once more after ``MOST_CONTACTS``. The frame at which
    this happens takes up to a second longer. If the contacts then show that the camera's picture is turned, mirrored or displaced, no frame
    gets an estimate any more; the reason says so.

    Parameters
    ----------
    model : RestingModel

    Attributes
    ----------
    sensor, form, pipeline : SensorSpec, Form, Pipeline
        As those of the model. The pipeline has the rest places that are used at present.
    other : bool
        Whether the estimated rest places differ from the known ones.
    """

    sensor: SensorSpec
    form: Form
    pipeline: Pipeline
    counts_from_rest = True

    def __init__(self, model: RestingModel) -> None:
        self._given, self._model, self.other = model, model.at_known_rest(), False
        self.sensor, self.form, self.pipeline = model.sensor, model.form, self._model.pipeline
        self._contacts_px: list[np.ndarray] = []
        self._refused = ""
        self._unlike_px = UNLIKE * float(np.median(self.pipeline.reference.spacing_px))

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """As the model's ``check``."""
        self._model.check(sensor, form)

    def at_rest(self, frame: Frame) -> SensorModel:
        """The model with the rest places of a frame without contact; no rest places are estimated any more."""
        return self._given.at_rest(frame)

    def seeking_rest(self) -> SensorModel:
        """The object itself."""
        return self

    def __call__(self, frame: Frame) -> Estimate:
        """The estimate of one frame, with the rest places that are known by then; raises as the model does."""
        if self._refused:
            return self._model.estimate_without_pose(Unseen(self._refused), perf_counter())
        made = self._model(frame)
        if self._collect_contact(made.seen) and len(self._contacts_px) in (FEWEST_CONTACTS, MOST_CONTACTS):
            try:
                told, other = self._given.rest_from_contacts(np.array(self._contacts_px), "the contacts so far")
            except FrameError as error:
                self._refused = str(error)
                LOG.warning("%s", error)
                return self._model.estimate_without_pose(Unseen(self._refused), perf_counter())
            if other or self.other:  # otherwise the present model continues, because it keeps the frames so far
                self._model, self.other, self.pipeline = told, other, told.pipeline
                made = self._model(frame)
                LOG.warning("%s, after %d contacts", OTHER_UNIT if other else SAME_UNIT, len(self._contacts_px))
        return made

    def _collect_contact(self, seen: Observation | None) -> bool:
        """Whether a frame's pins show a contact that differs from all collected ones. It is then collected."""
        if seen is None or seen.graph is None or len(self._contacts_px) >= MOST_CONTACTS:
            return False
        nodes_px = seen.graph.nodes_px
        if any(np.sqrt(np.mean(np.sum((nodes_px - other) ** 2, axis=1))) < self._unlike_px for other in self._contacts_px):
            return False
        self._contacts_px.append(nodes_px)
        return True
