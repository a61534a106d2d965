"""The twin read backwards: the labels whose simulated pins are most like a frame's.

With the waves d(l) of the twin's displacement at the labels l (``TwinField``), what the twin misses e(l), and S the covariance of what is
left on the labelled frames, each predicted from the others, the estimate is

    l = argmin (t - d(l) - e(l))' S^-1 (t - d(l) - e(l)) + |l - m|^2 / w^2

t are the waves of the frame, m and w the middle and the width of the ranges. It is found by Gauss-Newton steps from the nearest simulated
state. Moves are unknown, too, and found with the pose.

What the twin misses has two parts, both found at once by a ridge regression on the residuals of the labelled frames. A quadratic of the
labels that vary stands in the object's frame: it is what the mechanics and the object's shape miss, and the same all around an edge. Where
there is a direction, a second part stands in the sensor's frame: it is what the camera and the pins at rest miss.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scenes.experiment import ExperimentSpec
from training.audit import polynomials
from training.dataset import Dataset
from training.label_code import label_error, wrapped_deg
from training.studies.sim_to_real.field import TwinField, parts
from twin.rig.labels import ArmLabel

BACKWARDS = "twin backwards"
"""Name of the model in the study's table."""
RIDGE = 1.0
"""Penalty on the terms of the discrepancy, with labels scaled to -1..1."""
CONSTANT_RIDGE = 1e-3
"""Penalty on the constant term in the sensor's frame. It is nearly free."""
OWN_CONSTANT = 0.3
"""Penalty on the constant term in the object's frame, as a share of ``RIDGE``."""
LEAST_SHARE = 0.1
"""Smallest divisor of a leave-one-out residual, 1 minus the frame's own weight in the regression."""
NOISE_FRAMES = 60.0
"""Weight of the pins' noise in the covariance of the residuals, as a number of labelled frames."""
NOISE_TIMES = 1.5
"""Expected covariance of the residuals before any labelled frame, as a multiple of the pins' noise."""
WIDTH = 1.5
"""Width w of the prior on the labels, in half ranges."""
STARTS = 700
"""Largest number of simulated states that are tried as the start of an estimate."""
TURN_DEG = 10.0
"""Angle between two directions in which each start is tried, deg."""
STEPS = 7
"""Number of Gauss-Newton steps."""
NUDGE = 2e-3
"""Step of the difference quotients, in half ranges."""
LONGEST = 0.35
"""Longest step of a label, in half ranges."""
DIRECTION_DEG = 60.0
"""Half range of a direction, deg. It scales steps and difference quotients."""
BEYOND = 1.15
"""Range in which labels are searched, as a multiple of the simulated range. The Gaussian process knows nothing beyond it."""
Expected = Callable[[np.ndarray], np.ndarray]
"""Function from contacts (B, 12) to their expected waves (B, 2C)."""


class TwinBackwards:
    """A twin, to be read backwards.

    Parameters
    ----------
    moved_px : (S, N, 2) float
        Simulated displacements.
    labels : sequence of ArmLabel
        Their labels.
    rest_px : (N, 2) float
        The pins at rest.
    ranges : (12, 2) float
        Least and largest pose and move of the frames that are asked for; labels that do not vary are known.
    seed : int
        Chooses the simulated states that are learnt from.
    """

    def __init__(self, moved_px: np.ndarray, labels: Sequence[ArmLabel], rest_px: np.ndarray, ranges: np.ndarray, *, seed: int = 0) -> None:
        self._field = TwinField(moved_px, _both(labels), rest_px, seed=seed)
        self._ranges = ranges

    def estimate(self, real_px: np.ndarray, labels: Sequence[ArmLabel], asked_px: np.ndarray) -> np.ndarray:
        """Pose and move (B, 12) of frames with displacements (B, N, 2), after n labelled ones with displacements (n, N, 2), px.

        Without a labelled frame the twin is taken to miss nothing but the noise of pins.
        """
        field, told = self._field, _both(labels)
        missed = _Missed(field, told, field.waves(real_px) - field(told))
        left = parts(missed.left)
        noise = field.noise(real_px if len(real_px) else asked_px)
        spread = (left.T @ left + NOISE_FRAMES * NOISE_TIMES * noise) / (len(left) + NOISE_FRAMES)
        whitening = np.linalg.cholesky(np.linalg.inv(spread))

        def expected(those: np.ndarray) -> np.ndarray:
            found: np.ndarray = parts(field(those) + missed(those)) @ whitening
            return found

        asked = parts(field.waves(asked_px)) @ whitening
        fixed = np.flatnonzero(np.ptp(self._ranges, axis=1) == 0)
        states = field.known[:STARTS].copy()
        states[:, fixed] = self._ranges[fixed, 0]
        unknown = np.setdiff1d(field.varied, fixed)
        return self._found(asked, _nearest(asked, states, field.direction, expected), unknown, expected)

    def _found(self, asked: np.ndarray, those: np.ndarray, unknown: np.ndarray, expected: Expected) -> np.ndarray:
        """The labels (B, 12) after Gauss-Newton steps from a start."""
        field = self._field
        columns = [*unknown.tolist(), *([] if field.direction is None else [field.direction])]
        half = np.array([DIRECTION_DEG if k == field.direction else field.half[k] for k in columns])
        prior = np.array([0.0 if k == field.direction else WIDTH**-2 for k in columns])
        middle, reach = field.middle[unknown], BEYOND * field.half[unknown]
        for _ in range(STEPS):
            now = expected(those)
            slopes = []
            for k, width in zip(columns, half, strict=True):
                nudged = those.copy()
                nudged[:, k] += NUDGE * width
                slopes.append((expected(nudged) - now) / NUDGE)
            slope = np.stack(slopes, axis=1)
            force = np.einsum("bik,bk->bi", slope, asked - now) - prior * (those[:, columns] - field.middle[columns]) / half
            step = np.linalg.solve(slope @ slope.swapaxes(1, 2) + np.diag(prior), force[..., None])[..., 0]
            those[:, columns] += np.clip(step, -LONGEST, LONGEST) * half
            those[:, unknown] = np.clip(those[:, unknown], middle - reach, middle + reach)
        return those


class _Missed:
    """What the twin misses, by n labelled frames: called with contacts (B, 12), it gives waves (B, C).

    Attributes
    ----------
    left : (n, C) complex
        What is left of each frame's residual, predicted from the others.
    """

    def __init__(self, field: TwinField, known: np.ndarray, residual: np.ndarray) -> None:
        self._field, self._weight = field, {}
        self.left = np.empty_like(residual)
        penalty = RIDGE * np.r_[1.0 if field.direction is None else OWN_CONSTANT, np.ones(self._own(known).shape[1] - 1)]
        if field.direction is None:
            penalty[0] = CONSTANT_RIDGE
        else:
            penalty = np.r_[penalty, CONSTANT_RIDGE, np.full(self._seen(known).shape[1] - 1, RIDGE)]
        for order, waves in self._alike():
            terms = self._terms(known, waves)
            smooth = np.linalg.solve(terms.conj().T @ terms + np.diag(penalty), terms.conj().T)
            self._weight[order] = smooth @ residual[:, waves]
            own = np.einsum("ij,ji->i", terms, smooth).real
            self.left[:, waves] = (residual[:, waves] - terms @ self._weight[order]) / np.maximum(1 - own, LEAST_SHARE)[:, None]

    def __call__(self, known: np.ndarray) -> np.ndarray:
        found = np.empty((len(known), len(self._field.order)), complex)
        for order, waves in self._alike():
            found[:, waves] = self._terms(known, waves) @ self._weight[order]
        return found

    def _alike(self) -> list[tuple[int, np.ndarray]]:
        """Waves that turn alike, and so have the same terms; all of them where nothing turns."""
        order = self._field.order if self._field.direction is not None else np.zeros_like(self._field.order)
        return [(int(each), np.flatnonzero(order == each)) for each in np.unique(order)]

    def _terms(self, known: np.ndarray, waves: np.ndarray) -> np.ndarray:
        if self._field.direction is None:
            return self._own(known)
        return np.hstack([self._own(known) * self._field.turned(known)[:, waves[:1]], self._seen(known)])

    def _own(self, known: np.ndarray) -> np.ndarray:
        """Terms (B, P) in the object's frame."""
        return polynomials(self._field.scaled(known), 2)

    def _seen(self, known: np.ndarray) -> np.ndarray:
        """Terms (B, Q) in the sensor's frame: the labels, their products with cosine and sine of the direction, and those of twice it."""
        once = np.radians(known[:, self._field.direction]).reshape(-1, 1)
        straight, twice = polynomials(self._field.scaled(known), 1), 2 * once
        return np.hstack([straight, straight * np.cos(once), straight * np.sin(once), np.cos(twice), np.sin(twice)])


def _nearest(asked: np.ndarray, states: np.ndarray, direction: int | None, expected: Expected) -> np.ndarray:
    """The states (B, 12), in any direction, whose expected waves are nearest to those asked for (B, 2C)."""
    found, least = np.empty((len(asked), states.shape[1])), np.full(len(asked), np.inf)
    for turn in [None] if direction is None else np.arange(-180.0, 180.0, TURN_DEG):
        tried = states.copy()
        if direction is not None:
            tried[:, direction] = turn
        there = expected(tried)
        far = (there**2).sum(axis=1) - 2 * asked @ there.T
        near = far.argmin(axis=1)
        nearer = far[np.arange(len(asked)), near] < least
        least[nearer] = far[nearer, near[nearer]]
        found[nearer] = tried[near[nearer]]
    return found


def read_backwards(simulated: Dataset, labels: Sequence[ArmLabel], experiment: ExperimentSpec, *, seed: int) -> TwinBackwards:
    """The twin of some simulated states with their labels, to be read backwards for frames of an experiment."""
    rest_px = simulated.pins.reference.pins_px
    ranges = np.array(list(experiment.ranges().values()))
    return TwinBackwards(simulated.pins.nodes_px - rest_px, labels, rest_px, ranges, seed=seed)


def inverted_row(
    name: str, twin: TwinBackwards, real: Dataset, labels: Sequence[ArmLabel], rows: np.ndarray, test: np.ndarray
) -> dict[str, Any]:
    """A row of the study's table: the twin read backwards with labelled frames ``rows`` (n,), judged on ``test`` (t,).

    ``labels`` are those of all frames.
    """
    moved = real.pins.nodes_px - real.pins.reference.pins_px
    found = twin.estimate(moved[rows], [labels[row] for row in rows], moved[test])
    columns = dict(zip([f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)], found.T, strict=True))
    targets = real.targets.rows(test)
    named = zip(targets.names, targets.units, strict=True)
    made = np.column_stack([wrapped_deg(columns[key]) if unit == "deg" else columns[key] for key, unit in named])
    row = {"trained_on": name, "labelled_frames": len(rows), "model": BACKWARDS}
    for kind in ("corrected", "raw"):
        errors = np.abs(label_error(made, getattr(targets, kind), targets.units)).mean(axis=0)
        row |= {f"{label}_{kind}": float(error) for label, error in zip(targets.names, errors, strict=True)}
    return row


def _both(labels: Sequence[ArmLabel]) -> np.ndarray:
    """(K, 12) where the arm stands, and the move that it made, mm and deg."""
    undone = np.array([0.0 if label.executed else 1.0 for label in labels])[:, None]
    if not len(labels):
        return np.zeros((0, 12))
    pose, move = np.stack([label.pose for label in labels]), np.stack([label.move for label in labels])
    return np.hstack([pose - undone * move, (1 - undone) * move])
