"""Choice of the next labelled contact that reduces the uncertainty most: active learning by the least expected variance (Cohn 1994).

The pins' leading modes are modelled as Gaussian processes of the labels that vary. A contact at a label lowers the posterior variance
around it. The next contact is the candidate that lowers the mean variance over the experiment's ranges most.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats.qmc import Sobol

from scenes.experiment import LABELS, ExperimentSpec
from scenes.sensor import SensorSpec
from training.data.label_code import LabelCode, goes_round
from training.data.targets import unit_of
from training.runs.gaussian_process import Points, Posterior, fit_smooth_processes
from twin.frames import open_recording
from twin.frames.tables import numbers
from twin.pins import Pipeline
from twin.pins.batch import recording_reference

CANDIDATES = 256
"""Number of candidates for the next contact, spread evenly over the ranges."""
WHERE = 128
"""Number of contacts over which the variance is averaged, spread evenly over the ranges."""
MODES = 12
"""Number of leading modes of the pins' displacement that are used. They contain nearly all of it."""


class LeastSure:
    """Chooses the next contact of a collection. It is called with the collection's folder, its experiment, a seed and the contact's number.

    Parameters
    ----------
    sensor : SensorSpec
    """

    def __init__(self, sensor: SensorSpec) -> None:
        self.sensor = sensor
        self._moved: dict[str, np.ndarray] = {}

    def __call__(self, folder: Path, experiment: ExperimentSpec, seed: int, index: int) -> np.ndarray:
        """The next contact's pose and move (12,), mm and deg.

        Raises
        ------
        FrameError
            The folder holds no labelled frames of the sensor.
        """
        recording = open_recording(folder, self.sensor)
        reference, _ = recording_reference(self.sensor, recording, [])
        pipeline = Pipeline(self.sensor, recording.form, reference)
        for row, name in enumerate(recording.names):
            if name not in self._moved:
                seen = pipeline(recording.read(row))
                nothing = np.zeros_like(reference.pins_px)
                self._moved[name] = nothing if seen.graph is None else seen.graph.nodes_px - reference.pins_px
        told = np.column_stack([numbers(recording.labels[name]) for name in LABELS])
        return least_sure(experiment, told, np.stack([self._moved[name] for name in recording.names]), seed=seed + index)


def least_sure(experiment: ExperimentSpec, labels: np.ndarray, moved_px: np.ndarray, *, seed: int) -> np.ndarray:
    """The next contact's pose and move (12,) after contacts with these labels (M, 12) and displacements (M, N, 2), px.

    Parameters
    ----------
    seed : int
        Seed of the choice of the candidates.
    """
    low, high = np.array(list(experiment.ranges().values())).T
    varied = np.flatnonzero(high > low)
    units = [unit_of(LABELS[k]) for k in varied]
    code = LabelCode(goes_round(units, np.stack([low[varied], high[varied]])))
    middle, half = (low + high)[varied] / 2, (high - low)[varied] / 2
    round_trip = np.array(code.circular)

    def scaled(those: np.ndarray) -> np.ndarray:
        return code.encode(np.where(round_trip, those[:, varied], (those[:, varied] - middle) / half))

    flat = moved_px.reshape(len(moved_px), -1)
    left, sizes, _ = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    kept = min(MODES, len(labels) - 1)
    amplitudes = (left * sizes)[:, :kept]
    spreads = np.maximum(amplitudes.std(axis=0), 1e-9)
    processes, _ = fit_smooth_processes(scaled(labels), amplitudes / spreads)
    candidates = _even(low, high, CANDIDATES, np.random.default_rng([seed, 0]))
    asked = Points.of(scaled(np.concatenate([candidates, _even(low, high, WHERE, np.random.default_rng([seed, 1]))])))
    gain = np.zeros(CANDIDATES)
    for kernel, size in zip(processes.kernels, spreads, strict=True):
        shared = Posterior(kernel, processes.points, np.zeros(len(labels))).covariance(asked)
        own = np.diag(shared)[:CANDIDATES] + kernel.noises[0] ** 2
        gain += size**2 * (shared[:CANDIDATES, CANDIDATES:] ** 2).mean(axis=1) / own
    return np.asarray(candidates[int(np.argmax(gain))])


def nearest_to_even(labels: np.ndarray, units: Sequence[str], count: int, *, seed: int) -> np.ndarray:
    """Different rows (count,) of a recording that are nearest to contacts spread evenly over its labels (M, K). The first rows alone are
    also spread evenly.

    In this way a random collection gives frames like those of ``twin collect --design even``.

    Parameters
    ----------
    seed : int
        Seed of the even sequence, a scrambled Sobol sequence.
    """
    code = LabelCode(goes_round(units, labels))
    low, high = labels.min(axis=0), labels.max(axis=0)
    circular = np.array(code.circular)

    def placed(those: np.ndarray) -> np.ndarray:
        return code.encode(np.where(circular, those, (those - low) / np.maximum(high - low, 1e-12)))

    power = int(np.ceil(np.log2(max(count, 2))))
    wanted = _even(low, high, 2**power, np.random.default_rng(seed))
    places, free = placed(labels), np.ones(len(labels), bool)
    chosen = []
    for place in placed(wanted)[:count]:
        far = np.where(free, ((places - place) ** 2).sum(axis=1), np.inf)
        chosen.append(int(far.argmin()))
        free[chosen[-1]] = False
    return np.array(chosen)


def _even(low: np.ndarray, high: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Labels (count, K) that fill the ranges (K,) evenly: a scrambled Sobol sequence; ``count`` is a power of two."""
    varied = np.flatnonzero(high > low)
    found = np.tile(low, (count, 1))
    found[:, varied] += Sobol(len(varied), scramble=True, rng=rng).random(count) * (high - low)[varied]
    return found
