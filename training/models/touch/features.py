"""Features of ``touch``: the information in a frame's pins as a few numbers.

- modes: amplitudes of the principal components of all displacements, in rest spacings;
- relative modes: the same for the displacements divided by their size plus a small number. They show place and kind of a light contact,
  which is small among the modes of deep contacts;
- light: amplitudes of the principal components of the caps' brightness. A cap brightens as it moves towards the LEDs, and the whole
  picture darkens as the LEDs warm up.

Mode k is scaled to the standard deviation sqrt(s_k / s_0), with s_k the singular values: small modes carry finer detail.
"""

from dataclasses import dataclass

import numpy as np

from training.models.vgnn.registration import count_modes

SMALL = 0.15
"""Size, in rest spacings times the root of the number of coordinates, below which displacements are noise rather than a contact."""

MOST_LOST = 0.1
"""Largest share of the training frames in which a used pin may be lost."""


@dataclass(frozen=True)
class Bases:
    """Means and directions of the three kinds of modes, fitted to training frames.

    Attributes
    ----------
    moved_mean, relative_mean : (2 N,) float
    moved, relative : (2 N, m) float
    light_mean : (N,) float
    light : (N, l) float
    small : (1,) float
        Norm of the displacements that is added before the division, rest spacings.
    seen : (N,) float
        1 for pins that were found in most training frames, 0 for the others. These are left out, because their places are mostly guesses.
    """

    moved_mean: np.ndarray
    moved: np.ndarray
    relative_mean: np.ndarray
    relative: np.ndarray
    light_mean: np.ndarray
    light: np.ndarray
    small: np.ndarray
    seen: np.ndarray

    def __call__(self, moved: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Features (M, D) of displacements (M, 2 N), rest spacings, and levels (M, N)."""
        moved, light = moved * np.repeat(self.seen, 2), light * self.seen
        return np.concatenate(
            [
                (moved - self.moved_mean) @ self.moved,
                (self.relative_of(moved) - self.relative_mean) @ self.relative,
                (light - self.light_mean) @ self.light,
            ],
            axis=1,
        )

    def relative_of(self, moved: np.ndarray) -> np.ndarray:
        """Displacements (M, 2 N) divided by their norm plus ``small``."""
        return moved / (np.linalg.norm(moved, axis=1, keepdims=True) + self.small)

    @classmethod
    def learn_bases(cls, moved: np.ndarray, light: np.ndarray, lost: np.ndarray, *, modes: int, light_modes: int) -> "Bases":
        """Learn the bases from displacements (m, 2 N), levels (m, N) and lost pins (m, N) of training frames."""
        seen = (lost.mean(axis=0) <= MOST_LOST).astype(float)
        if not seen.any():
            seen[:] = 1.0
        moved, light = moved * np.repeat(seen, 2), light * seen
        small = np.array([SMALL * np.sqrt(moved.shape[1])])
        relative = moved / (np.linalg.norm(moved, axis=1, keepdims=True) + small)
        means = [values.mean(axis=0) for values in (moved, relative, light)]
        directions = [
            _directions(values - mean, count)
            for values, mean, count in zip((moved, relative, light), means, (modes, modes, light_modes), strict=True)
        ]
        return cls(means[0], directions[0], means[1], directions[1], means[2], directions[2], small, seen)


def _directions(centred: np.ndarray, count: int) -> np.ndarray:
    """Directions (D, count) of the largest modes of centred rows (m, D), scaled as in the module's docstring; missing modes are 0."""
    _, sizes, rows = np.linalg.svd(centred, full_matrices=False)
    found = np.zeros((centred.shape[1], count))
    if sizes.size and sizes[0] > 0:
        keep = count_modes(sizes, count)
        found[:, :keep] = rows[:keep].T * np.sqrt(len(centred) / (sizes[:keep] * sizes[0]))
    return found
