"""Model inversion: the labels whose simulated pins are most like a frame's.

A frame's waves t are turned to the object's frame of the labels l. They differ from the twin's waves d(l) and the discrepancy e(l) by

    r(l) = t - d(l) - e(l)

(``TwinField``, ``Missed``). With S the covariance of what is left of such a frame, the labels have the negative logarithmic probability

    J(l) / 2 = r' S^-1 r / 2 + |l - m|^2 / 2 w^2

up to a constant. m and w are the middle and the width of the ranges. Moves are unknown, too, and estimated with the pose.

The minimum of J is found by damped Gauss-Newton steps from the nearest simulated state. Where a label is a direction, J has several minima
that are nearly as deep, because a far edge changes the pins little. The estimate is then the mean over directions around the whole circle:
for each direction the other labels are optimised, and it is weighted by its probability. Residuals of neighbouring waves are not
independent, so the logarithm of that probability is divided by ``TEMPERATURE``.

``TwinRead`` is the mean of two model inversions, without a network. Backwards (``ModelInversion``): the labels whose simulated pins are
most like a frame's. Forwards (``TwinForwards``): the labels as a function of the simulated pins. Both learn what the twin misses, the first
in the pins and the second in the labels, and their errors differ. The average has smaller errors than either, where no label is a
direction. A direction is estimated by model inversion alone.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from scenes import ExperimentSpec, ObjectSpec
from training.data.dataset import Dataset
from training.data.label_code import wrapped_deg
from training.data.targets import unit_of
from training.estimate.contact_estimator import DisplacementModes
from training.runs.gaussian_process import Kernel, Points, Posterior, Term, fit_processes
from training.studies.sim_to_real.field import MOST_FRAMES, MOVES_FROM, Left, Missed, TwinField, parts
from training.studies.sim_to_real.steps import MODES, arm_labels, error_row, stands_and_moves, states_touching, states_within
from twin.frames import spread_indices
from twin.rig.labels import ArmLabel

READ = "model inversion"
"""Name of the model in the study's table."""
LEAST_STATES = 10
"""Least number of simulated states that a twin learns from."""
MOST_STATES = 1500
"""Most simulated states that the labels are learnt from. More do not change the errors."""
NOISE_PX = 0.1
"""Standard deviation of the noise that is added to simulated pins, px, because the pins of real frames have noise."""
DIFFERENCE = (Term("smooth"), Term("linear"), Term("constant"))
"""Terms of the process of what the twin's labels miss."""
DIFFERENCE_LENGTH = 8.0
"""Length of its smooth term, in standard deviations of the first mode. It is long, so that a few frames determine the whole difference."""
DIFFERENCE_SIZES = np.array([0.3, 0.3, 0.3])
"""Sizes of its terms, in standard deviations of the label. Errors change little when they are a third or three times as large."""
DIFFERENCE_NOISES = (0.006, 0.015, 0.03, 0.06, 0.12, 0.25)
"""Standard deviations of its noise that are tried, in standard deviations of the label."""
FOLDS = 10
"""Parts of the labelled frames; each part is estimated from the others to find the weights of the two readings."""
WEIGHED = 200
"""Most labelled frames that are estimated so."""
EQUAL_FRAMES = 10.0
"""Weight of two readings with equal and independent errors, as a number of labelled frames."""
OUTLIER = 1.5
"""Errors are limited to this multiple of the quantile ``OUTLIER_QUANTILE`` of their sizes before they are squared."""
OUTLIER_QUANTILE = 0.9
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
        rows = spread_indices(len(real_px), MOST_FRAMES)
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
            told, certain = _in_groups(found, more)
            sure = np.flatnonzero(certain)
            sure = sure[spread_indices(len(sure), MOST_FRAMES)]
            found = reader(more[sure], told[sure])
        return _in_groups(found, field.waves(wanted_px))[0]


def _fixed_columns(ranges: np.ndarray) -> np.ndarray:
    """The columns of labels with ranges (12, 2) that do not vary."""
    return np.flatnonzero(np.ptp(ranges, axis=1) == 0)


def _in_groups(reader: "_Reader", waves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The results of a reader, of ``AT_ONCE`` frames at a time."""
    found = [(np.zeros((0, 12)), np.zeros(0, bool)), *(reader(waves[first : first + AT_ONCE]) for first in range(0, len(waves), AT_ONCE))]
    labels, sure = zip(*found, strict=True)
    return np.concatenate(labels), np.concatenate(sure)


class _Reader:
    """Estimates labels of frames by a twin's field, its discrepancy, and the covariance of what is left."""

    def __init__(self, field: TwinField, missed: Missed, left: Left, ranges: np.ndarray) -> None:
        self._field, self._missed, self._left = field, missed, left
        fixed = _fixed_columns(ranges)
        states = field.known[spread_indices(len(field.known), STARTS)].copy()
        states[:, fixed] = ranges[fixed, 0]
        self._unknown = np.setdiff1d(field.varied, fixed).tolist()
        self._turn = None if field.direction in fixed else field.direction
        self._starts = []
        for direction in [0.0] if self._turn is None else np.arange(-180.0, 180.0, TURN_DEG):
            turned = states.copy()
            turned[:, [] if self._turn is None else self._turn] = direction
            self._starts.append((turned, self._mean_components(turned)))

    def __call__(self, waves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose and move (B, 12) of frames with waves (B, C), and whether each frame's direction is sure (B,); it is where there is none."""
        frames = _Frames(waves, self._left.weights(waves))
        turn = self._turn
        nearest, least = zip(*(self._nearest(frames, *each) for each in self._starts), strict=True)
        starts, far = np.stack(nearest, axis=1), np.stack(least, axis=1)
        best = starts[np.arange(len(waves)), far.argmin(axis=1)]
        if turn is None:
            return self._improve_labels(frames, best, self._unknown, STEPS)[0], np.ones(len(waves), bool)
        best, *_ = self._improve_labels(frames, best, [*self._unknown, turn], STEPS)
        return self._mean(frames, best, starts, far - far.min(axis=1, keepdims=True))

    def _mean(self, frames: _Frames, best: np.ndarray, starts: np.ndarray, excess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean labels over all directions, and whether they are sure.

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
        first, second = (self._objective(each, self._residual(several, each)) for each in tried)
        labels, objective, _ = self._improve_labels(several, np.where((first < second)[:, None], *tried), self._unknown, 1)
        lowest = np.full(len(best), np.inf)
        np.minimum.at(lowest, frame, objective)
        likely = objective < lowest[frame] + UNLIKELY / 2
        frame, which, several = frame[likely], which[likely], several.rows(likely)
        labels, objective, volume = self._improve_labels(several, labels[likely], self._unknown, AROUND_STEPS)
        told = np.full(excess.shape, -np.inf)
        told[frame, which] = -(objective + volume) / 2 / TEMPERATURE
        weight = np.exp(told - told.max(axis=1, keepdims=True))[frame, which]
        total = np.bincount(frame, weight)
        mean = np.stack([np.bincount(frame, weight * column) for column in labels.T], axis=1) / total[:, None]
        around = np.exp(1j * np.radians(labels[:, turn]))
        middle = (np.bincount(frame, weight * around.real) + 1j * np.bincount(frame, weight * around.imag)) / total
        mean[:, turn] = np.degrees(np.angle(middle))
        near = np.abs(wrapped_deg(mean[:, turn] - best[:, turn])) < NEAR_DEG
        mean[near, turn] = best[near, turn]
        return mean, np.abs(middle) > SURE

    def _nearest(self, frames: _Frames, states: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state (B, 12) of one direction whose expected waves ``there`` (S, 2C) are nearest to each frame's, and its misfit (B,)."""
        here = self._object_components(frames, states[:1])
        square = frames.weights**2
        far = (square * here**2).sum(axis=1)[:, None] + square @ (there**2).T - 2 * (square * here) @ there.T
        near = far.argmin(axis=1)
        return states[near], far[np.arange(len(near)), near]

    def _improve_labels(self, frames: _Frames, labels: np.ndarray, columns: list[int], steps: int) -> tuple[np.ndarray, ...]:
        """Labels (B, 12) after damped Gauss-Newton steps in some columns, J (B,) there, and the logarithm (B,) of the determinant of the
        normal matrix."""
        labels, field = labels.copy(), self._field
        half, prior = self._scales(columns)
        damping = np.full(len(labels), DAMPING)
        residual = self._residual(frames, labels)
        objective = self._objective(labels, residual)
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
            lower = self._objective(moved, there)
            better = lower < objective
            labels[better], residual[better], objective[better] = moved[better], there[better], lower[better]
            damping *= np.where(better, DAMPING_LESS, DAMPING_MORE)
        return labels, objective, np.linalg.slogdet(normal)[1]

    def _scales(self, columns: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Half range (K,) of some labels and the precision (K,) of their prior in half ranges; a direction has none."""
        field = self._field
        half = np.array([DIRECTION_DEG if k == field.direction else field.half[k] for k in columns])
        return half, np.array([0.0 if k == field.direction else WIDTH**-2 for k in columns])

    def _objective(self, labels: np.ndarray, left: np.ndarray) -> np.ndarray:
        """(B,) J at labels (B, 12) with the residual ``left`` (B, 2C)."""
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


class TwinForwards:
    """Labels as a Gaussian process of a twin's pins. Another process, of the labelled frames, adds what these labels miss.

    Parameters
    ----------
    moved_px : (S, N, 2) float
        Simulated displacements.
    told : (S, K) float
        Labels of these states. None is a direction that goes round the whole circle.
    seed : int
        Chooses the simulated states for the training.
    """

    def __init__(self, moved_px: np.ndarray, known_labels: np.ndarray, *, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.permutation(len(known_labels))[:MOST_STATES])
        noisy_px = moved_px[rows] + rng.normal(0, NOISE_PX, moved_px[rows].shape)
        known_labels, self._modes = known_labels[rows], DisplacementModes.of(noisy_px, MODES)
        self._middle, self._scale = known_labels.mean(axis=0), known_labels.std(axis=0)
        self._twin, _ = fit_processes(self._modes(noisy_px), (known_labels - self._middle) / self._scale, seed=seed)

    def estimate(self, real_px: np.ndarray, known_labels: np.ndarray, wanted_px: np.ndarray) -> np.ndarray:
        """Labels (B, K) of frames with displacements (B, N, 2), after n labelled ones (n, N, 2) with labels (n, K)."""
        asked = Points.of(self._modes(wanted_px))
        found = self._twin(asked)
        if len(known_labels):
            known = Points.of(self._modes(real_px))
            missed = (known_labels - self._middle) / self._scale - self._twin(known)
            found = found + np.column_stack([_difference(known, label).mean(asked) for label in missed.T])
        return np.asarray(found * self._scale + self._middle)


def _difference(known: Points, missed: np.ndarray) -> Posterior:
    """The process of one label's difference (n,), with the noise that predicts each frame best from the others."""
    lengths = np.full(known.inputs.shape[1], DIFFERENCE_LENGTH)
    tried = [Posterior(Kernel(DIFFERENCE, lengths, DIFFERENCE_SIZES, np.array([noise])), known, missed) for noise in DIFFERENCE_NOISES]
    return min(tried, key=lambda each: float(np.abs(each.left_out - missed).mean()))


class TwinRead:
    """A twin, to be read both ways. Its parameters are those of ``ModelInversion``."""

    def __init__(self, moved_px: np.ndarray, labels: Sequence[ArmLabel], rest_px: np.ndarray, ranges: np.ndarray, *, seed: int = 0) -> None:
        self._backwards = ModelInversion(moved_px, labels, rest_px, ranges, seed=seed)
        self._columns = [k for k in self._backwards.unknown if k < MOVES_FROM]
        told = stands_and_moves(labels)[:, self._columns]
        self._forwards = None if self._backwards.turns else TwinForwards(moved_px, told, seed=seed)

    def estimate(
        self, real_px: np.ndarray, labels: Sequence[ArmLabel], wanted_px: np.ndarray, unlabelled_px: np.ndarray | None = None
    ) -> np.ndarray:
        """Pose and move (B, 12) of frames with displacements (B, N, 2), after n labelled ones with displacements (n, N, 2), px.

        Frames without labels (U, N, 2) are used where a label is a direction; see ``TwinBackwards.estimate``.
        """
        if self._forwards is None:
            return self._backwards.estimate(real_px, labels, wanted_px, unlabelled_px)
        rows = spread_indices(len(labels), MOST_FRAMES)
        known_px, known = real_px[rows], [labels[row] for row in rows]
        return self._blend(*self._both(known_px, known, wanted_px), self._shares(*self._fold_readings(known_px, known), known))

    def left_out(self, real_px: np.ndarray, labels: Sequence[ArmLabel]) -> tuple[np.ndarray, np.ndarray]:
        """The labelled frames (m,) that are chosen to be evaluated, and pose and move (m, 12) of each, estimated from frames of other
        folds.

        Where both readings are averaged, the weights are those of all labelled frames.
        """
        rows, back, forth = self._fold_readings(real_px, labels)
        if self._forwards is not None:
            self._blend(back, forth, self._shares(rows, back, forth, labels))
        return rows, back

    def _blend(self, back: np.ndarray, forth: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Average poses from model inversion, in pose and move (B, 12), with those read forwards (B, K). ``share`` (K,): weight of the
        former."""
        back[:, self._columns] = share * back[:, self._columns] + (1 - share) * forth
        return back

    def _both(self, real_px: np.ndarray, labels: Sequence[ArmLabel], wanted_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose and move (B, 12) from model inversion, and poses (B, K) read forwards, NaN where a label is a direction."""
        back = self._backwards.estimate(real_px, labels, wanted_px)
        if self._forwards is None:
            return back, np.full((len(wanted_px), len(self._columns)), np.nan)
        return back, self._forwards.estimate(real_px, stands_and_moves(labels)[:, self._columns], wanted_px)

    def _fold_readings(self, real_px: np.ndarray, labels: Sequence[ArmLabel]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (m,) of labelled frames, and both readings of each, as ``_both``, from frames of other folds."""
        fold, rows = np.arange(len(labels)) % FOLDS, np.array(spread_indices(len(labels), WEIGHED) if len(labels) > 1 else [], int)
        back, forth = np.zeros((len(rows), 12)), np.zeros((len(rows), len(self._columns)))
        for each in np.unique(fold[rows]):
            asked, others = fold[rows] == each, np.flatnonzero(fold != each)
            back[asked], forth[asked] = self._both(real_px[others], [labels[row] for row in others.tolist()], real_px[rows[asked]])
        return rows, back, forth

    def _shares(self, rows: np.ndarray, back: np.ndarray, forth: np.ndarray, labels: Sequence[ArmLabel]) -> np.ndarray:
        """(K,) weight of each label from model inversion, from 0 to 1, by the covariance of both readings' errors on labelled frames."""
        truth = stands_and_moves(labels)[rows][:, self._columns]
        missed = np.stack([back[:, self._columns], forth]) - truth
        return np.array([_share(label) for label in np.moveaxis(missed, 2, 0)])


def _share(errors: np.ndarray) -> float:
    """Weight of the first of two readings in the average with the least squared error, by their errors (2, n).

    The covariance of the errors is shrunk towards equal and independent errors, which have the weights 1/2.
    """
    count = errors.shape[1]
    if not count or not errors.any():
        return 0.5
    limit = OUTLIER * np.quantile(np.abs(errors), OUTLIER_QUANTILE, axis=1, keepdims=True)
    limited = np.clip(errors, -limit, limit)
    spread = limited @ limited.T
    spread += EQUAL_FRAMES / count * np.sqrt(np.prod(np.diag(spread))) * np.eye(2)
    weight = np.clip(np.linalg.solve(spread, np.ones(2)), 0, None)
    return float(weight[0] / weight.sum())


def read_twin(sets: list[Dataset], obj: ObjectSpec, experiment: ExperimentSpec, *, seed: int) -> TwinRead:
    """The twin of simulated data sets, to be read for frames of an experiment that touches an object.

    It is trained on the states of this object whose labels lie within the experiment's ranges, extended by ``RANGE_MARGIN``.

    Raises
    ------
    TrainingError
        There are fewer than ``LEAST_STATES`` such states.
    """
    simulated = states_touching(sets, obj)
    by_folder = {each.folder: each for each in sets}
    labels = [label for folder in simulated.folders for label in arm_labels(by_folder[folder])]
    limits = experiment.ranges()
    low, high = np.array([limits[name] for name in simulated.targets.names]).T
    rows = states_within(simulated, low, high, LEAST_STATES, f"within the ranges of {experiment.name}, there must be {LEAST_STATES}")
    part, rest_px = simulated.rows(rows), simulated.pins.reference.pins_px
    return TwinRead(part.pins.nodes_px - rest_px, [labels[row] for row in rows], rest_px, np.array(list(limits.values())), seed=seed)


def read_row(
    name: str, twin: TwinRead, real: Dataset, rows: np.ndarray, test: np.ndarray, *, unlabelled: np.ndarray | None = None
) -> dict[str, Any]:
    """A row of the study's table: the twin read after labelled frames ``rows`` (n,), evaluated on ``test`` (t,).

    The labels of the frames ``unlabelled`` (u,) are not used.
    """
    labels, moved, targets = arm_labels(real), real.pins.nodes_px - real.pins.reference.pins_px, real.targets.rows(test)
    found = twin.estimate(moved[rows], [labels[row] for row in rows], moved[test], None if unlabelled is None else moved[unlabelled])
    return error_row(name, len(rows), READ, named_labels(found, targets.names), targets)


def named_labels(found: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The labels (B, K) with these names of poses and moves (B, 12); angles from -180 to 180 deg."""
    columns = dict(zip([f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)], found.T, strict=True))
    return np.column_stack([wrapped_deg(columns[name]) if unit_of(name) == "deg" else columns[name] for name in names])
