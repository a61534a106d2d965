"""Estimates of a twin with labelled frames and without a network: the mean of two model inversions.

Backwards (``inverted``): the labels whose simulated pins are most like a frame's. Forwards (``TwinForwards``): the labels as a function of
the simulated pins. Both learn what the twin misses, the first in the pins and the second in the labels, and their errors differ. The
average has smaller errors than either, where no label is a direction. A direction is estimated by model inversion alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from scenes import ExperimentSpec, ObjectSpec
from training.data.dataset import Dataset
from training.data.label_code import wrapped_deg
from training.data.targets import unit_of
from training.runs.gaussian_process import Kernel, Points, Posterior, Term, fit_processes
from training.studies.sim_to_real.missed import MOST_FRAMES, choose_evenly
from training.studies.sim_to_real.model_inversion import ModelInversion
from training.studies.sim_to_real.steps import MODES, arm_labels, label_errors, stands_and_moves, states_touching, states_within
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
POSES = 6
"""Columns of a label before those of the move."""


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
        flat, known_labels = noisy_px.reshape(len(rows), -1), known_labels[rows]
        self._rest = flat.mean(axis=0)
        _, sizes, directions = np.linalg.svd(flat - self._rest, full_matrices=False)
        keep = min(MODES, len(rows) - 1)
        self._modes = directions[:keep].T * np.sqrt(len(rows)) / sizes[0]
        self._middle, self._scale = known_labels.mean(axis=0), known_labels.std(axis=0)
        self._twin, _ = fit_processes(self._inputs(noisy_px), (known_labels - self._middle) / self._scale, seed=seed)

    def estimate(self, real_px: np.ndarray, known_labels: np.ndarray, wanted_px: np.ndarray) -> np.ndarray:
        """Labels (B, K) of frames with displacements (B, N, 2), after n labelled ones (n, N, 2) with labels (n, K)."""
        asked = Points.of(self._inputs(wanted_px))
        found = self._twin(asked)
        if len(known_labels):
            known = Points.of(self._inputs(real_px))
            missed = (known_labels - self._middle) / self._scale - self._twin(known)
            found = found + np.column_stack([_difference(known, label).mean(asked) for label in missed.T])
        return np.asarray(found * self._scale + self._middle)

    def _inputs(self, moved_px: np.ndarray) -> np.ndarray:
        """Amplitudes (B, D) of the leading modes."""
        return np.asarray((moved_px.reshape(len(moved_px), self._rest.size) - self._rest) @ self._modes)


def _difference(known: Points, missed: np.ndarray) -> Posterior:
    """The process of one label's difference (n,), with the noise that predicts each frame best from the others."""
    lengths = np.full(known.inputs.shape[1], DIFFERENCE_LENGTH)
    tried = [Posterior(Kernel(DIFFERENCE, lengths, DIFFERENCE_SIZES, np.array([noise])), known, missed) for noise in DIFFERENCE_NOISES]
    return min(tried, key=lambda each: float(np.abs(each.left_out - missed).mean()))


class TwinRead:
    """A twin, to be read both ways. Its parameters are those of ``ModelInversion``."""

    def __init__(self, moved_px: np.ndarray, labels: Sequence[ArmLabel], rest_px: np.ndarray, ranges: np.ndarray, *, seed: int = 0) -> None:
        self._backwards = ModelInversion(moved_px, labels, rest_px, ranges, seed=seed)
        self._columns = [k for k in self._backwards.unknown if k < POSES]
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
        rows = choose_evenly(len(labels), MOST_FRAMES)
        known_px, known = real_px[rows], [labels[row] for row in rows]
        back, forth = self._both(known_px, known, wanted_px)
        back[:, self._columns] = self._average_readings(self._shares(*self._fold_readings(known_px, known), known), back, forth)
        return back

    def left_out(self, real_px: np.ndarray, labels: Sequence[ArmLabel]) -> tuple[np.ndarray, np.ndarray]:
        """The labelled frames (m,) that are chosen to be evaluated, and pose and move (m, 12) of each, estimated from frames of other
        folds.

        Where both readings are averaged, the weights are those of all labelled frames.
        """
        rows, back, forth = self._fold_readings(real_px, labels)
        if self._forwards is not None:
            back[:, self._columns] = self._average_readings(self._shares(rows, back, forth, labels), back, forth)
        return rows, back

    def _average_readings(self, share: np.ndarray, back: np.ndarray, forth: np.ndarray) -> np.ndarray:
        """Poses (B, K) by the weights (K,) of those from model inversion, as pose and move (B, 12), and of those read forwards (B, K)."""
        return np.asarray(share * back[:, self._columns] + (1 - share) * forth)

    def _both(self, real_px: np.ndarray, labels: Sequence[ArmLabel], wanted_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose and move (B, 12) from model inversion, and poses (B, K) read forwards, NaN where a label is a direction."""
        back = self._backwards.estimate(real_px, labels, wanted_px)
        if self._forwards is None:
            return back, np.full((len(wanted_px), len(self._columns)), np.nan)
        return back, self._forwards.estimate(real_px, stands_and_moves(labels)[:, self._columns], wanted_px)

    def _fold_readings(self, real_px: np.ndarray, labels: Sequence[ArmLabel]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows (m,) of labelled frames, and both readings of each, as ``_both``, from frames of other folds."""
        fold, rows = np.arange(len(labels)) % FOLDS, choose_evenly(len(labels), WEIGHED) if len(labels) > 1 else np.zeros(0, int)
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
    name: str,
    twin: TwinRead,
    real: Dataset,
    labels: Sequence[ArmLabel],
    rows: np.ndarray,
    test: np.ndarray,
    *,
    unlabelled: np.ndarray | None = None,
) -> dict[str, Any]:
    """A row of the study's table: the twin read after labelled frames ``rows`` (n,), evaluated on ``test`` (t,).

    ``labels`` are those of all frames; those of the frames ``unlabelled`` (u,) are not used.
    """
    moved = real.pins.nodes_px - real.pins.reference.pins_px
    found = twin.estimate(moved[rows], [labels[row] for row in rows], moved[test], None if unlabelled is None else moved[unlabelled])
    targets = real.targets.rows(test)
    row = {"trained_on": name, "labelled_frames": len(rows), "model": READ}
    return row | label_errors(named_labels(found, targets.names), targets)


def named_labels(found: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """The labels (B, K) with these names of poses and moves (B, 12); angles from -180 to 180 deg."""
    columns = dict(zip([f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7)], found.T, strict=True))
    return np.column_stack([wrapped_deg(columns[name]) if unit_of(name) == "deg" else columns[name] for name in names])
