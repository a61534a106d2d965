"""Code of labels as the numbers that a model estimates: a direction on the whole circle becomes its sine and cosine, others stay unchanged.

A direction has no beginning: 179 deg and -179 deg are 2 deg apart. A model that estimated the angle itself would need a jump there, and
its errors near the jump would be up to 180 deg.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Range of an angle's labels, deg, above which the angle goes round the whole circle. Tilts and small turns stay far below it.
HALF_CIRCLE_DEG = 180.0


def goes_round(units: Sequence[str], labels: np.ndarray) -> tuple[bool, ...]:
    """Which of K labels (M, K) with these units are directions on the whole circle."""
    return tuple(unit == "deg" and bool(np.ptp(column) > HALF_CIRCLE_DEG) for unit, column in zip(units, labels.T, strict=True))


def label_error(made: np.ndarray, truth: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Estimates minus truth, (..., K) both. The difference of angles is taken from -180 to 180 deg."""
    angle = np.array([unit == "deg" for unit in units], bool)
    return np.where(angle, wrapped_deg(made - truth), made - truth)


def wrapped_deg(angle_deg: np.ndarray) -> np.ndarray:
    """The same angles from -180 to 180 deg. Angles in this range are not changed in any bit."""
    return np.where(np.abs(angle_deg) <= HALF_CIRCLE_DEG, angle_deg, (angle_deg + 180) % 360 - 180)


@dataclass(frozen=True)
class LabelCode:
    """Code of K labels as E numbers: a direction is replaced by two numbers, its sine and cosine.

    Attributes
    ----------
    circular : tuple of bool
        Which of the K labels are directions on the whole circle.
    """

    circular: tuple[bool, ...]

    @property
    def label_of(self) -> np.ndarray:
        """(E,) int: the label that each number belongs to."""
        return np.repeat(np.arange(len(self.circular)), np.where(self.circular, 2, 1))

    def encode(self, labels: np.ndarray) -> np.ndarray:
        """Labels (M, K) in mm and deg as numbers (M, E)."""
        parts = []
        for column, circular in zip(labels.T, self.circular, strict=True):
            parts += [np.sin(np.radians(column)), np.cos(np.radians(column))] if circular else [column]
        return np.stack(parts, axis=1) if parts else np.zeros((len(labels), 0))

    def decode(self, numbers: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Labels (B, K) in mm and deg from numbers (B, E), and the labels' expected errors from those of the numbers (both >= 0)."""
        labels = np.empty((2, len(numbers), len(self.circular)))
        for k, circular in enumerate(self.circular):
            mine = self.label_of == k
            if not circular:
                labels[:, :, k] = numbers[:, mine][:, 0], scale[:, mine][:, 0]
                continue
            (sine, cosine), (of_sine, of_cosine) = numbers[:, mine].T, scale[:, mine].T
            square = np.maximum(sine**2 + cosine**2, 1e-12)
            errors = np.degrees(np.hypot(cosine * of_sine, sine * of_cosine) / square)
            labels[:, :, k] = np.degrees(np.arctan2(sine, cosine)), errors
        return labels[0], labels[1]
