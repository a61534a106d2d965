"""Every model by name: how it is built, and what it is told when training starts."""

import numpy as np
import torch
from torch import nn

from training.models.cnn import Cnn
from training.models.gcn import Gcn
from training.models.vgnn import Vgnn, VgnnSize
from training.recipes import TrainingError
from twin.preprocess.reference import Reference
from twin.preprocess.voronoi import directed_edges, triangulate

DESCRIPTIONS = {
    "vgnn": "ours: Voronoi graph network on matched pins, with pin modes, ensemble and calibrated intervals",
    "gnn": "the paper's graph network on nearest neighbours, without areas",
    "tac-vgnn": "the paper's network on Delaunay graphs with Voronoi areas",
    "tac-vgnn-release": "the same with the dense layers of the published code",
    "cnn-v1": "PoseNet: 5 convolutions of 256 filters",
    "cnn-v2": "5 convolutions of 48 filters, one more dense layer",
}


def build_network(model: str, reference: Reference, outputs: int, size: dict | None = None) -> nn.Module:
    """A network with random weights.

    Parameters
    ----------
    model : str
        A name of ``DESCRIPTIONS``.
    reference : Reference
        The pins at rest, whose Delaunay graph ``vgnn`` works on.
    outputs : int
        Number of labels.
    size : dict, optional
        Fields of ``VgnnSize``, for ``vgnn`` only.
    """
    if model == "vgnn":
        edges = directed_edges(triangulate(reference.pins_px), len(reference.pins_px))
        return Vgnn(np.asarray(edges), len(reference.pins_px), outputs, VgnnSize(**(size or {})))
    if model in ("cnn-v1", "cnn-v2"):
        return Cnn(model, outputs)
    features = 2 if model == "gnn" else 3
    return Gcn(features, outputs, "release" if model == "tac-vgnn-release" else "paper")


def parameter_count(network: nn.Module) -> int:
    """Trainable numbers."""
    return sum(p.numel() for p in network.parameters())


def device_of(network: nn.Module) -> torch.device:
    """Where a network's numbers lie."""
    return next(network.parameters()).device


def choose_device(name: str) -> str:
    """``cpu`` or ``cuda`` for ``auto`` (a GPU where there is one), ``cpu`` or ``cuda``.

    Raises
    ------
    TrainingError
        For another name, or ``cuda`` where PyTorch finds none.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise TrainingError(f"--device must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("--device cuda: PyTorch finds no GPU here; give --device cpu, or install a PyTorch built for your GPU")
    return "cuda" if name != "cpu" and torch.cuda.is_available() else "cpu"


def predict_rows(network: nn.Module, inputs, rows: torch.Tensor, batch: int = 256) -> dict[str, torch.Tensor]:
    """The network's outputs for some rows, in evaluation mode, on the CPU."""
    if network.training:
        network.eval()
    parts: list[dict] = []
    with torch.no_grad():
        for chosen in rows.split(batch):
            out = network(*(part.to(device_of(network)) for part in inputs.batch(chosen)))
            parts.append({key: value.cpu() for key, value in out.items()})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
