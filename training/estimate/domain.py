"""The domain of a model: the patterns of displaced pins that it was trained on, and how far a frame lies from them.

A few numbers (depth, tilt, shear, place) determine nearly the whole displacement of the pins by a contact. The displacement u (2N,) of a
frame is split into the four small motions of a camera (shift, turn and scale) and the rest. The rest is written in the principal components
of the training frames. Five distances follow; each is divided by its limit, which all but one in ``ALLOWED`` training frames keep that were
left out of the fit:

- outside: rms of what is outside of the components (a torn frame, pins with wrong names, a lens of another kind);
- misfit: rms difference between the further components and those that a polynomial of the leading ones predicts (a pattern that is
  possible, but that no contact makes);
- beyond: distance of the leading components from the nearest training frame (a contact deeper, or of another kind, than any);
- parts: difference between the components that follow from a part of the pins (upper quarter, half, three quarters, left half) and from the
  others (a torn frame, or two frames in one picture), less what a polynomial of the leading components predicts; of the four the largest;
- camera: difference between the camera's motions and those that the contact itself causes, by the same polynomial.

The lightest contacts of a training set may be far from the frame at rest. So that lighter ones are no strangers, training frames are also
used with their displacements reduced at random. They count as known patterns, but not as known labels: the intervals grow with the
difference from the nearest frame whose label is known, by the rate at which labels change between training frames. Lost pins are placed
where the others make them most probable, and what is not known of them counts as such a difference, too.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import KDTree

from training.data.label_code import HALF_CIRCLE_DEG, label_error
from training.errors import TrainingError
from training.models.vgnn.registration import align
from training.runs.run_files import AGAIN
from twin.estimate import readable_labels
from twin.frames import spread_indices
from twin.pins import Reference
from twin.store import ArrayFile
from twin.types import BoolArray, FloatArray

"""File of a run with its domain."""
FILE = ArrayFile("file of a domain", "twin train", version=3, error=TrainingError, again=AGAIN)
NUMBERS: dict[str, Any] = {"lighter": int, "near": float, "blind": float, "simulated": bool}
"""Fields of a domain that are no arrays. Files of earlier versions lack the last one."""
MODES, LEADING, CUBED = 60, 12, 6
"""Number of principal components, of leading ones, and of those whose products of three are terms of the polynomial."""
FEWEST = 60
"""Least number of training frames from which a domain follows."""
PER_TERM = 4
"""Least number of frames for each term of the polynomial, and for each component."""
MOST_FRAMES, KNOWN = 8000, 1200
"""Most frames that the components are learnt from, and most frames that are kept as known ones."""
LOST_FRAMES = 300
"""Most training frames of which the lost pins are looked at."""
LIGHTER = 0.34
"""Number of frames with reduced displacements, relative to the number of training frames."""
FOLDS = 5
"""Number of parts of the training frames; each part is measured by a fit to the others."""
ALLOWED = 0.005
"""Share of left-out training frames beyond each limit."""
WHITE = 1e-3
"""Share of the variance of the parts' differences that counts as noise."""
PARTS = ((1, 0.5), (1, 0.25), (1, 0.75), (0, 0.5))
"""Axis across which the pins are parted (0: x, 1: y), and the share of the pins in the first part. All components are compared for the
first one, ``COMPARED`` for the others."""
COMPARED = 20
RIDGE = 1e-3
"""Penalty of the polynomial's coefficients, per frame, for components of standard deviation 1."""
LEAST_DEVIATION = 1e-4
"""Least standard deviation of a component relative to the first. Smaller ones are rounding errors."""
OUTSIDE, NOISE = 0.015, 0.01
"""Least limit of the distance outside, and standard deviation of a coordinate by the pins' noise, in spacings, whatever the training frames
had: training in the twin has less noise than cameras."""
FARTHEST = 50.0
"""Largest size of a component, in standard deviations, that the polynomial is evaluated at."""
SHIFT, TURN_DEG, SCALE = 0.02, 0.1, 0.002
"""Least limits of the camera's motions: shift in spacings, turn, change of scale."""
EVEN = 1.5
"""Limit of the parts for training frames of one kind. Frames of many kinds have rare ones that are farther off, and contacts that are not
among them are farther still; their limit is up to 1.3 times as large. Two frames in one picture lie at 2 and more, or at 6 and more."""
USUAL_DISTANCE = 0.995
"""Share of left-out training frames whose distance to the nearest known one counts as usual."""
NEIGHBOURS = 10
"""Number of nearest known frames between which the rate of a label is measured."""
SURE_RATE = 0.9
"""Share of pairs of neighbouring frames whose labels differ by at most the rate."""
REFUSED = np.array([2.0, 2.0, 2.0, 1.0])
"""Distances outside, misfit, beyond and parts, in limits, above which a frame gets no estimate. Between 1 and this the intervals grow."""
GROWS = 2.0
"""Growth of the intervals with the ratio of a distance to the one from which on they grow (``Domain.starts``)."""
FROM_NOISE = np.array([True, False, False, False, False])
"""Distances whose limit is that of the pins' noise, which models average out: outside. Intervals grow from this limit."""
ROOM = 1.1
"""Factor on the other distances of frames that determined the intervals, from which on intervals grow: so few frames do not show the rarest
ones. Of the 3763 frames of each MG400 sensor, 0.3 % more get wider intervals; without this factor 1.2 % and 0.5 %."""
CORRECTED = np.array([0.6, 0.6, np.radians(3.0), 0.05])
"""Largest motions of the camera that are removed from a frame: shift in spacings, turn, change of scale."""
REMOVED = (1.0, 1.5)
"""Motions of the camera, in limits, from which on a part of them is removed, and from which on all."""
UNREMOVED = np.array([np.inf, np.inf, np.inf, np.inf, REMOVED[0]])
"""Distances above which growing intervals grow no more: where the camera's motion is removed, that widens them instead."""
IN_RANGE = 0.995
"""Quantile of the training labels that is taken as an end of their range. A few states of contacts lie far outside of an experiment."""
BEYOND_RANGE = 0.25
"""Share of a label's trained range by which an estimate may leave it."""
IN_PLACE = np.array([0.95, 0.9, 0.9, 1.0])
"""As ``REFUSED``, if a displacement of the camera was removed from the frame: two ways of being strange are one too many (a mirrored
picture). A picture that was turned or enlarged adds a little noise, which is outside."""
DOUBT = np.array([0.05, 0.05, 0.25, 0.25])
"""Share of each removed motion of the camera that may be something else: another lens looks like another scale."""
USUAL = np.array([1.25, 1.0, 1.0, 1.2])
"""As ``REFUSED``: distances up to which a contact is usual, wherever the camera sits."""
OFF_PLACE = 1.5
"""Growth of the intervals where motions of the camera were removed."""
SPLITS = 24
"""Number of rows and columns at which a picture is tried to be torn."""
EXPLAINS = 0.7
"""Least share of a frame's strangeness that a cause explains if it is named."""
TORN_MORE = 0.1
"""Share by which a tear must explain more than a smooth change of the view: it has one number more to fit."""


@dataclass(frozen=True)
class Strangeness:
    """How far a frame lies from the training frames of a model.

    Attributes
    ----------
    parts : (5,) float
        The distances outside, misfit, beyond, parts and camera (see the module), each divided by its limit.
    camera : (4,) float
        Difference of the camera: shift in x and y (spacings), turn (rad, from x towards y), relative change of scale.
    unknown : float
        Rms difference of a coordinate, in spacings, from the nearest frame with a known label, less the usual one; 0 for usual frames. What
        is not known of lost pins is added.
    uneven : (4,) float
        Differences between each of ``PARTS`` and the others, before they are divided by their limits.
    ample : float
        Rms size of the leading components, in standard deviations, at least 1. What no model of contacts explains grows with it.
    """

    parts: np.ndarray
    camera: np.ndarray
    unknown: float
    uneven: np.ndarray
    ample: float


@dataclass(frozen=True)
class DomainVerdict:
    """What follows for an estimate from how strange its frame is.

    Attributes
    ----------
    reason : str
        Why there is no estimate; empty if there is one.
    factor : float
        Factor on the half widths of its intervals.
    added : (K,) float
        Half width that is added to each interval.
    notes : tuple of str
        Why the intervals are wider.
    camera : (4,) float
        Motions of the camera that are to be removed from the pins: see ``Strangeness``.
    """

    reason: str
    factor: float = 1.0
    added: np.ndarray = field(default_factory=lambda: np.zeros(0))
    notes: tuple[str, ...] = ()
    camera: np.ndarray = field(default_factory=lambda: np.zeros(4))


@dataclass(frozen=True)
class Domain:
    """The domain of a model for N pins and K labels; lengths in mean rest spacings.

    Attributes
    ----------
    motions : (4, 2N) float
        Displacements by a shift of the camera along x and y, a turn by 1 rad, and a change of scale by 1.
    mean : (2N,) float
    components : (D, 2N) float
        Orthonormal, and orthogonal to the motions.
    deviation : (D,) float
        Standard deviations of the components.
    weight : (T, D - L + 4 + P) float
        Coefficients from the polynomial's terms in the L leading components to the further ones, to the camera's motions, and to the P
        differences of parts.
    whiten : (P, P) float
        Inverse square roots of the covariances of each part's differences, on the diagonal.
    usual : (D - L,) float
        Root mean square of the polynomial's residual in the further components.
    known : (n, L) float
        Leading components of training frames with labels, then ``lighter`` ones.
    limits : (3 + 4 + 4,) float
        Limits of outside, misfit and beyond, of each of ``PARTS``, and of the camera's motions.
    rate : (K,) float
        Rate of each label: change for each spacing of rms difference between frames.
    least : (K,) float
        Usual half widths of the intervals: outside of the domain no interval is narrower.
    low, high : (K,) float
        Range of the labels.
    lighter : int
        Number of the known frames that are reduced ones.
    near : float
        Usual rms difference of a frame from its nearest known one.
    blind : float
        Usual rms of what is not known of lost pins.
    simulated : bool
        Whether all training frames with labels are simulated.
    starts : (5,) float
        Distances, in limits, from which on the intervals grow; at most 1: see ``starting_at``.
    """

    motions: np.ndarray
    mean: np.ndarray
    components: np.ndarray
    deviation: np.ndarray
    weight: np.ndarray
    whiten: np.ndarray
    usual: np.ndarray
    known: np.ndarray
    limits: np.ndarray
    rate: np.ndarray
    least: np.ndarray
    low: np.ndarray
    high: np.ndarray
    lighter: int
    near: float
    blind: float
    simulated: bool = False
    starts: np.ndarray = field(default_factory=lambda: np.ones(5))
    _project: np.ndarray = field(init=False, repr=False, compare=False)
    _modes: np.ndarray = field(init=False, repr=False, compare=False)
    _apart: np.ndarray = field(init=False, repr=False, compare=False)
    _near: tuple[KDTree, KDTree] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        camera, modes = np.linalg.pinv(self.motions).T, self.components * self.deviation[:, None]
        lead, labelled = self.deviation[: self.known.shape[1]], len(self.known) - self.lighter
        vars(self).update(
            _project=np.concatenate([camera, self.components / self.deviation[:, None]]).T.copy(),
            _modes=np.concatenate([self.motions, modes]),
            _apart=_apart(self.motions, modes),
            _near=(KDTree(self.known), KDTree(self.known[:labelled] * lead)),
        )

    def __call__(self, moved: FloatArray, lost: BoolArray | None = None) -> Strangeness:
        """The strangeness of one frame, from its pins' displacements (N, 2) in mean rest spacings; ``lost`` (N,) pins are not used."""
        if lost is None or not lost.any():
            return self._measure(moved.ravel())
        filled, unsure = self.fill_lost(moved, lost)
        found = self._measure(filled.ravel())
        return replace(found, unknown=found.unknown + max(unsure - self.blind, 0.0))

    def assess(self, moved: FloatArray, lost: BoolArray, reference: Reference, *, corrects: bool = True) -> DomainVerdict:
        """Whether a frame can be estimated, from its pins' displacements (N, 2) in mean rest spacings.

        Parameters
        ----------
        lost : (N,) bool
        reference : Reference
            The pins at rest, for words in px.
        corrects : bool
            Whether motions of the camera can be removed from what the model sees.
        """
        found = self(moved, lost)
        share = min(max((float(found.parts[4]) - REMOVED[0]) / (REMOVED[1] - REMOVED[0]), 0.0), 1.0)
        strange = float((np.minimum(found.parts, UNREMOVED) / self.starts).max())
        removable = share < 1 or (corrects and bool((np.abs(found.camera) <= CORRECTED).all()))
        if not removable or (found.parts[:4] > REFUSED - share * (REFUSED - IN_PLACE)).any():
            return DomainVerdict(self._why(found, moved, lost, reference))
        notes = []
        if strange > 1:
            notes.append(f"the pins' pattern is {strange:.1f} times as far from the training frames as they are from each other")
        unknown = found.unknown
        if share > 0:
            notes.append("the camera is slightly displaced; its displacement was removed from the pins")
            unknown += float(share * DOUBT * np.abs(found.camera) @ np.sqrt((self.motions**2).mean(axis=1)))
        if found.unknown > 0:
            notes.append("no training frame of known label is near")
        factor = (1 + GROWS * max(strange - 1, 0)) * (1 + (OFF_PLACE - 1) * share)
        wider = tuple(f"{note}: intervals are wider" for note in notes)
        return DomainVerdict("", factor, self.rate * unknown, wider, share * found.camera)

    def starting_at(self, moved: FloatArray, lost: BoolArray) -> "Domain":
        """The domain whose intervals grow from where frames end that determined their widths, but were left out of its fit.

        A domain of several kinds of contact has the limits of the widest kind. Intervals that were determined by another kind say nothing
        about frames that only the widest one contains.

        Parameters
        ----------
        moved : (M, N, 2) float
            Displacements of the pins, in mean rest spacings.
        lost : (M, N) bool
        """
        parts = np.array([self(*each).parts for each in zip(moved, lost, strict=True)])
        usual = np.quantile(parts, 1 - ALLOWED / parts.shape[1], axis=0)  # together they leave out ALLOWED
        return replace(self, starts=np.where(FROM_NOISE, 1.0, np.minimum(ROOM * usual, 1.0)))

    def common_camera(self, moved: FloatArray) -> tuple[FloatArray, float]:
        """What contacts (M, N, 2), in mean rest spacings, say about the camera that took all of them.

        Returns
        -------
        motions : (4,) float
            Their median motion of the camera, see ``Strangeness``; zero within the limits.
        usual : float
            Share of the contacts that are usual but for the camera's motion.
        """
        found = [self(each) for each in moved]
        motions = np.median([each.camera for each in found], axis=0)
        usual = float(np.mean([(each.parts[:4] <= USUAL).all() for each in found]))
        return np.where((np.abs(motions) > self.limits[7:]).any(), motions, 0.0), usual

    def without_camera(self, nodes_px: FloatArray, area_px2: FloatArray, camera: FloatArray, spacing_px: float) -> tuple:
        """Pins (N, 2) and areas (N,) without motions (4,) of the camera."""
        return nodes_px - spacing_px * (camera @ self.motions).reshape(-1, 2), area_px2 * np.exp(-2 * camera[3])

    def outside_range(self, value: FloatArray, names: Sequence[str], units: Sequence[str]) -> tuple[str, FloatArray]:
        """Why estimates (K,) lie too far outside the trained ranges ("" if they do not), and how far they lie outside (K,)."""
        excess = np.maximum(np.maximum(self.low - value, value - self.high), 0.0)
        free = np.array([unit == "deg" for unit in units]) & (self.high - self.low > HALF_CIRCLE_DEG)
        excess = np.where(free, 0.0, excess)
        k = int(np.argmax(excess / np.maximum(self.high - self.low, 1e-9)))
        if excess[k] <= BEYOND_RANGE * (self.high[k] - self.low[k]):
            return "", excess
        trained = f"trained from {self.low[k]:.3g} to {self.high[k]:.3g} {units[k]}".rstrip()
        return f"outside the trained range: {readable_labels(names)[k]} {value[k]:.3g} {units[k]}, {trained}", excess

    def _why(self, found: Strangeness, moved: FloatArray, lost: BoolArray, reference: Reference) -> str:
        """The most probable cause of a strange frame, in words."""
        spacing_px = reference.spacing_px.mean()
        left, similarity = align(reference.pins_px[None] + moved * spacing_px, reference.pins_px)
        straight = self(left[0] / spacing_px, lost)  # without the similarity exactly, because the motions are those of small turns
        again = "take a new frame without contact with the present view (init_0.png beside recorded frames)"
        if any((each.parts[:4] <= REFUSED).all() for each in (found, straight)):
            scale, turn, *shift = similarity[0]
            return (
                f"displaced camera: the view is shifted by ({shift[0]:.1f}, {shift[1]:.1f}) px, turned by {np.degrees(turn):.1f} deg "
                f"and {np.exp(scale):.3f} times as large as at rest, more than a contact does; {again}"
            )
        share, place, axis, step = self._find_tear(moved, lost, reference)
        smooth, stretch = self._smooth(moved, lost, reference)
        if share > EXPLAINS and share > smooth + TORN_MORE * (1 - smooth):
            side = ("right of x" if axis == 0 else "below y") + f" = {place:.0f} px"
            by = f"({spacing_px * step[0]:.1f}, {spacing_px * step[1]:.1f}) px"
            return f"torn frame: {side} the picture is displaced by {by}; check the camera's cable and rate"
        if smooth > EXPLAINS:
            return (
                f"displaced camera: the view is stretched by {200 * np.hypot(*stretch):.1f} %, or seen through another lens or at another "
                "angle than at rest; check the picture's size and the camera's mount, then " + again
            )
        far = f"{found.parts[:4].max():.1f} times as far from the training frames as they are from each other"
        return (
            f"not a contact that the model knows: the pins' pattern is {far}; another object or another sensor's frame, a turned or "
            "mirrored picture, or pins with wrong names"
        )

    def _explain_misfit(self, moved: FloatArray, lost: BoolArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Share of a frame's improbability that each of S sets of further motions explains, and their amplitudes.

        The improbability is u' P u, with the inverse covariance P of displacements: components of their deviations, any motion of the
        camera, and noise. With further motions h (k, 2N) it is less by (h P u)' (h P h')^-1 (h P u).

        Parameters
        ----------
        columns : (S, k, 2N) float

        Returns
        -------
        (S,) float, (S, k) float
        """
        known = np.repeat(~lost, 2)
        modes, inner = self._known_modes(known)
        away = (moved.ravel() - self.mean)[known]

        def probable(x: FloatArray) -> FloatArray:
            return (x - np.linalg.solve(inner, modes @ x.T).T @ modes) / NOISE**2

        within = columns[..., known]
        weighted = probable(within.reshape(-1, within.shape[-1])).reshape(within.shape)
        force = weighted @ away
        stiff = np.einsum("ski,sli->skl", weighted, within) + 1e-9 * np.eye(within.shape[1])
        step = np.linalg.solve(stiff, force[..., None])[..., 0]
        whole = float(away @ probable(away[None])[0])
        return (force * step).sum(axis=1) / max(whole, 1e-12), step

    def _find_tear(self, moved: FloatArray, lost: BoolArray, reference: Reference) -> tuple[float, float, int, FloatArray]:
        """The tear that explains most: its share, its place (px), the axis across it, and the displacement (2,) beyond it in spacings."""
        at, shares = reference.pins_px, np.linspace(0.05, 0.95, SPLITS)
        cuts = [(float(place), axis) for axis in (1, 0) for place in np.quantile(at[:, axis], shares)]
        sets = [[np.outer(at[:, axis] > place, along).ravel() for along in np.eye(2)] for place, axis in cuts]
        share, step = self._explain_misfit(moved, lost, np.array(sets))
        best = int(np.argmax(share))
        return float(share[best]), *cuts[best], step[best]

    def _smooth(self, moved: FloatArray, lost: BoolArray, reference: Reference) -> tuple[float, FloatArray]:
        """Share that a stretch, tilt or distortion of the view explains, and the stretch (2,)."""
        x, y = _places(reference).T
        size = float(np.abs(_places(reference)).max())
        fields_xy = [(x, -y), (y, x), (x * x / size, x * y / size), (x * y / size, y * y / size)]
        fields_xy.append((x * (x * x + y * y) / size**2, y * (x * x + y * y) / size**2))
        share, step = self._explain_misfit(moved, lost, np.array([[np.column_stack(each).ravel() for each in fields_xy]]))
        return float(share[0]), step[0, :2]

    def _measure(self, flat: FloatArray) -> Strangeness:
        away = flat - self.mean
        seen = away @ self._project
        left = away - seen @ self._modes
        camera, a = seen[:4], np.minimum(np.maximum(seen[4:], -FARTHEST), FARTHEST)
        lead = self.known.shape[1]
        first = a[:lead]
        ample = max(float(first @ first / lead) ** 0.5, 1.0)  # what is left grows with the contact
        expected = _terms(first) @ self.weight
        ends = len(a) - lead, len(a) - lead + 4
        further, of_camera, of_parts = expected[: ends[0]], expected[ends[0] : ends[1]], expected[ends[1] :]
        camera = camera - of_camera
        wrong = (a[lead:] - further) / self.usual
        apart = self.whiten @ ((away - seen[:4] @ self.motions) @ self._apart - of_parts)
        sizes = _sizes(len(a))
        uneven = np.sqrt(np.add.reduceat(apart * apart, np.cumsum(sizes) - sizes) / sizes) / ample
        misfit = float(wrong @ wrong / max(len(wrong), 1)) ** 0.5 / ample
        outside = float(left @ left / len(flat)) ** 0.5 / ample
        moved_by = float((np.abs(camera) / self.limits[7:]).max()) / ample
        parts = np.array([outside, misfit, self._near[0].query(first)[0], (uneven / self.limits[3:7]).max(), moved_by])
        parts[:3] /= self.limits[:3]
        unknown = self._near[1].query(first * self.deviation[:lead])[0] / len(flat) ** 0.5 - self.near
        return Strangeness(parts, camera, max(unknown, 0.0), uneven, ample)

    def fill_lost(self, moved: FloatArray, lost: BoolArray) -> tuple[FloatArray, float]:
        """Displacements (N, 2) in which ``lost`` pins are the most probable ones, and the rms of what is not known of all coordinates."""
        known = np.repeat(~lost, 2)
        part, inner = self._known_modes(known)
        found = np.linalg.solve(inner, part @ (moved.ravel() - self.mean)[known])
        spread_out = np.linalg.cholesky(np.linalg.inv(inner) * NOISE**2).T @ self._modes[:, ~known]
        whole = np.where(known, moved.ravel(), self.mean + found @ self._modes).reshape(moved.shape)
        return whole, float(np.sqrt((spread_out**2).sum() / len(known)))

    def _known_modes(self, known: BoolArray) -> tuple[FloatArray, FloatArray]:
        """The modes in the ``known`` coordinates (2N,), and NOISE^2 times the precision of their amplitudes given these coordinates.

        Modes are the camera's motions, then the components in standard deviations.
        """
        modes = self._modes[:, known]
        return modes, modes @ modes.T + NOISE**2 * np.diag(np.concatenate([np.full(4, 1e-9), np.ones(len(self.deviation))]))


def _terms(a: np.ndarray) -> np.ndarray:
    """Terms (..., T) of the polynomial in the leading components (..., L): 1, each, products of two, and of three of the first few."""
    (i, j), (k, m, n) = _products(a.shape[-1])
    return np.concatenate([np.ones((*a.shape[:-1], 1)), a, a[..., i] * a[..., j], a[..., k] * a[..., m] * a[..., n]], axis=-1)


@cache
def _products(lead: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices (2, t) and (3, t) of the factors of the products in ``_terms``."""
    pairs, triples = (list(combinations_with_replacement(range(n), degree)) for n, degree in ((lead, 2), (min(lead, CUBED), 3)))
    return np.array(pairs, int).reshape(-1, 2).T, np.array(triples, int).reshape(-1, 3).T


def learn_domain(
    moved: np.ndarray,
    labels: np.ndarray,
    reference: Reference,
    units: Sequence[str],
    *,
    least: np.ndarray,
    lost: np.ndarray | None = None,
    group: np.ndarray | None = None,
    simulated: bool = False,
    seed: int = 0,
) -> Domain | None:
    """Learn the domain from a model's training frames; None for fewer than ``FEWEST`` frames with labels, or fewer than 6 groups of them.

    Parameters
    ----------
    moved : (M, N, 2) float
        Displacements of the pins from rest, in mean rest spacings.
    labels : (M, K) float
        Labels, mm and deg; NaN in frames whose labels are not known, or that show no contact.
    reference : Reference
        Pins at rest in training.
    units : sequence of str
        The labels' units.
    least : (K,) float
        See ``Domain``.
    lost : (M, N) bool, optional
        Pins that were not found.
    group : (M,) array, optional
        Frames with the same value are left out of a fit together.
    simulated : bool
        See ``Domain``.
    """
    labelled = np.isfinite(labels).all(axis=1)
    names, of_row = np.unique(np.arange(len(moved)) if group is None else group, return_inverse=True)
    if labelled.sum() < FEWEST or len(np.unique(of_row.ravel()[labelled])) <= FOLDS:
        return None
    rng = np.random.default_rng([seed, 7])
    flat = moved.reshape(len(moved), -1)
    part = rng.permutation(np.arange(len(names)) % FOLDS)[of_row.ravel()]
    motions = _motions(reference)
    measures = np.full((len(flat), 12), np.nan)
    for fold in range(FOLDS):
        here = part == fold
        one = _fit_changes(flat[~here], labelled[~here], motions, rng)
        strange = (one(each) for each in moved[here])
        measures[here] = [[*each.parts[:3], *each.uneven, *(np.abs(each.camera) / each.ample), each.unknown] for each in strange]
    fitted = _fit_changes(flat, labelled, motions, rng)
    limits = np.quantile(measures[:, :-1], 1 - ALLOWED, axis=0)
    limits[3:7] *= np.clip(limits[3:7] / EVEN, 1.0, 1.3)
    floors = np.array([OUTSIDE, *[1.0] * 6, SHIFT, SHIFT, np.radians(TURN_DEG), SCALE])
    lost = np.zeros(moved.shape[:2], bool) if lost is None else lost
    unsure = [fitted.fill_lost(moved[k], lost[k])[1] if lost[k].any() else 0.0 for k in spread_indices(len(moved), LOST_FRAMES)]
    near, blind = (float(np.quantile(values, USUAL_DISTANCE)) for values in (measures[labelled, -1], unsure))
    low, high = np.quantile(labels[labelled], (1 - IN_RANGE, IN_RANGE), axis=0)
    rate = _rates(fitted, flat[labelled], labels[labelled], units, rng)
    found = replace(fitted, limits=np.maximum(limits, floors), near=near, blind=blind, simulated=simulated)
    return replace(found, rate=rate, least=least, low=low, high=high)


def _fit_changes(flat: np.ndarray, labelled: np.ndarray, motions: np.ndarray, rng: np.random.Generator) -> Domain:
    """A domain with limits of 1, for displacements (M, 2N); rows that are not ``labelled`` (M,) have no known label."""
    chosen = spread_indices(len(flat), MOST_FRAMES)
    flat, labelled = flat[chosen], labelled[chosen]
    reduced = rng.choice(len(flat), int(LIGHTER * len(flat)), replace=False)
    light = flat[reduced] * rng.uniform(0, 1, (len(reduced), 1))
    every = np.concatenate([flat, light])
    mean = every.mean(axis=0)
    camera = np.linalg.pinv(motions)
    rest = (every - mean) - ((every - mean) @ camera) @ motions
    square, turned = np.linalg.eigh(rest.T @ rest / len(rest))
    most = int(np.clip(len(flat) // PER_TERM, 2, MODES))
    deviation = np.sqrt(np.maximum(square[::-1][:most], 0))
    keep = deviation > LEAST_DEVIATION * deviation[0]
    components, deviation = turned[:, ::-1][:, :most].T[keep], deviation[keep]
    a = (rest @ components.T) / deviation
    lead = next((n for n in range(min(LEADING, len(deviation)), 1, -1) if _terms(np.zeros((1, n))).shape[1] * PER_TERM <= len(every)), 1)
    terms = _terms(a[:, :lead])
    apart = rest @ _apart(motions, components * deviation[:, None])
    wanted = np.concatenate([a[:, lead:], (every - mean) @ camera, apart], axis=1)
    weight = np.linalg.solve(terms.T @ terms + RIDGE * len(terms) * np.eye(terms.shape[1]), terms.T @ wanted)
    left = wanted - terms @ weight
    further = len(deviation) - lead
    usual = np.maximum(np.sqrt((left[:, :further] ** 2).mean(axis=0)), NOISE / deviation[lead:])
    whiten = block_diag(*map(_whitening, np.split(left[:, further + 4 :], np.cumsum(_sizes(len(deviation)))[:-1], axis=1)))
    rows = np.flatnonzero(labelled)
    rows = np.sort(rng.permutation(rows)[:KNOWN])
    dim = np.sort(rng.permutation(np.concatenate([np.flatnonzero(~labelled), np.arange(len(flat), len(every))]))[: KNOWN // 2])
    known = np.concatenate([a[rows, :lead], a[dim, :lead], (-mean @ components.T / deviation)[None, :lead]])
    none = np.zeros(0)
    given = motions, mean, components, deviation, weight, whiten, usual, known, np.ones(11)
    return Domain(*given, none, none, none, none, len(dim) + 1, 0.0, 0.0)


def _places(reference: Reference) -> FloatArray:
    """Places (N, 2) of the pins at rest about their middle, in mean spacings."""
    return (reference.pins_px - reference.pins_px.mean(axis=0)) / reference.spacing_px.mean()


def _motions(reference: Reference) -> np.ndarray:
    """Displacements (4, 2N), spacings, by the camera: see ``Domain``. A turn and a scale act about the middle of the pins."""
    x, y = _places(reference).T
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.column_stack(pair).ravel() for pair in ((one, none), (none, one), (-y, x), (x, y))])


def _sizes(components: int) -> np.ndarray:
    """Number of components that are compared for each of ``PARTS``, of so many."""
    return np.array([components, *[min(COMPARED, components)] * (len(PARTS) - 1)])


def _apart(motions: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Map (2N, P) from displacements to the differences of the components, in standard deviations, by each of ``PARTS`` and by the others.

    Parts are those of the pins at rest; by each, the components are the most probable ones with the noise ``NOISE``.
    """
    at = (motions[3, 0::2], -motions[2, 0::2])  # a scale moves a pin along x by x, a turn by -y
    found = []
    for (axis, share), size in zip(PARTS, _sizes(len(modes)), strict=True):
        first = np.repeat(at[axis] <= np.quantile(at[axis], share), 2)
        map_ = np.zeros((len(first), size))
        for half, sign in ((first, -1.0), (~first, 1.0)):
            part = modes[:, half]
            map_[half] = sign * np.linalg.solve(part @ part.T + NOISE**2 * np.eye(len(part)), part).T[:, :size]
        found.append(map_)
    return np.concatenate(found, axis=1)


def _whitening(left: np.ndarray) -> np.ndarray:
    """Inverse square root (D, D) of the covariance of differences (M, D)."""
    square = np.atleast_2d(np.cov(left.T))
    return np.linalg.inv(np.linalg.cholesky(square + WHITE * np.diag(np.diag(square)) + 1e-12 * np.eye(len(square))))


def _rates(found: Domain, flat: np.ndarray, labels: np.ndarray, units: Sequence[str], rng: np.random.Generator) -> np.ndarray:
    """Rate (K,) of each label between neighbouring frames."""
    rows = np.sort(rng.permutation(len(flat))[:KNOWN])
    lead = found.known.shape[1]
    a = ((flat[rows] - found.mean) @ found._project)[:, 4 : 4 + lead] * found.deviation[:lead] / np.sqrt(flat.shape[1])
    apart, near = KDTree(a).query(a, NEIGHBOURS + 1)  # the frame itself is the nearest
    change = np.abs(label_error(labels[rows][:, None], labels[rows][near], units))
    return np.quantile((change / np.maximum(apart, 1e-9)[..., None])[apart > 0], SURE_RATE, axis=0)


def domain_arrays(domain: Domain) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """A domain as arrays and numbers for a file; components and known frames in half precision."""
    arrays = {each.name: getattr(domain, each.name) for each in fields(Domain) if each.init}
    about = {name: arrays.pop(name) for name in NUMBERS}
    half = ("components", "known", "weight", "whiten")
    return {key: array.astype(np.float16 if key in half else np.float32) for key, array in arrays.items()}, about


def domain_of(arrays: Mapping[str, np.ndarray], about: Mapping[str, Any], pins: int, labels: int) -> Domain:
    """The domain that ``domain_arrays`` turned into arrays, of a model for so many ``pins`` and ``labels``.

    Raises
    ------
    ValueError
        It belongs to other pins or labels.
    """
    values: dict[str, Any] = {name: array.astype(float) for name, array in arrays.items()}
    found = Domain(**values | {name: kind(about[name]) for name, kind in NUMBERS.items() if name in about})
    if found.mean.shape != (2 * pins,) or found.rate.shape != (labels,):
        raise ValueError("of other pins or labels")
    return found


def write_domain(path: Path, domain: Domain) -> None:
    """Write a domain in the form that ``read_domain`` reads."""
    FILE.write(path, *domain_arrays(domain))


def read_domain(path: Path, pins: int, labels: int) -> Domain:
    """Read the domain that ``write_domain`` wrote, of a model for so many ``pins`` and ``labels``.

    Raises
    ------
    TrainingError
        The file can't be read, is damaged, or belongs to another sensor or model.
    """
    with FILE.open_arrays(path) as (about, arrays):
        return domain_of(arrays, about, pins, labels)
