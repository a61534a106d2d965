"""The twin's displacements as a smooth function of pose and move.

A displacement is written in waves (``training.models.steered.model``). Where one label is a direction c that goes round the whole circle,
an edge's, the waves are turned back by c. They are then those that the object's own frame sees, and change little with c. One Gaussian
process of the labels that vary, of cos c and sin c, and of the moves limited by friction, gives all waves. Its lengths maximise the
likelihood of the leading components of the waves.

``Missed`` is the discrepancy between these waves and real ones, fitted to labelled frames, and ``Left`` the covariance of what is left.

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

from training.data.audit import LabelColumns, polynomials
from training.models.steered.model import waves_of
from training.runs.gaussian_process import CONSTANT_AND_SMOOTH, SMOOTH_AND_LINEAR, Kernel, Points, climb_likelihood

MOST_STATES = 5000
"""Simulated states that the process learns from. The cost grows with the third power of their number; a sheared contact needs thousands."""
FITTED = 400
"""States on which lengths, sizes and noise are fitted."""
LEADING = 3
"""Components of the waves by which they are fitted; they hold most of the displacement."""
NEGLIGIBLE = 1e-4
"""Share of the fitted displacements' variance that is left out. It is below the noise of the pins."""
LEAST_NOISE_PX = 1e-3
"""Smallest standard deviation of the pins' noise, px, so that pins without any noise can be used."""
AT_ONCE = 1000
"""Contacts whose waves are computed at once, so that the covariance of many contacts with all states does not fill the memory."""
LEAST_RANGE = 1e-9
"""mm or deg by which a label varies."""
MOVES_FROM = 6
"""First column of the moves among the labels."""
SLIPS_AT = 0.4
"""Size of a move, in half ranges, from which the skin slips and its pins hardly move any further."""
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


class TwinField:
    """Waves of simulated displacements by pose and move.

    Parameters
    ----------
    moved_px : (S, N, 2) float
        Simulated displacements.
    known : (S, 12) float
        Pose and executed move of each, mm and deg.
    rest_px : (N, 2) float
        The pins at rest.
    seed : int
        Chooses the states for the training.

    Attributes
    ----------
    known : (s, 12) float
        Of the states for the training.
    direction : int or None
        The column of ``known`` that goes round the whole circle.
    varied : (V,) int
        The other columns that vary.
    middle, half : (12,) float
        Middle and half width of the columns' ranges.
    order : (C,) int
        How many times each wave turns when the contact turns once.
    """

    def __init__(self, moved_px: np.ndarray, known: np.ndarray, rest_px: np.ndarray, *, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.permutation(len(known))[:MOST_STATES])
        self.known = known[rows]
        low, high = self.known.min(axis=0), self.known.max(axis=0)
        self.direction = LabelColumns.of(self.known[:, :6], self.known[:, 6:]).direction
        self.varied = np.array([k for k in range(12) if high[k] - low[k] > LEAST_RANGE and k != self.direction], int)
        self.middle, self.half = (low + high) / 2, np.maximum(high - low, LEAST_RANGE) / 2
        waves = waves_of(rest_px)
        self.order, self._fit = waves.order, waves.fit
        seen, self._sense = self.waves(moved_px[rows]), 1
        alike = {}
        for self._sense in (1, -1):  # in the picture a contact turns one way or the other as its direction's label grows
            alike[self._sense] = float((np.abs((seen * self.turn_factors(self.known, back=True)).mean(axis=0)) ** 2)[self.order != 0].sum())
        self._sense = max(alike, key=lambda sense: alike[sense])
        own = seen * self.turn_factors(self.known, back=True)
        self._mean = own.mean(axis=0)
        left = parts(own - self._mean)
        self._points = Points.of(self._inputs(self.known))
        self._kernel = _likeliest(self._points, left, rng)
        weight = np.linalg.solve(self._kernel.noisy(self._points), left)
        # The fitted displacements need few components: what else the simulated ones have is the noise of their simulation.
        _, sizes, components = np.linalg.svd(self._kernel(self._points, self._points) @ weight, full_matrices=False)
        rest = np.cumsum(sizes[::-1] ** 2)[::-1]
        self._components = components[: int((rest > NEGLIGIBLE * rest[0]).sum())]
        self._weight = weight @ self._components.T

    def own(self, known: np.ndarray) -> np.ndarray:
        """Expected waves (B, C) of contacts (B, 12) in the object's frame."""
        if len(known) > AT_ONCE:
            return np.concatenate([self.own(known[first : first + AT_ONCE]) for first in range(0, len(known), AT_ONCE)])
        near = self._kernel(Points.of(self._inputs(known)), self._points)
        real, imaginary = np.split(near @ self._weight @ self._components, 2, axis=1)
        return self._mean + real + 1j * imaginary

    def waves(self, moved_px: np.ndarray) -> np.ndarray:
        """Waves (B, C) of displacements (B, N, 2)."""
        return (moved_px @ [1, 1j]) @ self._fit.T

    def noise(self, moved_px: np.ndarray) -> np.ndarray:
        """(2C, 2C) covariance, as ``parts``, of the waves by the noise of pins, in the object's frame.

        The noise is estimated from the part of displacements (B, N, 2) that no wave describes. Where a label is a direction, the covariance
        is the mean over all directions: waves that turn differently are independent.
        """
        count, pins = self._fit.shape
        beside = moved_px @ [1, 1j] - self.waves(moved_px) @ np.linalg.pinv(self._fit).T
        variance = max(float((np.abs(beside) ** 2).mean()) / 2 * pins / max(pins - count, 1), LEAST_NOISE_PX**2)
        shared = variance * self._fit @ self._fit.conj().T
        if self.direction is not None:
            shared = np.where(self.order[:, None] == self.order, shared, 0)
        return np.block([[shared.real, -shared.imag], [shared.imag, shared.real]])

    def turn_factors(self, known: np.ndarray, *, back: bool = False) -> np.ndarray:
        """Factors of the waves from the object's frame to the sensor's, or ``back``: (B, C), or (B, 1) ones if there is no direction."""
        if self.direction is None:
            return np.ones((len(known), 1))
        angle = self._sense * np.radians(known[:, self.direction])[:, None]
        return np.exp((-1j if back else 1j) * angle * self.order)

    def scale_labels(self, known: np.ndarray) -> np.ndarray:
        """The varied labels (B, V), from -1 to 1 over their ranges."""
        return (known[:, self.varied] - self.middle[self.varied]) / self.half[self.varied]

    def scale_moves(self, known: np.ndarray) -> np.ndarray:
        """As ``scale_labels``, with moves m as m / sqrt(m0^2 + |m|^2), m0 = ``SLIPS_AT``.

        A move beyond the limit of friction changes the pins by its direction alone.
        """
        found, moves = self.scale_labels(known), self.varied >= MOVES_FROM
        found[:, moves] /= np.sqrt(SLIPS_AT**2 + (found[:, moves] ** 2).sum(axis=1, keepdims=True))
        return found

    def around(self, known: np.ndarray) -> np.ndarray:
        """Cosine and sine of the direction (B, 2), or (B, 0) if there is none."""
        angle = np.radians(known[:, [] if self.direction is None else [self.direction]])
        return np.hstack([np.cos(angle), np.sin(angle)])

    def _inputs(self, known: np.ndarray) -> np.ndarray:
        """Inputs of the process: labels, the moves also as they slip, and cosine and sine of a direction."""
        return np.hstack([self.scale_labels(known), self.scale_moves(known)[:, self.varied >= MOVES_FROM], self.around(known)])


def parts(waves: np.ndarray) -> np.ndarray:
    """Waves (B, C) as real numbers (B, 2C)."""
    return np.concatenate([waves.real, waves.imag], axis=-1)


def _likeliest(points: Points, outputs: np.ndarray, rng: np.random.Generator) -> Kernel:
    """One kernel for all outputs (s, D): the mean, in logarithms, of those of their leading components, by their sizes."""
    left, sizes, _ = np.linalg.svd(outputs, full_matrices=False)
    rows = rng.permutation(len(points))[:FITTED]
    start = Kernel(SMOOTH_AND_LINEAR, np.full(points.inputs.shape[1], 1.5), np.array([1.0, 0.3]), np.array([0.1]))
    leading, points = left[rows] * np.sqrt(len(left)), points.rows(rows)
    fitted = [climb_likelihood(start, points, component).logs() for component in leading.T[:LEADING]]
    return start.with_logs(np.average(fitted, axis=0, weights=sizes[: len(fitted)] ** 2))


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


def _covariance(constant: float, size: float, lengths: np.ndarray, here: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Covariance (A, B) of rows (A, V) and (B, V), for a constant and a smooth function with these variances."""
    kernel = Kernel(CONSTANT_AND_SMOOTH, lengths, np.sqrt([constant, size]), np.zeros(1))
    return kernel(Points.of(here), Points.of(there))


def _amplitude(seen: np.ndarray) -> np.ndarray:
    """(B,) size of waves (B, C)."""
    return np.asarray(np.sqrt((np.abs(seen) ** 2).sum(axis=1)))
