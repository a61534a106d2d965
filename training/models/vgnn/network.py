"""Our network: a graph network on the displacement and the Voronoi area of every pin.

Pins have a fixed order. Therefore all frames are dense arrays over one graph, the Delaunay graph of the layout at rest, and averaging
over neighbours is one product with a fixed (N, N) matrix. Each node's features are its displacement (in rest spacings) and the
logarithm of the ratio of its Voronoi cell's area to the area at rest. There are two branches:

- graph: layers ``h + silu(h U + (A h) W + e)``, where A is the attention-weighted mean over neighbours and e an embedding of the pin.
  They are pooled with the graph's smoothest Laplacian eigenvectors, because a mean over the pins would lose where something happens;
- modes: the amplitudes of the principal components of all displacements, and of the areas averaged over neighbours.

From both branches a multi-layer perceptron with skip connections computes the labels, the logarithm of each label's error scale, and the
logit of the probability that the shear move was executed.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from torch import nn

from training.models.vgnn.registration import count_modes

# Features of a node: dx, dy and the logarithm of the area ratio.
FEATURES = 3
# Penalty of the least-squares fit of modes by which lost pins are filled in.
FILL_RIDGE = 1e-3


@dataclass(frozen=True)
class VgnnSize:
    """Sizes of the network. There is no graph branch if ``layers`` is 0, and no modes branch if ``modes`` and ``area_modes`` are 0."""

    channels: int = 6
    layers: int = 1
    frequencies: int = 12
    modes: int = 40
    area_modes: int = 12
    width: int = 192
    depth: int = 3


class Vgnn(nn.Module):
    """See the module.

    Parameters
    ----------
    edges : (E, 2) int
        Directed edges of the layout at rest, in both directions.
    pins : int
        Number N of pins.
    outputs : int
        Number K of labels.
    """

    adjacency: torch.Tensor  # (N, N) 1 if the column's pin is a neighbour of the row's pin, else 0
    scale: torch.Tensor  # (FEATURES,) deviation of each feature
    smoothing: torch.Tensor  # (N, N) mean over a pin and its neighbours
    components: torch.Tensor  # (2 N, modes)
    mode_mean: torch.Tensor  # (2 N,)
    area_components: torch.Tensor  # (N, area_modes)
    area_mean: torch.Tensor  # (N,)
    waves: torch.Tensor  # (N, frequencies)

    def __init__(self, edges: np.ndarray, pins: int, outputs: int, size: VgnnSize | None = None) -> None:
        super().__init__()
        self.size = size = size or VgnnSize()
        self.pins, self.outputs = pins, outputs
        self._weights: torch.Tensor | None = None
        adjacency = torch.zeros(pins, pins)
        adjacency[edges[:, 1], edges[:, 0]] = 1.0
        self.register_buffer("adjacency", adjacency)
        self.register_buffer("scale", torch.ones(FEATURES))
        around = adjacency + torch.eye(pins)
        self.register_buffer("smoothing", around / around.sum(dim=1, keepdim=True))
        self.register_buffer("components", torch.zeros(2 * pins, size.modes))
        self.register_buffer("mode_mean", torch.zeros(2 * pins))
        self.register_buffer("area_components", torch.zeros(pins, size.area_modes))
        self.register_buffer("area_mean", torch.zeros(pins))
        if size.layers:
            c = size.channels
            self.attention = nn.Parameter(torch.zeros(pins, pins))
            self.embedding = nn.ParameterList([nn.Parameter(0.3 * torch.randn(pins, c)) for _ in range(size.layers)])
            fan = [FEATURES] + [c] * (size.layers - 1)
            self.layers = nn.ModuleList([nn.Linear(2 * f, c, bias=False) for f in fan])
            self.register_buffer("waves", laplacian_waves(adjacency, size.frequencies))
        entered = size.modes + size.area_modes + (size.channels * size.frequencies if size.layers else 0)
        self.linear = nn.Linear(entered, outputs)
        nn.init.zeros_(self.linear.weight)
        self.enter = nn.Linear(entered, size.width)
        self.trunk = nn.ModuleList([nn.Linear(size.width, size.width) for _ in range(size.depth - 1)])
        self.head = nn.Linear(size.width, 2 * outputs + 1)

    def prepare(self, x: torch.Tensor) -> None:
        """Set the scales of the features and the principal components from training features (M, N, F) of frames without lost pins."""
        self.scale.copy_(x.flatten(0, 1).std(dim=0).clamp(min=1e-6))
        for flat, mean, components in zip(
            self._modal(x), (self.mode_mean, self.area_mean), (self.components, self.area_components), strict=True
        ):
            if components.shape[1]:
                mean.copy_(flat.mean(dim=0))
                components.copy_(mode_components(flat - mean, components.shape[1]))

    def forward(self, x: torch.Tensor, lost: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """Labels from node features.

        Parameters
        ----------
        x : (B, N, F) float
        lost : (B, N) bool, optional
            Pins whose features are unknown. They are filled in: see ``fill_lost_features``.

        Returns
        -------
        dict
            ``mean`` (B, K) and ``log_scale`` (B, K), standardised; ``executed`` (B,) logit; ``embedding`` (B, width).
        """
        x = self.fill_lost_features(x, lost)
        parts = []
        if self.size.modes or self.size.area_modes:
            parts.append(self.amplitudes(x))
        if self.size.layers:
            states = self.graph(x / self.scale)
            pooled = (self.waves.T @ states.flatten(1)).view(-1, *states.shape[1:])  # (frequencies, B, C)
            parts.append(pooled.permute(1, 0, 2).flatten(1))
        z = torch.cat(parts, dim=1)
        h = torch.nn.functional.silu(self.enter(z))
        for layer in self.trunk:
            h = torch.nn.functional.silu(layer(h))
        out = self.head(h)
        k = self.outputs
        return {"mean": out[:, :k] + self.linear(z), "log_scale": out[:, k : 2 * k], "executed": out[:, 2 * k], "embedding": h}

    def fill_lost_features(self, x: torch.Tensor, lost: torch.Tensor | None) -> torch.Tensor:
        """Features with those of lost pins filled in: the displacement by the modes of the other pins, the area by the neighbours."""
        if lost is None or not bool(lost.any()):
            return x
        x = fill_lost(x, lost, self.adjacency)
        for k in torch.nonzero(lost.any(dim=1))[:, 0] if self.size.modes else ():
            x[k, :, :2] = self._fill_by_modes(x[k, :, :2], lost[k])
        return x

    def _fill_by_modes(self, moved: torch.Tensor, lost: torch.Tensor) -> torch.Tensor:
        """Displacements (N, 2) whose lost rows follow from the modes that fit the known rows best (least squares)."""
        length = self.components.norm(dim=0)
        directions = self.components[:, length > 0] / length[length > 0]
        away = moved.flatten() / self.scale[0] - self.mode_mean
        gone = lost.repeat_interleave(2)
        known = directions[~gone]
        normal = known.T @ known + FILL_RIDGE * torch.eye(known.shape[1], device=known.device)
        found = self.mode_mean + directions @ torch.linalg.solve(normal, known.T @ away[~gone])
        return torch.where(lost[:, None], (found * self.scale[0]).view(-1, 2), moved)

    def amplitudes(self, x: torch.Tensor) -> torch.Tensor:
        """Amplitudes (B, modes + area_modes) of the principal components of displacements and of smoothed areas."""
        moved, areas = self._modal(x)
        return torch.cat([(moved - self.mode_mean) @ self.components, (areas - self.area_mean) @ self.area_components], dim=1)

    def _modal(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return x[..., :2].flatten(1) / self.scale[0], x[..., 2] @ self.smoothing.T / self.scale[2]

    def graph(self, x: torch.Tensor) -> torch.Tensor:
        """Node states (N, B, C) after all graph layers. Nodes are the first axis, so that averaging is one matrix product."""
        weights = self.neighbour_weights()
        h = x.transpose(0, 1).contiguous()
        for k, (layer, embedding) in enumerate(zip(self.layers, self.embedding, strict=True)):
            around = (weights @ h.flatten(1)).view(h.shape)
            new = torch.nn.functional.silu(layer(torch.cat([h, around], dim=2)) + embedding[:, None])
            h = h + new if k else new
        return h

    def neighbour_weights(self) -> torch.Tensor:
        """Attention (N, N) of each pin to its neighbours; each row sums to 1. In evaluation mode it is computed once."""
        if self.training or self._weights is None:
            weights = torch.softmax(self.attention.masked_fill(self.adjacency == 0, -torch.inf), dim=1)
            if self.training:
                return weights
            self._weights = weights.detach()
        return self._weights

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation."""
        self._weights = None
        return super().train(mode)


def fill_lost(x: torch.Tensor, lost: torch.Tensor, adjacency: torch.Tensor) -> torch.Tensor:
    """Features (B, N, F) with those of lost pins replaced by the mean over known neighbours. A gap is filled from its edge inwards."""
    known = (~lost).to(x.dtype)[..., None]
    x = torch.where(lost[..., None], 0.0, x)
    while bool((known == 0).any()):
        count = adjacency @ known
        new = (known == 0) & (count > 0)
        if not bool(new.any()):
            break
        x = torch.where(new, (adjacency @ (x * known)) / count.clamp(min=1), x)
        known = known + new.to(x.dtype)
    return x


def mode_components(centred: torch.Tensor, count: int) -> torch.Tensor:
    """Principal directions (D, count) of rows (M, D), scaled so that mode k has the standard deviation 3 sqrt(s_k / s_0).

    s_k are the singular values. The square root makes small modes, which carry finer detail, large enough for a network. Missing modes
    are 0.
    """
    _, sizes, directions = torch.linalg.svd(centred.double(), full_matrices=False)
    keep = count_modes(sizes.numpy(), count)
    deviation = sizes[:keep] / len(centred) ** 0.5
    found = torch.zeros(centred.shape[1], count)
    found[:, :keep] = (directions[:keep].T * (3 * (sizes[:keep] / sizes[0]).sqrt() / deviation)).float()
    return found


def laplacian_waves(adjacency: torch.Tensor, count: int) -> torch.Tensor:
    """The graph's ``count`` smoothest waves (N, count): eigenvectors of its normalised Laplacian, with a mean square of 1/N."""
    root = adjacency.sum(dim=1).clamp(min=1).rsqrt().double()
    laplacian = torch.eye(len(adjacency), dtype=torch.float64) - root[:, None] * adjacency.double() * root
    waves = torch.linalg.eigh(laplacian)[1][:, :count]
    return (waves / len(adjacency) ** 0.5 * 3).float()
