"""Model of the possible displacements of the pins, fitted without labels, and the estimate of another unit's pins at rest from contacts.

A few numbers (depth, tilt, shear) determine nearly the whole displacement of the pins by a contact. With the leading principal
coordinates a (D,) of the displacements, in standard deviations, the displacement u (2N,) is

    u = mean + sum_k a_k scale_k mode_k + sum_j w_j(a) mode_(D + j) + what is left

where w are polynomials of the third degree. A unit whose pins at rest are not known shows p = r + u(a) in each frame. Its rest places r
(2N,) and all a are estimated together by least squares (Gauss-Newton). Because u is curved, this also determines the part of r that looks
like a contact, which no mean of the frames determines.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from training.errors import TrainingError
from training.runs.run_files import AGAIN
from twin.frames import spread_indices
from twin.pins import Reference
from twin.store import ArrayFile

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
    chosen = [list(term) for degree in range(2, DEGREE + 1) for term in combinations_with_replacement(range(a.shape[1]), degree)]
    return np.column_stack([np.ones(len(a)), *(np.prod(a[:, term], axis=1) for term in chosen)])


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
