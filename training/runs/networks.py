"""Functions for all networks: their size, their device, their outputs for many rows."""

import torch
from torch import nn

from training.errors import TrainingError
from training.models.part import Inputs
from twin.errors import OptionError


def parameter_count(network: nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(p.numel() for p in network.parameters())


def device_of(network: nn.Module) -> torch.device:
    """The device that holds a network's parameters."""
    return next(network.parameters()).device


def choose_device(name: str) -> str:
    """``cpu`` or ``cuda`` for ``auto`` (a GPU where there is one), ``cpu`` or ``cuda``.

    Raises
    ------
    OptionError
        The name is another one.
    TrainingError
        It is ``cuda``, and PyTorch finds no GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise OptionError(f"`device` must be auto, cpu or cuda, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("`device` cuda: PyTorch finds no GPU here; give `device` cpu, or install a PyTorch built for your GPU")
    return "cuda" if name != "cpu" and torch.cuda.is_available() else "cpu"


def predict_rows(network: nn.Module, inputs: Inputs, rows: torch.Tensor, batch: int = 256) -> dict[str, torch.Tensor]:
    """The network's outputs for some rows, in evaluation mode, on the CPU."""
    if network.training:
        network.eval()
    parts: list[dict[str, torch.Tensor]] = []
    with torch.no_grad():
        for chosen in rows.split(batch):
            out = network(*(part.to(device_of(network)) for part in inputs.batch(chosen)))
            parts.append({key: value.cpu() for key, value in out.items()})
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
