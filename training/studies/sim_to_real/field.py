"""The twin's displacements as a smooth function of pose and move.

A displacement is written in waves (``training.models.steered.model``). Where one label is a direction c that goes round the whole circle,
an edge's, the waves are turned back by c. They are then those that the object's own frame sees, and change little with c. One Gaussian
process of the labels that vary, of cos c and sin c, and of the moves limited by friction, gives all waves. Its lengths maximise the
likelihood of the leading components of the waves.
"""

import numpy as np

from training.data.audit import LabelColumns
from training.models.steered.model import waves_of
from training.runs.gaussian_process import SMOOTH_AND_LINEAR, Kernel, Points, climb_likelihood

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
    fitted = [
        climb_likelihood(start, points.rows(rows), left[rows, k] * np.sqrt(len(left))).logs() for k in range(min(LEADING, len(sizes)))
    ]
    return start.with_logs(np.average(fitted, axis=0, weights=sizes[: len(fitted)] ** 2))
