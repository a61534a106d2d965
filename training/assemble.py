"""From trained networks to a predictor: the Gaussian process beside them, how they are averaged, and honest intervals.

Intervals are conformal (Vovk et al. 2005; Barber et al. 2021 for ensembles): every training row that some network held out
gets the prediction it would have without itself, and the 90 % quantile of its error over its expected scale widens or
narrows the stated intervals. Such a prediction misses the rest of the ensemble, so intervals are rather too wide than too narrow.

The other labels of the same rows (raw where corrected ones were learnt) get intervals of their own. Raw labels err by the
whole move where it was not executed, so frames that look executed and frames that don't have quantiles of their own
(Mondrian conformal prediction, Vovk et al. 2005, 4.5): a narrow and a wide interval instead of one that is wrong for both.
"""

from dataclasses import dataclass

import numpy as np
import torch

from training.cokriging import CoKriging
from training.inputs import PinInputs, graph_inputs, image_inputs, pin_features
from training.kernel import KernelHead, fit_kernel
from training.networks import build_network, predict_rows
from training.registration import Registration, fit_registration
from twin.preprocess import make_graph
from twin.preprocess.reference import Reference
from twin.recordings.forms import frame_size

COVERAGE = 0.9
SMALL_GROUP = 30  # rows, below which a quantile of their own says little
BLENDS = np.linspace(0, 1, 21)
KERNEL_MODES = 30  # of the displacement; all modes of the areas


@dataclass
class Prediction:
    """Labels of B frames.

    Attributes
    ----------
    mean, half_width : (B, K) float
        mm and deg; half of the 90 % interval, of the labels that were learnt.
    half_width_raw : (B, K) float
        The same for the labels as published, whose moves may not have been executed.
    executed : (B,) float
        Probability that the shear move was executed; NaN where the model doesn't tell.
    """

    mean: np.ndarray
    half_width: np.ndarray
    half_width_raw: np.ndarray
    executed: np.ndarray


class Ensemble:
    """Networks, the kernel head, and what turns their outputs into labels and intervals.

    Parameters
    ----------
    content : dict
        As ``calibrate`` gives it and ``weights.pt`` holds it; with ``beside``, a ``CoKriging`` that is averaged with
        the labels of frames as they are.
    """

    def __init__(self, model: str, reference: Reference, content: dict, size: dict) -> None:
        self.shift, self.scale = np.asarray(content["shift"]), np.asarray(content["scale"])
        self.networks = []
        for weights in content["networks"]:
            network = build_network(model, reference, len(self.shift), size)
            network.load_state_dict(weights)
            self.networks.append(network.eval())
        self.kernels = [KernelHead(**kernel) for kernel in content["kernels"]]  # of frames as they are, and displaced ones
        self.kernel_labels = list(content["kernel_labels"])
        self.blend, self.quantile = np.asarray(content["blend"]), np.asarray(content["quantile"])
        self.raw_quantile = np.asarray(content["raw_quantile"])
        self.beside = CoKriging(**content["beside"]) if "beside" in content else None

    def outputs(self, inputs, rows: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Standardised mean and scale (B, K) and the probability (B,) of an executed move."""
        outs = [predict_rows(network, inputs, rows) for network in self.networks]
        mean = np.mean([out["mean"].double().numpy() for out in outs], axis=0)
        if self.kernels:
            chosen = self.kernel_labels
            also = self._kernels_say(inputs, rows)
            mean[:, chosen] = self.blend[chosen] * also + (1 - self.blend[chosen]) * mean[:, chosen]
        return mean, *_scale_and_move(outs)

    def _kernels_say(self, inputs: PinInputs, rows: torch.Tensor) -> np.ndarray:
        seen, share = kernel_inputs(self.networks[0], inputs, rows), inputs.displaced[rows, None]
        said = torch.zeros(1)
        for kernel, part in zip(self.kernels, (1 - share, share), strict=True):
            if bool(part.any()):
                said = said + part * kernel(seen)
        return said.numpy()

    def __call__(self, inputs, rows: torch.Tensor) -> Prediction:
        """Labels of some rows."""
        mean, scale, executed = self.outputs(inputs, rows)
        if self.beside is not None:
            share = (1 - inputs.displaced[rows, None].numpy()) / 2  # nothing to the process, which knows no displaced camera
            mean = (1 - share) * mean + share * self.beside(kernel_inputs(self.networks[0], inputs, rows)).numpy()
        scale = self.scale * scale
        raw = self.raw_quantile[undone(executed)]
        return Prediction(self.shift + self.scale * mean, self.quantile * scale, raw * scale, executed)


def _scale_and_move(outs: list) -> tuple[np.ndarray, np.ndarray]:
    shape = outs[0]["mean"].shape
    scale = np.ones(shape)
    if "log_scale" in outs[0]:
        scale = np.exp(np.mean([out["log_scale"].clamp(-8, 4).double().numpy() for out in outs], axis=0))
    executed = np.full(shape[0], np.nan)
    if "executed" in outs[0]:
        executed = np.mean([torch.sigmoid(out["executed"].double()).numpy() for out in outs], axis=0)
    return scale, executed


def kernel_inputs(network, inputs: PinInputs, rows: torch.Tensor) -> torch.Tensor:
    """What the Gaussian process sees of rows (B, D): the first modes of the displacement and those of the areas."""
    with torch.no_grad():
        amplitudes = network.amplitudes(network.known(*inputs.batch(rows)))
    modes = network.size.modes
    return torch.cat([amplitudes[:, : min(KERNEL_MODES, modes)], amplitudes[:, modes:]], dim=1).double()


def prepared_inputs(model: str, data, train: np.ndarray) -> tuple[object, dict]:
    """Inputs of all rows for a model, and what of their making was learnt from the training rows.

    For ``vgnn`` there are twice as many: row M + k is frame k with all of its similarity's difference taken out.
    """
    pins = data.pins
    if model == "vgnn":
        registration, left = fit_registration(pins.nodes_px[train], pins.reference.pins_px)
        nodes_px, area_px2 = filled(registration, pins.nodes_px, pins.area_px2, pins.lost, pins.reference)
        seated = pin_inputs(registration, nodes_px, area_px2, pins.lost, pins.reference)
        taken = registration.difference(nodes_px)
        taken[train] = left
        displaced = pin_features(*registration.take_out(nodes_px, area_px2, taken), pins.reference)
        both = np.concatenate([seated.x.numpy(), displaced])
        share = np.repeat([0.0, 1.0], len(pins))
        return PinInputs(both, np.concatenate([pins.lost, pins.lost]), share), {"registration": registration.arrays()}
    if model in ("cnn-v1", "cnn-v2"):
        return image_inputs(data), {}
    return graph_inputs(model, pins, frame_width(pins)), {}


def frame_width(pins) -> int:
    """Width in px of a table's frames."""
    return frame_size(pins.sensor, pins.form)[0]


def filled(registration: Registration, nodes_px, area_px2, lost, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """Pins (M, N, 2) and areas (M, N) with lost pins (M, N) where the others' modes put them."""
    nodes_px, area_px2 = nodes_px.copy(), area_px2.copy()
    for k in np.flatnonzero(lost.any(axis=1)):
        nodes_px[k] = registration.fill(nodes_px[k], lost[k])
        area_px2[k] = make_graph("voronoi", nodes_px[k], outmost=reference.outmost).area_px2
    return nodes_px, area_px2


def pin_inputs(registration: Registration, nodes_px, area_px2, lost, reference: Reference, *, together: bool = False) -> PinInputs:
    """Dense features of frames (see ``filled``) whose camera displacement is taken out."""
    nodes, area, _, share = registration(nodes_px, area_px2, together=together)
    return PinInputs(pin_features(nodes, area, reference), lost, share)


def calibrate(config, data, inputs, train: np.ndarray, networks: list, scaling: tuple) -> dict:
    """Fit the kernel head if the recipe has one, the average's weights, and the intervals.

    Returns
    -------
    dict
        ``networks``, ``kernels``, ``shift``, ``scale``, ``blend``, ``quantile``, ``raw_quantile``: what ``Ensemble`` takes.
    """
    shift, scale = scaling
    labels = data.targets.corrected if config.labels == "corrected" else data.targets.raw
    y = (labels - shift) / scale
    k = y.shape[1]
    content = {"networks": [network["weights"] for network in networks], "kernels": [], "shift": shift, "scale": scale}
    main = [j for j, name in enumerate(data.targets.names) if name not in config.helpers]  # the kernel head's labels
    content |= {"blend": np.zeros(k), "quantile": np.ones(k), "raw_quantile": np.ones((2, k)), "kernel_labels": main}
    raw = (data.targets.raw - shift) / scale
    single = [
        Ensemble(config.model, data.pins.reference, content | {"networks": [weights]}, config.size) for weights in content["networks"]
    ]
    left_out = np.full(y.shape, np.nan)
    if config.recipe.kernel:
        for first in (0, len(data)):
            amplitudes = kernel_inputs(single[0].networks[0], inputs, torch.from_numpy(first + train))
            kernel, left = fit_kernel(amplitudes, torch.from_numpy(y[np.ix_(train, main)]), seed=config.seed)
            content["kernels"].append(kernel.arrays())
            if not first:
                left_out[np.ix_(train, main)] = left.numpy()
    parts: list[tuple] = []
    for ensemble, network in zip(single, networks, strict=True):
        held = network["held"].numpy()
        parts.append((*ensemble.outputs(inputs, network["held"]), y[held], raw[held], left_out[held]))
    mean, spread, executed, truth, published, kernel = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(mean):
        return content
    if config.recipe.kernel:
        errors = [np.abs(b * kernel + (1 - b) * mean - truth).mean(axis=0) for b in BLENDS]
        content["blend"][main] = BLENDS[np.argmin(errors, axis=0)][main]
        mean = np.where(content["blend"] > 0, content["blend"] * kernel + (1 - content["blend"]) * mean, mean)
    return content | intervals(mean, truth, published, spread, executed)


def intervals(made: np.ndarray, truth: np.ndarray, published: np.ndarray, scale: np.ndarray, executed: np.ndarray) -> dict:
    """Quantiles of both kinds of labels (n, K), given predictions and their expected scales (n, K) and the probability of a move (n,)."""
    return {
        "quantile": conformal_quantile(np.abs(made - truth) / scale),
        "raw_quantile": group_quantiles(np.abs(made - published) / scale, undone(executed)),
    }


def undone(executed: np.ndarray) -> np.ndarray:
    """1 where a move was more likely not executed than executed, else 0; 0 where the model doesn't tell (NaN)."""
    return (np.nan_to_num(executed, nan=1.0) < 0.5).astype(int)


def group_quantiles(scores: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Conformal quantiles (2, K) of scores (n, K), for each group (n,) of 0 and 1 its own; of all where a group is small."""
    parts = [scores[group == k] for k in (0, 1)]
    return np.stack([conformal_quantile(part if len(part) >= SMALL_GROUP else scores) for part in parts])


def conformal_quantile(scores: np.ndarray, coverage: float = COVERAGE) -> np.ndarray:
    """The (n + 1) ``coverage``-th smallest of scores (n, K), for each column; the largest where n is too small for it."""
    n = len(scores)
    place = min(int(np.ceil((n + 1) * coverage)), n) - 1
    return np.sort(scores, axis=0)[place]
