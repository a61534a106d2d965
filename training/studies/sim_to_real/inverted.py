"""The twin read backwards: the labels whose simulated pins are most like a frame's.

The simulated displacements' modes are polynomials of the labels that vary, d(l). What the twin misses is a quadratic e(l), a ridge
regression on the residuals of the labelled frames. With S the covariance of what is left on them, each predicted from the others, the
estimate is

    l = argmin (t - d(l) - e(l))' S^-1 (t - d(l) - e(l)) + |l - m|^2 / w^2

t are the modes of the frame, m and w the middle and the width of the ranges. It is found by Gauss-Newton steps from the nearest simulated
state. Moves are unknown, too, and found with the pose.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from training.audit import FRAMES_A_TERM, LabelColumns, polynomials
from training.dataset import Dataset
from training.label_code import label_error, wrapped_deg
from twin.rig.labels import ArmLabel

BACKWARDS = "twin backwards"
"""Name of the model in the study's table."""
MODES = 30
"""Modes of the simulated displacements that are compared."""
HIGHEST = 5
"""Highest degree of the twin's polynomials; lower if the states are few."""
RIDGE = 0.3
"""Penalty on the terms of what the twin misses, in labels scaled to -1..1; the constant term has next to none."""
SHRUNK = 0.3
"""Share by which the covariance of what is left is drawn to its diagonal."""
LEAST_PX2 = 1e-4
"""Variance that is added to it, px^2."""
WIDTH = 1.5
"""w above, in half ranges of the labels."""
STEPS = 8
"""Gauss-Newton steps; fewer are enough from a near start."""
NUDGE = 1e-3
"""Step of the difference quotients, in half ranges."""


class TwinBackwards:
    """A twin's polynomials of pose and move, to be read backwards.

    Parameters
    ----------
    moved_px : (S, N, 2) float
        Simulated displacements.
    labels : sequence of ArmLabel
        Their labels.
    """

    def __init__(self, moved_px: np.ndarray, labels: Sequence[ArmLabel]) -> None:
        self.known = _both(labels)
        low, high = self.known.min(axis=0), self.known.max(axis=0)
        self.varied = np.flatnonzero(high > low)
        self.middle, self.half = (low + high) / 2, np.maximum(high - low, 1e-12) / 2
        self._columns = LabelColumns.of(self.known[:, :6], self.known[:, 6:])
        columns = self._columns.columns(self.known[:, :6], self.known[:, 6:])
        self._shift, self._scale = columns.mean(axis=0), np.maximum(np.ptp(columns, axis=0) / 2, 1e-12)
        fitting = [k for k in range(1, HIGHEST + 1) if FRAMES_A_TERM * polynomials(columns[:1], k).shape[1] <= len(columns)]
        self._degree = fitting[-1] if fitting else 1
        flat = moved_px.reshape(len(moved_px), -1)
        _, _, directions = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
        self._modes = directions[:MODES]
        self.states = flat @ self._modes.T
        self._weight = np.linalg.lstsq(self._terms(self.known, self._degree), self.states, rcond=None)[0]

    def estimate(self, real_px: np.ndarray, labels: Sequence[ArmLabel], asked_px: np.ndarray) -> np.ndarray:
        """Pose and move (B, 12) of frames with displacements (B, N, 2), after n labelled ones with displacements (n, N, 2), px."""
        told, there, asked = _both(labels), self._seen(real_px), self._seen(asked_px)
        missed = there - self._terms(told, self._degree) @ self._weight
        terms = self._terms(told, 2)
        penalty = np.diag(np.r_[1e-3, np.full(terms.shape[1] - 1, RIDGE)])
        smooth = np.linalg.solve(terms.T @ terms + penalty, terms.T)
        correction = smooth @ missed
        own = np.einsum("ij,ji->i", terms, smooth)
        left = (missed - terms @ correction) / np.maximum(1 - own, 0.05)[:, None]
        spread = left.T @ left / len(left)
        spread = (1 - SHRUNK) * spread + SHRUNK * np.diag(np.diag(spread)) + LEAST_PX2 * np.eye(len(spread))
        precision = np.linalg.inv(spread)

        def expected(those: np.ndarray) -> np.ndarray:
            both: np.ndarray = self._terms(those, self._degree) @ self._weight + self._terms(those, 2) @ correction
            return both

        start = expected(self.known)
        near = [int(np.argmin(np.einsum("sk,kl,sl->s", start - each, precision, start - each, optimize=True))) for each in asked]
        return self._found(asked, self.known[near].copy(), expected, precision)

    def _found(
        self, asked: np.ndarray, those: np.ndarray, expected: Callable[[np.ndarray], np.ndarray], precision: np.ndarray
    ) -> np.ndarray:
        """The labels (B, 12) after Gauss-Newton steps from a start."""
        half, middle = self.half[self.varied], self.middle[self.varied]
        prior = np.diag(1 / (WIDTH * half) ** 2)
        for _ in range(STEPS):
            now = expected(those)
            slopes = []
            for k, width in zip(self.varied, half, strict=True):
                nudged = those.copy()
                nudged[:, k] += NUDGE * width
                slopes.append((expected(nudged) - now) / (NUDGE * width))
            slope = np.stack(slopes, axis=1)
            weighted = slope @ precision
            force = np.einsum("bik,bk->bi", weighted, asked - now) - (those[:, self.varied] - middle) @ prior
            step = np.linalg.solve(weighted @ slope.swapaxes(1, 2) + prior, force[..., None])[..., 0]
            those[:, self.varied] += np.clip(step, -half, half)
        return those

    def _terms(self, those: np.ndarray, degree: int) -> np.ndarray:
        columns = self._columns.columns(those[:, :6], those[:, 6:])
        return polynomials((columns - self._shift) / self._scale, degree)

    def _seen(self, moved_px: np.ndarray) -> np.ndarray:
        """Modes (B, K) of displacements (B, N, 2)."""
        seen: np.ndarray = moved_px.reshape(len(moved_px), -1) @ self._modes.T
        return seen


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
    pose, move = np.stack([label.pose for label in labels]), np.stack([label.move for label in labels])
    return np.hstack([pose - undone * move, (1 - undone) * move])
