"""The pins at rest that a model counts displacements from: measured in a frame without contact, those of the unit of its weights, or
estimated from contacts. The camera's view is compared with that of this unit.

For a camera whose sensor was never shown without contact, ``RestSeeker`` collects contacts until these determine the pins at rest.

The estimate from contacts needs a model of the pins' possible displacements, which is fitted without labels. A few numbers (depth, tilt,
shear) determine nearly the whole displacement of the pins by a contact. With the leading principal coordinates a (D,) of the displacements,
in standard deviations, the displacement u (2N,) is

    u = mean + sum_k a_k scale_k mode_k + sum_j w_j(a) mode_(D + j) + what is left

where w are polynomials of the third degree. A unit whose pins at rest are not known shows p = r + u(a) in each frame. Its rest places r
(2N,) and all a are estimated together by least squares (Gauss-Newton). Because u is curved, this also determines the part of r that looks
like a contact, which no mean of the frames determines.
"""

import logging
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from scenes.sensor import SensorSpec
from training.data.audit import polynomials
from training.errors import TrainingError
from training.estimate.domain import Domain
from training.models.part import Unseen
from training.runs.run_files import AGAIN
from twin.errors import FrameError
from twin.estimate import Estimate, SensorModel
from twin.frames import spread_indices
from twin.pins import PinView, Reference, make_reference, measure_reference, view_of
from twin.pins.labelling.reference import camera_modes
from twin.store import ArrayFile
from twin.types import Form, Frame, Observation

if TYPE_CHECKING:
    from training.estimate.estimator import PoseEstimator

"""File of a run with its model of displacements."""
FILE = ArrayFile("file of displacements", "twin train", version=1, error=TrainingError, again=AGAIN)
LEADING, MODES, DEGREE = 6, 40, 3
"""Number of leading coordinates, number of all modes, and degree of the polynomials that determine the other modes. For 3,400 frames of 331
pins the model leaves 0.12 of 3.8 px."""
FEWEST_FRAMES = 400
"""Least number of frames from which displacements are learnt: the polynomials have 78 terms."""
MOST_FRAMES = 4000
"""Most frames from which displacements are learnt."""
RIDGE = 1e-3
"""Penalty of the polynomials' coefficients, per frame."""
FEWEST_CONTACTS, MOST_CONTACTS = 40, 120
"""Least and largest number of frames from which rest places are estimated. With 40 frames they are 0.1 px off, with 120 frames 0.03 px (331
pins). More frames change nothing."""
SAME_UNIT = 0.02
"""Rms distance, in spacings, below which estimated rest places count as equal to the known ones, which are more exact. From 40 contacts of
one unit the distance is 0.011. Two units of one drawing differ by 0.03 and more."""
SMOOTH, ALONE = 0.13, 0.03
"""Prior standard deviations of a unit's pins from the specification's places, in spacings: of a smooth deviation, and of each pin alone."""
NOISE = 0.007
"""Least standard deviation of a pin's noise, in spacings."""
SETTLE, MOST_ROUNDS, SETTLED = 6, 20, 3e-4
"""Numbers of rounds: first rounds for the contacts alone, and most rounds after them; change, in spacings, at which the rounds end."""
LONGEST_STEP = 0.7
"""Largest change of a coordinate in a round."""
OTHER_UNIT = (
    "the pins at rest were found from the contacts: they are not where they were measured on the unit of the weights, so this is another "
    "unit, or its camera or tip was moved; a frame without contact (init_0.png beside the frames) is more exact"
)
"""Note for contacts from which rest places follow that differ from the known ones."""
FEWEST_VIEWED = 8
"""Least number of contacts whose median pins show the camera's view."""
MOST_USUAL = 0.6
"""Least share of contacts that must be usual but for a motion of the camera, for this motion to be estimated from them."""
GIVE_REST = "give a frame without contact (init_0.png beside the frames, --no-contact FRAME)"
LOG = logging.getLogger(__name__)
KNOWN_AGAIN = "after more contacts, the pins at rest are where they were measured on the unit of the weights"
UNLIKE = 0.05
"""Least rms difference, in spacings, between the pins of a frame and those of every collected contact, for the frame to count as another
contact. Of 40 random contacts (331 and 127 pins), three of four differ by this much from the next one. A held contact differs by the pins'
noise, 0.01."""


@dataclass(frozen=True)
class DisplacementModel:
    """Model of the displacements of N pins; arrays as in the module's equation, px.

    Attributes
    ----------
    mean : (2N,) float
    modes : (K, 2N) float
        Orthonormal.
    scale : (D,) float
    weights : (T, K - D) float
        Coefficients of the constant and of the products of two and three coordinates.
    left : (K - D, K - D) float
        Covariance of the residual in these modes, px^2.
    noise : float
        Standard deviation of the residual outside the modes.
    """

    mean: np.ndarray
    modes: np.ndarray
    scale: np.ndarray
    weights: np.ndarray
    left: np.ndarray
    noise: float

    def at(self, a: np.ndarray) -> np.ndarray:
        """Displacements (M, 2N) at coordinates (M, D)."""
        lead = len(self.scale)
        return self.mean + (a * self.scale) @ self.modes[:lead] + _terms(a) @ self.weights @ self.modes[lead:]

    def slopes(self, a: np.ndarray, step: float = 1e-4) -> np.ndarray:
        """Derivatives (M, 2N, D) of the displacements by the coordinates (M, D)."""
        steps = step * np.eye(a.shape[1])
        return np.stack([(self.at(a + h) - self.at(a - h)) / (2 * step) for h in steps], axis=2)

    def precision(self, least: float) -> np.ndarray:
        """Inverse covariance (2N, 2N) of the equation's residual, with at least the noise ``least``, px, in each coordinate."""
        others = self.modes[len(self.scale) :]
        whole: np.ndarray = np.linalg.inv(others.T @ self.left @ others + (self.noise**2 + least**2) * np.eye(others.shape[1]))
        return (whole + whole.T) / 2


def learn_displacements(moved_px: np.ndarray) -> DisplacementModel | None:
    """Learn the model from displacements (M, N, 2) of contacts; None for fewer than ``FEWEST_FRAMES``."""
    if len(moved_px) < FEWEST_FRAMES:
        return None
    chosen = spread_indices(len(moved_px), MOST_FRAMES)
    moved = moved_px[chosen].reshape(len(chosen), -1)
    mean = moved.mean(axis=0)
    _, turned = np.linalg.eigh((moved - mean).T @ (moved - mean))
    modes = turned[:, ::-1][:, :MODES].T
    at = (moved - mean) @ modes.T
    scale = np.maximum(at[:, :LEADING].std(axis=0), 1e-9)
    terms = _terms(at[:, :LEADING] / scale)
    weights = np.linalg.solve(terms.T @ terms + RIDGE * len(terms) * np.eye(terms.shape[1]), terms.T @ at[:, LEADING:])
    rest = at[:, LEADING:] - terms @ weights
    beside = moved - mean - at @ modes
    return DisplacementModel(mean, modes, scale, weights, np.atleast_2d(np.cov(rest.T)), float(np.sqrt(np.mean(beside**2))))


def _terms(a: np.ndarray) -> np.ndarray:
    """The constant 1, and the products of two and three of the coordinates (M, D)."""
    return np.delete(polynomials(a, DEGREE), np.arange(1, 1 + a.shape[1]), axis=1)


def rest_from_contacts(known: DisplacementModel, start: Reference, pins_px: np.ndarray) -> np.ndarray:
    """Rest places of a unit, estimated from its pins (M, N, 2) in contacts of any kind that the model describes.

    Parameters
    ----------
    start : Reference
        Assumed rest places: those of the specification, or of another unit.
    """
    spacing = float(np.median(start.spacing_px))
    seen = pins_px.reshape(len(pins_px), -1) - start.pins_px.ravel()
    prior = np.linalg.inv(_deviation(start.pins_px, spacing))
    precision = known.precision(NOISE * spacing)
    whiten = np.linalg.cholesky(precision).T
    off, a = np.zeros(seen.shape[1]), np.zeros((len(seen), len(known.scale)))
    for _ in range(SETTLE):
        slopes, _, inverse, pull = _round(known, whiten, seen - off, a)
        a = a + np.clip(np.einsum("fkl,fl->fk", inverse, pull), -LONGEST_STEP, LONGEST_STEP)
    for _ in range(MOST_ROUNDS):
        slopes, away, inverse, pull = _round(known, whiten, seen - off, a)
        free = (slopes @ np.linalg.cholesky(inverse)).transpose(1, 0, 2).reshape(seen.shape[1], -1)
        told = len(seen) * np.eye(seen.shape[1]) - free @ free.T
        force = away.sum(axis=0) - np.einsum("fnk,fk->n", slopes, np.einsum("fkl,fl->fk", inverse, pull), optimize=True)
        change = np.linalg.solve(whiten.T @ told @ whiten + prior, whiten.T @ force - prior @ off)
        off = off + change
        follows = np.einsum("fkl,fl->fk", inverse, pull - np.einsum("fnk,n->fk", slopes, whiten @ change, optimize=True))
        a = a + np.clip(follows, -LONGEST_STEP, LONGEST_STEP)
        if np.abs(change).max() < SETTLED * spacing:
            break
    return start.pins_px + off.reshape(-1, 2)


def other_rest(known: DisplacementModel | None, start: Reference, pins_px: np.ndarray) -> np.ndarray | None:
    """The rest places (N, 2) estimated from contacts (M, N, 2), NaN where not found, if they differ from the assumed ones.

    Returns
    -------
    (N, 2) float or None
        None if there is no model of displacements, contacts are too few, or the difference is not significant.
    """
    whole = pins_px[np.isfinite(pins_px).all(axis=(1, 2))]
    if known is None or len(whole) < FEWEST_CONTACTS:
        return None
    chosen = spread_indices(len(whole), MOST_CONTACTS)
    found = rest_from_contacts(known, start, whole[chosen])
    away = float(np.sqrt(np.mean(np.sum((found - start.pins_px) ** 2, axis=1))))
    return found if away > SAME_UNIT * float(np.median(start.spacing_px)) else None


def _round(known: DisplacementModel, whiten: np.ndarray, seen: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, ...]:
    """Whitened slopes (M, 2N, D) and distances (M, 2N) at the coordinates (M, D), and each frame's inverse Hessian and gradient."""
    slopes = whiten @ known.slopes(a)
    away = (seen - known.at(a)) @ whiten.T
    hessian = slopes.transpose(0, 2, 1) @ slopes + np.eye(a.shape[1])  # the prior of a coordinate is its distribution in training
    return slopes, away, np.linalg.inv(hessian), np.einsum("fnk,fn->fk", slopes, away, optimize=True) - a


def _deviation(rest_px: np.ndarray, spacing_px: float) -> np.ndarray:
    """Prior covariance (2N, 2N), px^2, of the difference of a unit's rest places from the specification's."""
    place = rest_px - rest_px.mean(axis=0)
    x, y = (place / np.abs(place).max()).T
    square = x * x + y * y
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, x * square, y * square, x**3, y**3, square * square])
    smooth = np.linalg.qr(terms)[0] * np.sqrt(len(x))
    alike = (SMOOTH * spacing_px) ** 2 * smooth @ smooth.T
    return np.kron(alike, np.eye(2)) + (ALONE * spacing_px) ** 2 * np.eye(2 * len(x))


def write_displacements(path: Path, known: DisplacementModel) -> None:
    """Write the model in the form that ``read_displacements`` reads; modes in half precision."""
    arrays = {name: getattr(known, name).astype(np.float32) for name in ("mean", "scale", "weights", "left")}
    FILE.write(path, arrays | {"modes": known.modes.astype(np.float16)}, {"noise": known.noise})


def read_displacements(path: Path, pins: int) -> DisplacementModel:
    """Read the model that ``write_displacements`` wrote, for a sensor with ``pins`` pins.

    Raises
    ------
    TrainingError
        The file can't be read, is damaged, or belongs to another sensor.
    """
    with FILE.open_arrays(path) as (about, arrays):
        known = DisplacementModel(**{name: array.astype(float) for name, array in arrays.items()}, noise=float(about["noise"]))
        if known.mean.shape != (2 * pins,) or not np.isfinite(known.at(np.zeros((1, len(known.scale))))).all():
            raise ValueError("of other pins")
        return known


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

        None if the difference is not significant, if there are fewer contacts than ``FEWEST_CONTACTS`` (8
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
                LOG.warning("%s, after %d contacts", OTHER_UNIT if other else KNOWN_AGAIN, len(self._contacts_px))
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
