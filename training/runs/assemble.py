"""Assembly of a predictor from trained networks: averages of networks and Gaussian processes, and calibrated intervals.

Intervals are conformal (Vovk et al. 2005; Barber et al. 2021 for ensembles). Every training row that a network held out is predicted by
this network. Each error is divided by its expected scale. The 90 % quantile of these ratios is the factor that widens or narrows the stated
intervals. Such a prediction is made by one network and not by the whole ensemble, so the intervals are too wide rather than too narrow.

The intervals for raw labels are calibrated separately, because a raw label is wrong by the whole move if the move was not executed.
Frames whose move looks executed, and frames whose move does not, have separate quantiles (Mondrian conformal prediction, Vovk et al.
2005, section 4.5). This gives one narrow and one wide interval instead of a common one that fits neither group.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np
import torch

from training.data.dataset import Dataset
from training.data.label_code import LabelCode, label_error
from training.models import model_named
from training.models.part import Inputs, Model, Modes, Prediction, Prepared
from training.runs.config import RunConfig, training_labels
from training.runs.gaussian_process import SMOOTH_AND_LINEAR, TWO_FIDELITIES, Points, Processes, fit_processes, fit_smooth_processes
from training.runs.loop import predict_rows
from twin.errors import warn_once
from twin.pins.labelling.reference import Reference

# Share of the labels that should lie inside their intervals.
COVERAGE = 0.9
# Least number of held-out errors: among n errors, the largest one stands for the quantile n / (n + 1), which must be at least COVERAGE.
LEAST_HELD = 9
# Rows of a group below which the quantile of all rows is used, because so few rows give no reliable quantile of their own.
SMALL_GROUP = 30
# Weights of the Gaussian process in its average with the networks that are tried; the one with the smallest error is used.
BLENDS = np.linspace(0, 1, 21)
# Weight of the process ``beside`` in its average with the networks. It is not fitted, because both learn from the same labelled frames.
PROCESS_SHARE = 0.5


class Ensemble:
    """Networks and Gaussian processes, and the parameters that turn their outputs into labels and intervals.

    Parameters
    ----------
    model : Model
    reference : Reference
        The pins at rest in training.
    content : dict
        The result of ``calibrate``, which ``weights.pt`` holds. If it has the key ``beside``, with the arrays of a process of two
        fidelities, this process is averaged with the labels in view 0.
    size : dict
        Sizes of the networks that differ from the model's own.
    """

    def __init__(self, model: Model, reference: Reference, content: dict, size: Mapping[str, int]) -> None:
        self.model = model
        self.shift, self.scale = np.asarray(content["shift"]), np.asarray(content["scale"])
        self.networks = []
        for weights in content["networks"]:
            network = model.build(reference, len(self.shift), size)
            network.load_state_dict(weights)
            self.networks.append(network.eval())
        self.kernels = [Processes.of_arrays(SMOOTH_AND_LINEAR, arrays) for arrays in content["kernels"]]  # one for each view
        self.kernel_labels = list(content["kernel_labels"])
        self.blend, self.quantile = np.asarray(content["blend"]), np.asarray(content["quantile"])
        self.raw_quantile = np.asarray(content["raw_quantile"])
        self.beside = Processes.of_arrays(TWO_FIDELITIES, content["beside"]) if "beside" in content else None
        none_circular = np.zeros(len(self.shift))  # for runs of earlier versions, which had no directions
        self.code = LabelCode(tuple(bool(circular) for circular in np.asarray(content.get("circular", none_circular))))

    def outputs(self, inputs: Inputs, rows: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Standardised mean and scale (B, E) of the labels' numbers (``LabelCode``), and the probability (B,) of an executed move."""
        outs = [predict_rows(network, inputs, rows) for network in self.networks]
        mean = np.mean([out["mean"].double().numpy() for out in outs], axis=0)
        if self.kernels:
            chosen = self.kernel_labels
            also = self._kernels_say(self.modes(inputs, rows))
            mean[:, chosen] = self.blend[chosen] * also + (1 - self.blend[chosen]) * mean[:, chosen]
        scale, executed = np.ones(mean.shape), np.full(len(mean), np.nan)
        if "log_scale" in outs[0]:
            scale = np.exp(np.mean([out["log_scale"].clamp(-8, 4).double().numpy() for out in outs], axis=0))
        if "executed" in outs[0]:
            executed = np.mean([torch.sigmoid(out["executed"].double()).numpy() for out in outs], axis=0)
        return mean, scale, executed

    def modes(self, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """The inputs of the Gaussian processes for some rows (B,): the first network's modes."""
        return self.model.modes(self.networks[0], inputs, rows)

    def _kernels_say(self, modes: Modes) -> np.ndarray:
        """(B, k) standardised numbers: the mean over the views of a row, weighted by the row's share in each view."""
        share = modes.share[:, None]
        said = np.zeros((len(modes.inputs), len(self.kernel_labels)))
        for kernel, part in zip(self.kernels, (1 - share, share), strict=False):
            if part.any():
                said = said + part * kernel(Points.of(modes.inputs))
        return said

    def __call__(self, inputs: Inputs, rows: torch.Tensor) -> Prediction:
        """Labels of some rows."""
        mean, scale, executed = self.outputs(inputs, rows)
        if self.beside is not None:
            modes = self.modes(inputs, rows)
            share = PROCESS_SHARE * (1 - modes.share[:, None])  # 0 in view 1, because the process has not seen a displaced camera
            mean = (1 - share) * mean + share * self.beside(Points.of(modes.inputs, second=True))
        labels, scale = self.destandardise(mean, scale)
        raw = self.raw_quantile[undone(executed)]
        return Prediction(labels, self.quantile * scale, raw * scale, executed)

    def destandardise(self, mean: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Labels and their expected errors (B, K), mm and deg, from standardised numbers and theirs (B, E)."""
        return self.code.decode(self.shift + self.scale * mean, self.scale * scale)

    def standardise(self, labels: np.ndarray) -> np.ndarray:
        """Standardised numbers (M, E) of labels (M, K) in mm and deg."""
        return (self.code.encode(labels) - self.shift) / self.scale


def calibrate(
    config: RunConfig, data: Dataset, prepared: Prepared, train: np.ndarray, networks: list[dict], code: LabelCode, scaling: tuple
) -> dict:
    """Fit the Gaussian processes if the recipe has them, the weights of the average, and the intervals.

    Parameters
    ----------
    train : (m,) int
        Training rows.
    networks : list of dict
        For each network its ``weights``, and ``held``: the rows that it was not trained on.
    code : LabelCode
        Code that writes the K labels as E numbers.
    scaling : (E,) float, (E,) float
        Shift and scale of these numbers.

    Returns
    -------
    dict
        ``networks``, ``kernels``, ``circular``, ``shift``, ``scale``, ``blend``, ``quantile`` and ``raw_quantile``: the content of
        ``Ensemble``.
    """
    (shift, scale), model, kernel = scaling, model_named(config.model), config.recipe.kernel
    learnt = training_labels(data, config)
    y = (code.encode(learnt) - shift) / scale
    k, e = learnt.shape[1], y.shape[1]
    main = np.flatnonzero(~np.isin(data.targets.names, config.helpers)[code.label_of])  # numbers that the processes estimate
    content: dict = {"networks": [network["weights"] for network in networks], "kernels": [], "shift": shift, "scale": scale}
    content |= {"blend": np.zeros(e), "quantile": np.ones(k), "raw_quantile": np.ones((2, k)), "kernel_labels": main.tolist()}
    content["circular"] = np.array(code.circular, np.int64)
    single = [Ensemble(model, data.pins.reference, content | {"networks": [weights]}, config.size) for weights in content["networks"]]
    left_out = np.full(y.shape, np.nan)
    if kernel:
        group = None if data.group is None else data.group[train]
        fit = fit_smooth_processes if model.modes_scaled else partial(fit_processes, seed=config.seed)
        for view in range(prepared.views):
            modes = single[0].modes(prepared.inputs, torch.from_numpy(view * len(data) + train))
            known = y[np.ix_(train, main)]
            processes, left = fit(modes.inputs, known, group=group)
            content["kernels"].append(processes.arrays())
            if view == 0:
                left_out[np.ix_(train, main)] = left
    parts: list[tuple] = []
    for ensemble, network in zip(single, networks, strict=True):
        held = network["held"].numpy()
        parts.append((*ensemble.outputs(prepared.inputs, network["held"]), y[held], left_out[held], learnt[held], data.targets.raw[held]))
    mean, spread, executed, truth, said, known, published = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(mean):
        return content
    if len(mean) < LEAST_HELD:
        warn_once(f"90 % intervals from {len(mean)} frames that training did not see are too narrow; {LEAST_HELD} or more are needed")
    if kernel:
        errors = [np.abs(b * said + (1 - b) * mean - truth).mean(axis=0) for b in BLENDS]
        content["blend"][main] = BLENDS[np.argmin(errors, axis=0)][main]
        mean = np.where(content["blend"] > 0, content["blend"] * said + (1 - content["blend"]) * mean, mean)
    return content | intervals(*single[0].destandardise(mean, spread), known, published, executed, data.targets.units)


def intervals(
    made: np.ndarray, scale: np.ndarray, truth: np.ndarray, published: np.ndarray, executed: np.ndarray, units: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """Quantiles for corrected and for raw labels (n, K), from estimates and expected errors (n, K) and the probability of a move (n,)."""
    return {
        "quantile": conformal_quantile(np.abs(label_error(made, truth, units)) / scale),
        "raw_quantile": group_quantiles(np.abs(label_error(made, published, units)) / scale, undone(executed)),
    }


def undone(executed: np.ndarray) -> np.ndarray:
    """1 for moves that were more likely not executed than executed, else 0; also 0 if the model gives no probability (NaN)."""
    return (np.nan_to_num(executed, nan=1.0) < 0.5).astype(int)


def group_quantiles(scores: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Conformal quantiles (2, K) of scores (n, K), for each group (n,) of 0 and 1. A small group gets the quantile of all rows."""
    parts = [scores[group == k] for k in (0, 1)]
    return np.stack([conformal_quantile(part if len(part) >= SMALL_GROUP else scores) for part in parts])


def conformal_quantile(scores: np.ndarray, coverage: float = COVERAGE) -> np.ndarray:
    """The (n + 1) ``coverage``-th smallest of the scores (n, K) in each column; the largest if n is too small."""
    n = len(scores)
    place = min(int(np.ceil((n + 1) * coverage)), n) - 1
    return np.sort(scores, axis=0)[place]
