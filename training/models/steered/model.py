"""``steered``: our model of an edge's direction, a label that goes round the whole circle."""

from collections.abc import Mapping
from dataclasses import fields
from typing import cast

import numpy as np
import torch
from torch import nn

from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import ArrayInputs, Inputs, Learnt, Modes, PinModel, Weights, refuse_sizes
from training.models.recipes import Recipe
from training.models.steered.field import waves_of
from training.models.steered.network import Steered, SteeredSize
from twin.pins.labelling.reference import Reference

# Buffers that a small copy leaves out, because they follow from the pins at rest.
DERIVED = ("fit", "order")
# Components of the turned field that are inputs of a Gaussian process. Finer ones are noise to it.
PROCESS_MODES = 20


class SteeredModel(PinModel):
    """See the module. Unlike ``vgnn``, it does not detect that the camera sits at another place than in training."""

    counts_from_rest = True
    has_modes = True

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> Steered:
        """See ``Model``; sizes are the fields of ``SteeredSize``."""
        refuse_sizes(self, size, tuple(field.name for field in fields(SteeredSize)))
        return Steered(waves_of(reference.pins_px), outputs, SteeredSize(**size))

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> ArrayInputs:
        """See ``PinModel``: displacements from rest (M, N, 2) in mean rest spacings. A lost pin is where its neighbours predict it."""
        return ArrayInputs(((pins.nodes_px - pins.reference.pins_px) / reference.spacing_px.mean()).astype(np.float32))

    def initialise(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor, numbers: torch.Tensor, code: LabelCode) -> None:
        """See ``Model``. Sets the principal components, and the turning sense in which the direction's label grows.

        Raises
        ------
        TrainingError
            Not exactly one label goes round the whole circle.
        """
        if sum(code.circular) != 1:
            raise TrainingError(
                f"{self.name} is for labels of which one is a direction on the whole circle, these have {sum(code.circular)}; train vgnn"
            )
        cast(Steered, network).prepare(inputs.batch(rows)[0], numbers[rows], code)

    def modes(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """See ``Model``. The inputs are the network's estimates, and the first components of the field after it is turned by them."""
        with torch.no_grad():
            numbers, seen = cast(Steered, network).view(*inputs.batch(rows))
        found = torch.cat([numbers, seen[:, :PROCESS_MODES]], dim=1).double().numpy()
        return Modes(found, np.zeros(len(found)))

    def pack(self, weights: Weights) -> Weights:
        """See ``Model``. Leaves out the arrays that follow from the pins at rest."""
        return {key: value for key, value in weights.items() if key not in DERIVED}

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """See ``Model``."""
        return packed | {key: blank[key] for key in DERIVED}


STEERED = SteeredModel(
    name="steered",
    description="ours for an edge's direction: the displacements, turned to the estimated direction and evaluated again",
    recipe=Recipe(epochs=80, batch=128, members=2),
)
