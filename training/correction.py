"""A trained model's labels, corrected by a few labelled frames of the sensor in hand.

What a model learnt in the twin misses on a real sensor is smooth in what the sensor shows, so it can be learnt from few
frames: a ridge regression of the model's error on a constant, on its own labels and their products, and on the pins' modes
and their products. Which of these are used, and how much of them, the frames decide by leaving each of them out once; the
other frames of the recording have no part in it.
"""

from dataclasses import dataclass

import numpy as np

from training.assemble import conformal_quantile, group_quantiles, kernel_inputs, undone

KINDS = ("offset", "linear", "quadratic", "modes")  # by growing number of terms
RIDGES = 10.0 ** np.arange(-3, 2.1, 0.5)
CONSTANT, PRODUCT = 3.0, 0.3  # sizes of terms beside those of degree one: the larger, the less the ridge holds them back
MODES, MODE_SIZE, MOST = 20, 3.0, 4.0  # modes used, their amplitudes' unit, and where they end


@dataclass(frozen=True)
class Correction:
    """What is added to standardised labels.

    Attributes
    ----------
    weight : (T, K) float
        Of the terms that ``terms`` gives; 0 for those that a label does without.
    """

    weight: np.ndarray

    def __call__(self, mean: np.ndarray, amplitudes: np.ndarray) -> np.ndarray:
        """Correction (B, K) of labels (B, K) of frames whose modes have these amplitudes (B, D)."""
        return np.concatenate(list(terms(mean, amplitudes).values()), axis=1) @ np.asarray(self.weight)


def terms(mean: np.ndarray, amplitudes: np.ndarray) -> dict[str, np.ndarray]:
    """The terms (B, ...) that each of ``KINDS`` adds to those before it."""
    modes = np.clip(amplitudes[:, :MODES] / MODE_SIZE, -MOST, MOST)
    return {
        "offset": np.full((len(mean), 1), CONSTANT),
        "linear": mean,
        "quadratic": _products(mean),
        "modes": np.concatenate([modes, PRODUCT * _products(modes)], axis=1),
    }


def _products(values: np.ndarray) -> np.ndarray:
    i, j = np.triu_indices(values.shape[1])
    return values[:, i] * values[:, j]


def fit_terms(parts: dict[str, np.ndarray], error: np.ndarray) -> tuple[np.ndarray, np.ndarray, list]:
    """Regress what is missing, ``error`` (n, K), on the terms.

    Returns
    -------
    weight : (T, K) float
    left_out : (n, K) float
        Each frame's correction as the others give it.
    chosen : list of dict
        For each label ``kind`` and ``ridge``; kind ``none`` where nothing helped.
    """
    size = sum(part.shape[1] for part in parts.values())
    weight, left_out, chosen = np.zeros((size, error.shape[1])), np.zeros(error.shape), []
    for k, missing in enumerate(error.T):
        best, found = np.abs(missing).mean(), {"kind": "none", "ridge": None}
        for last, kind in enumerate(KINDS, start=1):
            x = np.concatenate([parts[name] for name in KINDS[:last]], axis=1)
            for ridge in RIDGES:
                inverse = np.linalg.solve(x @ x.T + ridge * np.eye(len(x)), np.eye(len(x)))
                dual = inverse @ missing
                predicted = missing - dual / np.diag(inverse)
                if np.abs(missing - predicted).mean() < best:
                    best, found = np.abs(missing - predicted).mean(), {"kind": kind, "ridge": float(ridge)}
                    weight[:, k], left_out[:, k] = 0, predicted
                    weight[: x.shape[1], k] = x.T @ dual
        chosen.append(found)
    return weight, left_out, chosen


def corrected_content(estimator, content: dict, pins, targets, labels: str) -> tuple[dict, list]:
    """A run's content with a correction and intervals from labelled frames.

    Parameters
    ----------
    estimator : PoseEstimator
        Of the run as it is, a ``vgnn``.
    content : dict
        What its ``weights.pt`` holds.
    pins, targets : PinTable, Targets
        n labelled frames that the run has not seen, in one order.
    labels : {"corrected", "raw"}

    Returns
    -------
    dict
        As ``content``.
    list of dict
        What was chosen for each label.
    """
    inputs, rows = estimator.inputs_of(pins, together=not pins.measured)
    ensemble = estimator.ensemble
    mean, scale, executed = ensemble.outputs(inputs, rows)
    amplitudes = kernel_inputs(ensemble.networks[0], inputs, rows).numpy()
    truth, raw = ((getattr(targets, key) - ensemble.shift) / ensemble.scale for key in (labels, "raw"))
    weight, left_out, chosen = fit_terms(terms(mean, amplitudes), truth - mean)
    made = mean + left_out
    intervals = {
        "quantile": conformal_quantile(np.abs(made - truth) / scale),
        "raw_quantile": group_quantiles(np.abs(made - raw) / scale, undone(executed)),
    }
    return content | intervals | {"correction": {"weight": weight}}, chosen
