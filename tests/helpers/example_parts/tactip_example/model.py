"""A model that sees the mean displacement of the pins alone."""

from dataclasses import dataclass

import torch
from torch import nn

from twin.extend import PinModel, Recipe, refuse_sizes


class Means:
    """Mean displacements in spacings (B, 2)."""

    def __init__(self, values) -> None:
        self.values = torch.as_tensor(values, dtype=torch.float32)

    def __len__(self) -> int:
        return len(self.values)

    def batch(self, rows):
        return (self.values[rows],)


class Line(nn.Module):
    """A linear layer."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.layer = nn.Linear(2, outputs)

    def forward(self, x):
        return {"mean": self.layer(x)}


@dataclass(frozen=True, kw_only=True)
class MeanModel(PinModel):
    """A line through mean displacements."""

    counts_from_rest = True

    def build(self, reference, outputs, size):
        refuse_sizes(self, size)
        return Line(outputs)

    def inputs(self, pins, learnt, reference, *, together):
        return Means(((pins.nodes_px - pins.reference.pins_px) / reference.spacing_px[:, None]).mean(axis=1))


MEAN = MeanModel(name="example-mean", description="a line through mean displacements", recipe=Recipe(epochs=2, members=1))
