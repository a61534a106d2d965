"""How many of some rows' principal components are directions, and not rounding."""

import numpy as np

LEAST_SIZE = 1e-5  # of a mode, relative to the largest: features are in single precision, whose rounding is 1e-7 of each of their numbers


def spanned(sizes: np.ndarray, most: int) -> int:
    """How many modes to keep, at most ``most``, of centred rows with these singular values, largest first.

    M rows span M - 1 directions at most. The modes after those are made of rounding errors: scaled to unit deviation, they would
    turn the rounding errors of other rows into amplitudes of thousands.
    """
    return int((sizes[:most] > LEAST_SIZE * sizes[0]).sum())
