"""The convolutional baselines: PoseNet (Lepora 2020) and the paper's smaller version of it.

Frames are resized to 128 x 128. Five 3x3 convolutions with ELU and max-pooling are followed by dense layers with ELU and a small dropout.
``cnn-v1`` has 256 filters and one hidden dense layer of 64 units; ``cnn-v2`` has 48 filters and two such layers.

The pooling is done before the ELU. Because ELU is increasing, the maximum is the same, and ELU is computed for a quarter of the values
only. The channels are last in memory: ``cnn-v2`` then trains twice as fast on a CPU as in the usual order.
"""

import torch
from torch import nn

# Side of the network's input image, px.
INPUT_PX = 128
# Share of the dense layers' inputs that are set to 0 in training.
DROPOUT = 0.06
# Number of convolutions.
LAYERS = 5
# Weights of the L1 and L2 penalties of the hidden dense layers' weights (PoseNet, Lepora 2020).
L1, L2 = 6e-4, 1e-3


class Cnn(nn.Module):
    """See the module.

    Parameters
    ----------
    filters : int
        Number of filters of each convolution.
    dense : tuple of int
        Units of the dense layers before the last one.
    outputs : int
        Number K of labels.
    """

    def __init__(self, filters: int, dense: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for k in range(LAYERS):
            layers += [nn.Conv2d(1 if k == 0 else filters, filters, 3), nn.MaxPool2d(2), nn.ELU()]
        self.convolutions = nn.Sequential(*layers)
        self.convolutions.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # the stubs leave memory_format out
        with torch.no_grad():
            width = self.convolutions(torch.zeros(1, 1, INPUT_PX, INPUT_PX)).numel()
        head: list[nn.Module] = [nn.Dropout(DROPOUT)]
        for units in dense:
            head += [nn.Linear(width, units), nn.ELU(), nn.Dropout(DROPOUT)]
            width = units
        self.dense = nn.Sequential(*head, nn.Linear(width, outputs))

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        """Labels ``mean`` (B, K) from frames (B, 128, 128) uint8."""
        pixels = (images[:, None].float() / 255).contiguous(memory_format=torch.channels_last)
        return {"mean": self.dense(self.convolutions(pixels).flatten(1))}

    def penalty(self) -> torch.Tensor:
        """The regularisation of the hidden dense weights."""
        weights = [layer.weight for layer in list(self.dense)[:-1] if isinstance(layer, nn.Linear)]
        return torch.stack([L1 * w.abs().sum() + L2 * w.square().sum() for w in weights]).sum()
