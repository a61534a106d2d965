"""The pins at rest that a model counts displacements from: measured in a frame without contact, those of the unit of its weights, or
estimated from contacts. The camera's view is compared with that of this unit.

For a camera whose sensor was never shown without contact, ``RestSeeker`` collects contacts until these determine the pins at rest.
"""

import logging
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from scenes.sensor import SensorSpec
from training.estimate.displacements import FEWEST_CONTACTS, MOST_CONTACTS, OTHER_UNIT, DisplacementModel, other_rest
from training.estimate.domain import Domain
from training.models.part import Unseen
from twin.errors import FrameError
from twin.estimate import Estimate, SensorModel
from twin.frames import spread_indices
from twin.pins import PinView, Reference, make_reference, measure_reference, view_of
from twin.pins.labelling.reference import camera_modes
from twin.types import Form, Frame, Observation

if TYPE_CHECKING:
    from training.estimate.estimator import PoseEstimator

FEWEST_VIEWED = 8
"""Least number of contacts whose median pins show the camera's view."""
MOST_USUAL = 0.6
"""Least share of contacts that must be usual but for a motion of the camera, for this motion to be estimated from them."""
GIVE_REST = "give a frame without contact (init_0.png beside the frames, --no-contact FRAME)"
LOG = logging.getLogger(__name__)
SAME_UNIT = "after more contacts, the pins at rest are where they were measured on the unit of the weights"
UNLIKE = 0.05
"""Least rms difference, in spacings, between the pins of a frame and those of every collected contact, for the frame to count as another
contact. Of 40 random contacts (331 and 127 pins), three of four differ by this much from the next one. A held contact differs by the pins'
noise, 0.01."""


@dataclass(frozen=True)
class RestPlaces:
    """Finds the pins at rest of the sensor in use.

    Attributes
    ----------
    sensor, form : SensorSpec, Form
    known : Reference
        The pins at rest of the unit from which the weights were trained.
    displacements : Displacements or None
        Model of the pins' possible displacements.
    domain : Domain or None
        Patterns that the model was trained on.
    used : bool
        Whether the model uses displacements from rest; if not, no other places at rest are estimated.
    """

    sensor: SensorSpec
    form: Form
    known: Reference
    displacements: DisplacementModel | None
    domain: Domain | None
    used: bool

    def measured(self, frame: Frame) -> tuple[Reference, str]:
        """The pins at rest in a frame without contact, and what they do not decide about the camera's view.

        Raises
        ------
        FrameError
            The frame shows a contact, or not this sensor, or the camera's picture is displaced so far that estimates would be wrong
            (``twin.pins.labelling.reference``).
        """
        reference = measure_reference(self.sensor, self.form, frame, known=self.known)
        return reference, self.require_view(reference.pins_px, frame.name or "frame").describe_ambiguity()

    def same_unit(self, reference: Reference) -> bool:
        """Whether pins at rest are those of the unit from which the weights were trained, by the tolerances of its print."""
        return view_of(reference.pins_px, self.known, self.sensor.pins, camera_modes(self.sensor, self.form)).same

    def of_contacts(self, nodes_px: np.ndarray, name: str) -> tuple[Reference | None, str]:
        """The pins at rest estimated from contacts with pins (M, N, 2), if they are not the known ones, and what is undecided; raises as
        ``require_view_of_contacts``."""
        rest = self.other(self.known, nodes_px)
        return rest, self.require_view_of_contacts(nodes_px, rest, name)

    def other(self, start: Reference, nodes_px: np.ndarray) -> Reference | None:
        """The rest layout estimated from contacts with pins (M, N, 2), if it differs from ``start``, the assumed one.

        None if the difference is not significant, if there are fewer contacts than ``training.estimate.displacements.FEWEST_CONTACTS`` (8
        for the place of the camera alone), or if the run did not learn how contacts displace the pins.
        """
        if not self.used:
            return None
        found = other_rest(self.displacements, start, nodes_px)
        if found is None and self.domain is not None:
            motions, usual = self.common_camera(start, nodes_px)
            if motions.any() and usual >= MOST_USUAL:
                found = start.pins_px + start.spacing_px.mean() * (motions @ self.domain.motions).reshape(-1, 2)
        return None if found is None else make_reference(found, self.sensor.pins)

    def common_camera(self, start: Reference, nodes_px: np.ndarray) -> tuple[np.ndarray, float]:
        """``Domain.common_camera`` of contacts (M, N, 2), px, with the pins at rest ``start``; no motion for few contacts or no domain."""
        whole = nodes_px[np.isfinite(nodes_px).all(axis=(1, 2))]
        if self.domain is None or len(whole) < FEWEST_VIEWED:
            return np.zeros(4), 1.0
        whole = whole[spread_indices(len(whole), MOST_CONTACTS)]
        return self.domain.common_camera((whole - start.pins_px) / start.spacing_px.mean())

    def usual_share(self, nodes_px: np.ndarray) -> float:
        """Share of contacts with pins (M, N, 2), px, that the model knows, wherever the camera sits; 0 if the run holds no domain."""
        return 0.0 if self.domain is None else self.common_camera(self.known, nodes_px)[1]

    def require_view_of_contacts(self, nodes_px: np.ndarray, rest: Reference | None, name: str) -> str:
        """As ``require_view``, from the pins (M, N, 2) of contacts, and from the places at ``rest`` that were estimated from them.

        Returns
        -------
        str
            What these places do not decide about the view; "" if nothing.
        """
        if len(nodes_px) >= FEWEST_VIEWED:
            self.require_view(np.median(nodes_px, axis=0), name, contacts=True)
            motions, usual = self.common_camera(rest or self.known, nodes_px)
            if usual < MOST_USUAL and (rest is not None or motions.any()):
                raise FrameError(
                    f"{name}: {1 - usual:.0%} of them are no contacts that the weights of {self.sensor.name} know, and the camera is "
                    f"displaced: its picture may be turned, mirrored or stretched; {GIVE_REST}"
                )
        view = None if rest is None else self.require_view(rest.pins_px, name)
        if view is not None and view.pressed:
            raise FrameError(
                f"{name}: no pins at rest of {self.sensor.name} explain them: the camera's picture may be turned or mirrored, or they are "
                f"of a kind that the weights do not know; {GIVE_REST}"
            )
        return "" if view is None else view.describe_ambiguity()

    def require_view(self, pins_px: np.ndarray, name: str, *, contacts: bool = False) -> PinView:
        """The camera's view of pins at rest (N, 2), or of the median of ``contacts``, against the unit of the weights.

        Raises
        ------
        FrameError
            The picture ``name`` is displaced so far that estimates would be wrong.
        """
        view = view_of(pins_px, self.known, self.sensor.pins, camera_modes(self.sensor, self.form))
        view.require_small(name, f"the unit of the weights of {self.sensor.name}", contacts=contacts)
        return view


class RestSeeker:
    """A model on a stream of frames. It starts with the known rest places, and changes to those estimated from the contacts as soon as
    possible.

    The rest places are estimated after ``FEWEST_CONTACTS`` different contacts, and once more after ``MOST_CONTACTS``. The frame at which
    this happens takes up to a second longer. If the contacts then show that the camera's picture is turned, mirrored or displaced, no frame
    gets an estimate any more; the reason says so.

    Parameters
    ----------
    model : PoseEstimator

    Attributes
    ----------
    sensor, form, pipeline : SensorSpec, Form, Pipeline
        As those of the model. The pipeline has the rest places that are used at present.
    other : bool
        Whether the estimated rest places differ from the known ones.
    """

    counts_from_rest = True

    def __init__(self, model: "PoseEstimator") -> None:
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
