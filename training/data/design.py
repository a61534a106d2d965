"""Choice of labelled contacts that fill the ranges of their labels evenly."""

from collections.abc import Sequence

import numpy as np

from training.data.label_code import LabelCode, goes_round


def nearest_to_even(labels: np.ndarray, units: Sequence[str], count: int, *, seed: int) -> np.ndarray:
    """Different rows (count,) of a recording that are nearest to contacts spread evenly over its labels (M, K). The first rows alone are
    also spread evenly.

    So a random collection gives frames like those of ``twin collect --design even``.

    Parameters
    ----------
    seed : int
        Seed of the even sequence, a scrambled Sobol sequence.
    """
    from scipy.stats.qmc import Sobol

    code = LabelCode(goes_round(units, labels))
    low, high = labels.min(axis=0), labels.max(axis=0)
    circular, varied = np.array(code.circular), np.flatnonzero(high > low)

    def encode_places(those: np.ndarray) -> np.ndarray:
        return code.encode(np.where(circular, those, (those - low) / np.maximum(high - low, 1e-12)))

    even = Sobol(len(varied), scramble=True, rng=np.random.default_rng(seed)).random_base2(int(np.ceil(np.log2(max(count, 2)))))
    wanted = np.tile(low, (count, 1))
    wanted[:, varied] += even[:count] * (high - low)[varied]
    places, free = encode_places(labels), np.ones(len(labels), bool)
    chosen = []
    for place in encode_places(wanted):
        far = np.where(free, ((places - place) ** 2).sum(axis=1), np.inf)
        chosen.append(int(far.argmin()))
        free[chosen[-1]] = False
    return np.array(chosen)
