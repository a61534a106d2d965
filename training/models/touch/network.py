"""The network of ``touch``: the sum of a multi-layer perceptron and a linear map.

Outside the range of its training data, a network's own error scale has no meaning. Therefore the distance by which a feature exceeds its
largest value in training is added to the error scale, in standard deviations of the label.
"""

import torch
from torch import nn

LEAST_BEYOND = 1e-6
"""Distance that counts as zero."""


class TouchNetwork(nn.Module):
    """Labels and their error scales from features (B, D).

    Parameters
    ----------
    features : int
        Number D of features.
    outputs : int
        Number K of labels.
    width, depth : int
        Units of a hidden layer, and number of them.
    """

    limit: torch.Tensor  # (D,) largest size of each feature in training

    def __init__(self, features: int, outputs: int, *, width: int, depth: int) -> None:
        super().__init__()
        self.outputs = outputs
        self.register_buffer("limit", torch.full((features,), torch.inf))
        self.linear = nn.Linear(features, outputs)
        nn.init.zeros_(self.linear.weight)
        self.hidden = nn.ModuleList([nn.Linear(features if k == 0 else width, width) for k in range(depth)])
        self.head = nn.Linear(width, 2 * outputs)

    def forward(self, x: torch.Tensor) -> dict[str, torch.Tensor]:
        """``mean`` (B, K) and ``log_scale`` (B, K), standardised."""
        h = x
        for layer in self.hidden:
            h = nn.functional.silu(layer(h))
        out = self.head(h)
        beyond = (x.abs() / self.limit - 1).amax(dim=1, keepdim=True).clamp(min=LEAST_BEYOND)
        scale = torch.logaddexp(out[:, self.outputs :], beyond.log())
        return {"mean": out[:, : self.outputs] + self.linear(x), "log_scale": scale}
