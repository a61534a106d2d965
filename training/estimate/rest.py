"""The pins at rest that a model counts displacements from: measured in a frame without contact, those of the unit of its weights, or
estimated from contacts. The camera's view is compared with that of this unit.
"""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import SensorSpec
from training.estimate.displacements import MOST_CONTACTS, DisplacementModel, other_rest
from training.estimate.domain import Domain
from twin.errors import FrameError
from twin.frames import spread_indices
from twin.pins import PinView, Reference, make_reference, measure_reference, view_of
from twin.pins.labelling.view import camera_modes
from twin.types import Form, Frame

FEWEST_VIEWED = 8
"""Least number of contacts whose median pins show the camera's view."""
MOST_USUAL = 0.6
"""Least share of contacts that must be usual but for a motion of the camera, for this motion to be estimated from them."""
GIVE_REST = "give a frame without contact (init_0.png beside the frames, --no-contact FRAME)"


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
            (``twin.pins.labelling.view``).
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
