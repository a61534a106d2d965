"""The discrepancy between a twin's waves and real ones, fitted to labelled frames, and the covariance of what is left.

The discrepancy has two parts, and each is a Gaussian process of the labels. The first part stands in the object's frame: it is the error of
the mechanics and of the object's shape, and the same all around an edge. The second part stands in the sensor's frame: it is the error of
the camera and of the pins at rest. It exists only where a label is a direction; elsewhere the two frames are the same.

With the labels a, b scaled to -1..1, their moves limited by friction (``TwinField.slipped``), and the angle c between two directions, the
covariances of the two parts are

    object's frame    s_0 + q(a).q(b) + s_1 exp(-|a - b|^2 / 2 r_1^2)      q: the labels and their products of degree 2
    sensor's frame    s_2 + s_3 exp(-|a - b|^2 / 2 r_3^2) exp(cos c - 1)

in units of the variance of one frame's residual. exp(cos c - 1) is a squared exponential, of length 1, in cosine and sine of the
direction. The number of labelled frames is small, therefore these sizes are fixed. Errors change little when they are halved or doubled.

What is left has the covariance N + g D of a frame whose pins move by the amplitude A. N is the noise of the pins. g = 0.1 + 0.9 A / A_m
grows with the amplitude, because the discrepancy of a deep contact is larger than that of a shallow one; A_m is the median of the labelled
frames. D is estimated from the residuals of the labelled frames, each predicted from the others, and shrunk towards ``EXPECTED`` N.
"""

import numpy as np

from training.data.audit import polynomials
from training.runs.gaussian_process import CONSTANT_AND_SMOOTH, Kernel, Points
from training.studies.sim_to_real.field import TwinField, parts

CONSTANT = 10 / 3
"""Size s_0 of the constant in the object's frame where a label is a direction."""
FREE = 1e3
"""Size of a constant that is nearly free: s_0 where no label is a direction, and s_2."""
OWN_SIZE = 2.0
"""Size s_1."""
OWN_LENGTH = 0.8
"""Length r_1, in half ranges of the labels."""
SEEN_SIZE = 1.0
"""Size s_3."""
SEEN_LENGTH = 0.5
"""Length r_3, in half ranges of the labels."""
MOST_FRAMES = 1000
"""Most frames with labels, and most without, that the discrepancy is learnt from. The cost grows with the third power of their number."""
NOISE_FRAMES = 150.0
"""Weight of the expected covariance, as a number of labelled frames."""
EXPECTED = 0.5
"""Expected D before any labelled frame, as a multiple of the pins' noise."""
LEAST = 0.02
"""Smallest eigenvalue of D, as a multiple of the pins' noise."""
SHALLOW = 0.1
"""Factor g of a frame whose pins do not move."""
ROUNDS = 3
"""Number of times that D is estimated. Each round weighs the frames by the D of the round before."""


class Missed:
    """The discrepancy of a twin, by n labelled frames.

    Parameters
    ----------
    field : TwinField
    known : (n, 12) float
        Labels of the frames.
    seen : (n, C) complex
        Their waves.
    noisier : (n,) float
        Variance of each frame's residual, as a multiple of that of a labelled frame.

    Attributes
    ----------
    left : (n, C) complex
        Residual of each frame in the object's frame, predicted from the other frames.
    """

    def __init__(self, field: TwinField, known: np.ndarray, seen: np.ndarray, noisier: np.ndarray) -> None:
        self._field, self._known, self._turns = field, known, field.direction is not None
        turn = field.turn_factors(known, back=True) * np.ones(seen.shape)
        residual = seen * turn - field.own(known)
        own, there = self._own(known) + np.diag(noisier), self._sensor_covariance(known) if self._turns else 0.0
        self._weight, self.left = np.empty_like(residual), np.empty_like(residual)
        order = field.order if self._turns else np.zeros_like(field.order)  # waves of one order turn alike
        for alike in (order == each for each in np.unique(order)):
            covariance = own
            if self._turns:
                phase = turn[:, np.flatnonzero(alike)[0]]
                covariance = own + there * np.outer(phase, phase.conj())
            inverse = np.linalg.inv(covariance)
            self._weight[:, alike] = inverse @ residual[:, alike]
            self.left[:, alike] = self._weight[:, alike] / np.diag(inverse).real[:, None]
        self._turned_weight = self._weight * turn.conj()

    def __call__(self, known: np.ndarray) -> np.ndarray:
        """The discrepancy (B, C) of contacts (B, 12), in the object's frame."""
        found = self._own(known) @ self._weight
        if self._turns:
            found = found + self._field.turn_factors(known, back=True) * (self._sensor_covariance(known) @ self._turned_weight)
        return np.asarray(found)

    def _own(self, known: np.ndarray) -> np.ndarray:
        """Covariance (B, n) in the object's frame."""
        here, there = self._field.scale_moves(known), self._field.scale_moves(self._known)
        bent: np.ndarray = polynomials(here, 2)[:, 1:] @ polynomials(there, 2)[:, 1:].T
        lengths = np.full(here.shape[1], OWN_LENGTH)
        return bent + _covariance(CONSTANT if self._turns else FREE, OWN_SIZE, lengths, here, there)

    def _sensor_covariance(self, known: np.ndarray) -> np.ndarray:
        """Covariance (B, n) in the sensor's frame, where a label is a direction."""
        here, there = (np.hstack([self._field.scale_moves(each), self._field.around(each)]) for each in (known, self._known))
        lengths = np.r_[np.full(here.shape[1] - 2, SEEN_LENGTH), 1.0, 1.0]
        return _covariance(FREE, SEEN_SIZE, lengths, here, there)


class Left:
    """Covariance of what is left of frames, in the object's frame.

    Parameters
    ----------
    left : (n, C) complex
        See ``Missed.left``.
    seen : (n, C) complex
        Waves of these frames.
    noise : (2C, 2C) float
        Covariance of the pins' noise in the object's frame, as ``parts``.
    """

    def __init__(self, left: np.ndarray, seen: np.ndarray, noise: np.ndarray) -> None:
        self._size = float(np.median(_amplitude(seen))) if len(seen) else None
        white = np.linalg.inv(np.linalg.cholesky(noise)).T
        residual, grown = parts(left) @ white, self._growth_factor(seen)
        expected = EXPECTED * np.eye(len(noise))
        spread = expected
        for _ in range(ROUNDS if len(seen) else 0):
            weight = (grown / (1 + grown * np.trace(spread) / len(spread))) ** 2
            weight *= len(weight) / weight.sum()
            share = weight / grown
            beside = (residual.T * share) @ residual - share.sum() * np.eye(len(spread))
            sizes, axes = np.linalg.eigh((beside + NOISE_FRAMES * expected) / (weight.sum() + NOISE_FRAMES))
            spread = (axes * np.maximum(sizes, LEAST)) @ axes.T
        self._sizes, axes = np.linalg.eigh(spread)
        self.axes: np.ndarray = white @ axes
        """(2C, 2C) Matrix that makes the components of a residual, as ``parts``, independent."""

    def weights(self, seen: np.ndarray) -> np.ndarray:
        """(B, 2C) reciprocal standard deviation of each component along ``axes``, for frames with waves (B, C)."""
        return np.asarray(1 / np.sqrt(1 + self._growth_factor(seen)[:, None] * self._sizes))

    def _growth_factor(self, seen: np.ndarray) -> np.ndarray:
        """(B,) factor g of D."""
        return np.ones(len(seen)) if not self._size else SHALLOW + (1 - SHALLOW) * _amplitude(seen) / self._size


def choose_evenly(count: int, most: int) -> np.ndarray:
    """At most ``most`` of ``count`` indices, evenly through their order."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def _covariance(constant: float, size: float, lengths: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Covariance (A, B) of rows (A, V) and (B, V), for a constant and a smooth function with these variances."""
    kernel = Kernel(CONSTANT_AND_SMOOTH, lengths, np.sqrt([constant, size]), np.zeros(1))
    return kernel(Points.of(here), Points.of(there))


def _amplitude(seen: np.ndarray) -> np.ndarray:
    """(B,) size of waves (B, C)."""
    return np.asarray(np.sqrt((np.abs(seen) ** 2).sum(axis=1)))
