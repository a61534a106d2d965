"""Model inversion: the labels whose simulated pins are most like a frame's.

A frame's waves t are turned to the object's frame of the labels l. They differ from the twin's waves d(l) and the discrepancy e(l) by

    r(l) = t - d(l) - e(l)

(``TwinField``, ``missed``). With S the covariance of what is left of such a frame, the labels have the negative logarithmic probability

    J(l) / 2 = r' S^-1 r / 2 + |l - m|^2 / 2 w^2

up to a constant. m and w are the middle and the width of the ranges. Moves are unknown, too, and estimated with the pose.

The minimum of J is found by damped Gauss-Newton steps from the nearest simulated state. Where a label is a direction, J has several minima
that are nearly as deep, because a far edge changes the pins little. The estimate is then the mean over directions around the whole circle:
for each direction the other labels are optimised, and it is weighted by its probability. Residuals of neighbouring waves are not
independent, so the logarithm of that probability is divided by ``TEMPERATURE``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from training.data.label_code import wrapped_deg
from training.studies.sim_to_real.field import TwinField, parts
from training.studies.sim_to_real.missed import MOST_FRAMES, Left, Missed, choose_evenly
from training.studies.sim_to_real.steps import stands_and_moves
from twin.rig.labels import ArmLabel

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
DAMPING = 1e-3
"""First damping of the steps, as a share of the diagonal of the normal matrix."""
DAMPING_LESS, DAMPING_MORE = 0.25, 8.0
"""Factors of the damping after a step that lowers J, and after one that does not and is taken back."""
AROUND_STEPS = 3
"""Number of Gauss-Newton steps at each of these directions that is likely after a first one."""
UNLIKELY = 300.0
"""Excess of J at the nearest simulated state beyond which a direction is left out of the mean; half of it after a first step."""
TEMPERATURE = 8.0
"""Divisor of the logarithm of a direction's probability in the mean over directions. 4 to 16 give nearly the same errors."""
NEAR_DEG = 4.0
"""Difference of the mean direction from that of the deepest minimum below which the latter is the estimate, because the mean is coarse."""
SURE = 0.9
"""Length of the mean direction, as a vector, above which a direction is sure; 0.9 is a standard deviation of 26 deg."""
NOISIER = 10.0
"""Variance of the residual of a frame without a label, as a multiple of that of a labelled frame, because its estimated label errs."""
AT_ONCE = 200
"""Frames that are estimated at once; more would need more memory."""


class _Frames(NamedTuple):
    """Frames that are asked for: their waves (B, C), and the weights (B, 2C) of the components of a residual."""

    waves: np.ndarray
    weights: np.ndarray

    def rows(self, index: np.ndarray) -> "_Frames":
        return _Frames(self.waves[index], self.weights[index])


class ModelInversion:
    """A twin, to be inverted.

    Parameters
    ----------
    moved_px : (S, N, 2) float
        Simulated displacements.
    labels : sequence of ArmLabel
        Their labels.
    rest_px : (N, 2) float
        The pins at rest.
    ranges : (12, 2) float
        Least and largest pose and move of the requested frames; labels that do not vary are known.
    seed : int
        Chooses the simulated states for the training.

    Attributes
    ----------
    turns : bool
        Whether a label of the simulated states is a direction that goes round the whole circle.
    unknown : list of int
        Columns of the labels that are estimated; the direction is not among them.
    """

    def __init__(self, moved_px: np.ndarray, labels: Sequence[ArmLabel], rest_px: np.ndarray, ranges: np.ndarray, *, seed: int = 0) -> None:
        self._field = TwinField(moved_px, stands_and_moves(labels), rest_px, seed=seed)
        self._ranges = ranges
        self.turns = self._field.direction is not None
        self.unknown: list[int] = np.setdiff1d(self._field.varied, _fixed_columns(ranges)).tolist()

    def estimate(
        self, real_px: np.ndarray, labels: Sequence[ArmLabel], wanted_px: np.ndarray, unlabelled_px: np.ndarray | None = None
    ) -> np.ndarray:
        """Pose and move (B, 12) of frames with displacements (B, N, 2), after n labelled ones with displacements (n, N, 2), px.

        Without a labelled frame there is no discrepancy, and what is left is half as large again as the noise of pins.

        Frames without labels (U, N, 2) are used where a label is a direction. They are estimated first. Those whose direction is sure teach
        the discrepancy, as frames with more noise. The covariance of what is left comes from the labelled frames alone, because the labels
        of the others are fitted to their pins.
        """
        if not len(wanted_px):
            return np.zeros((0, 12))
        rows = choose_evenly(len(real_px), MOST_FRAMES)
        field, known, seen = self._field, stands_and_moves(labels)[rows], self._field.waves(real_px)[rows]
        noise = field.noise(real_px if len(real_px) else wanted_px)

        def reader(more: np.ndarray, told: np.ndarray) -> _Reader:
            """Of the labelled frames, and of frames with waves (U, C) and estimated labels (U, 12)."""
            noisier = np.concatenate([np.ones(len(known)), np.full(len(more), NOISIER)])
            missed = Missed(field, np.concatenate([known, told]), np.concatenate([seen, more]), noisier)
            return _Reader(field, missed, Left(missed.left[: len(known)], seen, noise), self._ranges)

        found = reader(seen[:0], known[:0])
        if unlabelled_px is not None and field.direction is not None:
            more = field.waves(unlabelled_px)
            told = _in_groups(found, more)
            sure = np.flatnonzero(told.sure)
            sure = sure[choose_evenly(len(sure), MOST_FRAMES)]
            found = reader(more[sure], told.labels[sure])
        return _in_groups(found, field.waves(wanted_px)).labels


def _fixed_columns(ranges: np.ndarray) -> np.ndarray:
    """The columns of labels with ranges (12, 2) that do not vary."""
    return np.flatnonzero(np.ptp(ranges, axis=1) == 0)


def _in_all_directions(states: np.ndarray, direction: int | None) -> list[np.ndarray]:
    """States (S, 12), once for each direction that is tried, or once if there is none."""
    if direction is None:
        return [states]
    turned = np.repeat(states[None], round(360 / TURN_DEG), axis=0)
    turned[:, :, direction] = np.arange(-180.0, 180.0, TURN_DEG)[:, None]
    return list(turned)


def _in_groups(reader: "_Reader", waves: np.ndarray) -> "_Found":
    """Estimates of ``AT_ONCE`` frames at a time."""
    found = [reader(waves[first : first + AT_ONCE]) for first in range(0, len(waves), AT_ONCE)]
    return _Found(
        np.concatenate([np.zeros((0, 12)), *(each.labels for each in found)]),
        np.concatenate([np.zeros(0, bool), *(each.sure for each in found)]),
    )


class _Found(NamedTuple):
    """Estimated labels (B, 12), and whether each frame's direction is sure (B,), which it is where there is none."""

    labels: np.ndarray
    sure: np.ndarray


class _Reader:
    """Estimates labels of frames by a twin's field, its discrepancy, and the covariance of what is left."""

    def __init__(self, field: TwinField, missed: Missed, left: Left, ranges: np.ndarray) -> None:
        self._field, self._missed, self._left = field, missed, left
        fixed = _fixed_columns(ranges)
        states = field.known[choose_evenly(len(field.known), STARTS)].copy()
        states[:, fixed] = ranges[fixed, 0]
        self._unknown = np.setdiff1d(field.varied, fixed).tolist()
        self._turn = None if field.direction in fixed else field.direction
        self._starts = [(states, self._mean_components(states)) for states in _in_all_directions(states, self._turn)]

    def __call__(self, waves: np.ndarray) -> _Found:
        """Pose and move of frames with waves (B, C)."""
        frames = _Frames(waves, self._left.weights(waves))
        turn = self._turn
        nearest, least = zip(*(self._nearest(frames, *each) for each in self._starts), strict=True)
        starts, far = np.stack(nearest, axis=1), np.stack(least, axis=1)
        best = starts[np.arange(len(waves)), far.argmin(axis=1)]
        if turn is None:
            return _Found(self._improve_labels(frames, best, self._unknown, STEPS).labels, np.ones(len(waves), bool))
        best = self._improve_labels(frames, best, [*self._unknown, turn], STEPS).labels
        return self._mean(frames, best, starts, far - far.min(axis=1, keepdims=True))

    def _mean(self, frames: _Frames, best: np.ndarray, starts: np.ndarray, excess: np.ndarray) -> _Found:
        """The mean labels over all directions.

        Parameters
        ----------
        best : (B, 12) float
            The labels of the deepest minimum found.
        starts, excess : (B, T, 12) and (B, T) float
            The nearest simulated state in each direction that was tried, and the excess of its misfit over the smallest.
        """
        turn = self._turn
        frame, which = np.nonzero(excess < UNLIKELY)
        several = frames.rows(frame)
        tried = [starts[frame, which], best[frame]]
        tried[1][:, turn] = tried[0][:, turn]
        first, second = (self._objective(several, each) for each in tried)
        found = self._improve_labels(several, np.where((first < second)[:, None], *tried), self._unknown, 1)
        lowest = np.full(len(best), np.inf)
        np.minimum.at(lowest, frame, found.objective)
        likely = found.objective < lowest[frame] + UNLIKELY / 2
        frame, which, several = frame[likely], which[likely], several.rows(likely)
        found = self._improve_labels(several, found.labels[likely], self._unknown, AROUND_STEPS)
        told = np.full(excess.shape, -np.inf)
        told[frame, which] = -(found.objective + found.volume) / 2 / TEMPERATURE
        weight = np.exp(told - told.max(axis=1, keepdims=True))[frame, which]
        total = np.bincount(frame, weight)
        mean = np.stack([np.bincount(frame, weight * column) for column in found.labels.T], axis=1) / total[:, None]
        around = np.exp(1j * np.radians(found.labels[:, turn]))
        middle = (np.bincount(frame, weight * around.real) + 1j * np.bincount(frame, weight * around.imag)) / total
        mean[:, turn] = np.degrees(np.angle(middle))
        near = np.abs(wrapped_deg(mean[:, turn] - best[:, turn])) < NEAR_DEG
        mean[near, turn] = best[near, turn]
        return _Found(mean, np.abs(middle) > SURE)

    def _nearest(self, frames: _Frames, states: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state (B, 12) of one direction whose expected waves ``there`` (S, 2C) are nearest to each frame's, and its misfit (B,)."""
        here = self._object_components(frames, states[:1])
        square = frames.weights**2
        far = (square * here**2).sum(axis=1)[:, None] + square @ (there**2).T - 2 * (square * here) @ there.T
        near = far.argmin(axis=1)
        return states[near], far[np.arange(len(near)), near]

    def _improve_labels(self, frames: _Frames, labels: np.ndarray, columns: list[int], steps: int) -> "_Improved":
        """Labels (B, 12) after damped Gauss-Newton steps in some columns."""
        labels, field = labels.copy(), self._field
        half, prior = self._scales(columns)
        damping = np.full(len(labels), DAMPING)
        residual = self._residual(frames, labels)
        objective = self._objective(frames, labels, residual)
        normal = np.zeros((len(labels), len(columns), len(columns)))
        for _ in range(steps if columns else 0):
            slope = self._slopes(frames, labels, columns, half)
            force = np.einsum("bik,bk->bi", slope, residual) - prior * (labels[:, columns] - field.middle[columns]) / half
            normal = slope @ slope.swapaxes(1, 2) + np.diag(prior)
            damped = normal + damping[:, None, None] * normal * np.eye(len(columns))
            step = np.linalg.solve(damped, force[..., None])[..., 0]
            moved = labels.copy()
            moved[:, columns] += np.clip(step, -LONGEST, LONGEST) * half
            middle, reach = field.middle[self._unknown], BEYOND * field.half[self._unknown]
            moved[:, self._unknown] = np.clip(moved[:, self._unknown], middle - reach, middle + reach)
            there = self._residual(frames, moved)
            lower = self._objective(frames, moved, there)
            better = lower < objective
            labels[better], residual[better], objective[better] = moved[better], there[better], lower[better]
            damping *= np.where(better, DAMPING_LESS, DAMPING_MORE)
        return _Improved(labels, objective, np.linalg.slogdet(normal)[1])

    def _scales(self, columns: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Half range (K,) of some labels and the precision (K,) of their prior in half ranges; a direction has none."""
        field = self._field
        half = np.array([DIRECTION_DEG if k == field.direction else field.half[k] for k in columns])
        return half, np.array([0.0 if k == field.direction else WIDTH**-2 for k in columns])

    def _objective(self, frames: _Frames, labels: np.ndarray, residual: np.ndarray | None = None) -> np.ndarray:
        """(B,) J at labels (B, 12)."""
        left = self._residual(frames, labels) if residual is None else residual
        half, prior = self._scales(self._unknown)
        away = (labels[:, self._unknown] - self._field.middle[self._unknown]) / half
        return np.asarray((left**2).sum(axis=1) + (prior * away**2).sum(axis=1))

    def _residual(self, frames: _Frames, labels: np.ndarray) -> np.ndarray:
        """(B, 2C) components of r, each divided by its standard deviation."""
        return np.asarray((self._object_components(frames, labels) - self._mean_components(labels)) * frames.weights)

    def _slopes(self, frames: _Frames, labels: np.ndarray, columns: list[int], half: np.ndarray) -> np.ndarray:
        """(B, K, 2C) minus the derivatives of r, by labels in half ranges. The frame's noise is not turned with the direction."""
        field = self._field
        now, back, slopes = self._waves(labels), field.turn_factors(labels, back=True), []
        for k, width in zip(columns, half, strict=True):
            nudged = labels.copy()
            nudged[:, k] += NUDGE * width
            by = (self._waves(nudged) * field.turn_factors(nudged) * back - now) / NUDGE
            slopes.append(parts(by) @ self._left.axes * frames.weights)
        return np.stack(slopes, axis=1)

    def _waves(self, labels: np.ndarray) -> np.ndarray:
        """Expected waves (B, C) in the object's frame."""
        return np.asarray(self._field.own(labels) + self._missed(labels))

    def _mean_components(self, labels: np.ndarray) -> np.ndarray:
        """(B, 2C) components of the expected waves."""
        return parts(self._waves(labels)) @ self._left.axes

    def _object_components(self, frames: _Frames, labels: np.ndarray) -> np.ndarray:
        """(B, 2C) components of the frames' waves in the object's frame."""
        return parts(frames.waves * self._field.turn_factors(labels, back=True)) @ self._left.axes


class _Improved(NamedTuple):
    """Result of Gauss-Newton steps.

    Attributes
    ----------
    labels : (B, 12) float
    objective : (B,) float
        J.
    volume : (B,) float
        Logarithm of the determinant of the normal matrix.
    """

    labels: np.ndarray
    objective: np.ndarray
    volume: np.ndarray
