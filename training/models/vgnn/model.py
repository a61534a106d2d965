"""``vgnn``, our model: pins matched to the layout at rest, a graph network with pin modes, and a Gaussian process of the modes.

The network works on the displacement and the Voronoi area of every pin. Pins have a fixed order. Therefore all frames are dense arrays over
one graph, the Delaunay graph of the layout at rest, and averaging over neighbours is one product with a fixed (N, N) matrix. Each node's
features are its displacement (in rest spacings) and the logarithm of the ratio of its Voronoi cell's area to the area at rest. There are
two branches:

- graph: layers ``h + silu(h U + (A h) W + e)``, where A is the attention-weighted mean over neighbours and e an embedding of the pin.
  They are pooled with the graph's smoothest Laplacian eigenvectors, because a mean over the pins would lose where something happens;
- modes: the amplitudes of the principal components of all displacements, and of the areas averaged over neighbours.

From both branches a multi-layer perceptron with skip connections computes the labels, the logarithm of each label's error scale, and the
logit of the probability that the shear move was executed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Self, cast

import numpy as np
import torch
from torch import nn

from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import Inputs, Learnt, Modes, PinModel, Prepared, Recipe, Variant, Weights, refuse_sizes
from training.models.vgnn.registration import Registration, count_modes, fit_registration
from twin.pins import Reference, make_graph
from twin.pins.voronoi import directed_edges, triangulate

# Features of a node: dx, dy and the logarithm of the area ratio.
FEATURES = 3
# Penalty of the least-squares fit of modes by which lost pins are filled in.
FILL_RIDGE = 1e-3
# Number of modes of the displacement that are inputs of the Gaussian process, with all modes of the areas. Finer modes are noise to it.
PROCESS_MODES = 30


class PinInputs:
    """Dense features of every frame: ``batch`` gives (B, N, 3) and lost pins (B, N).

    Parameters
    ----------
    features : (M, N, 3) float
    lost : (M, N) bool
    displaced : (M,) float, optional
        Share, 0 to 1, of each frame's difference from the expected camera that was removed; 0 for all frames if not given.
    """

    def __init__(self, features: np.ndarray, lost: np.ndarray, displaced: np.ndarray | None = None) -> None:
        self.x, self.lost = torch.from_numpy(features.astype(np.float32)), torch.from_numpy(lost)
        self.displaced = torch.from_numpy(np.zeros(len(lost)) if displaced is None else displaced)

    def __len__(self) -> int:
        return len(self.x)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Arguments of the network for some rows."""
        return self.x[rows], self.lost[rows]


def pin_features(nodes_px: np.ndarray, area_px2: np.ndarray, reference: Reference) -> np.ndarray:
    """Features (M, N, 3) of matched pins: displacement from rest in mean rest spacings, logarithm of the ratio of area to rest area."""
    moved = (nodes_px - reference.pins_px) / reference.spacing_px.mean()
    return np.concatenate([moved, np.log(area_px2 / reference.area_px2)[..., None]], axis=-1)


def fill_lost(registration: Registration, pins: PinTable, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """Pins (M, N, 2) and areas (M, N). A lost pin is placed by the modes of the other pins' displacements."""
    nodes_px, area_px2 = registration.fill(pins.nodes_px, pins.lost), pins.area_px2.copy()
    for k in np.flatnonzero(pins.lost.any(axis=1)):
        area_px2[k] = make_graph("voronoi", nodes_px[k], outmost=reference.outmost, net=reference.net).area_px2
    return nodes_px, area_px2


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

    def __init__(self, edges: np.ndarray, pins: int, outputs: int, size: VgnnSize) -> None:
        super().__init__()
        self.size, self.outputs = size, outputs
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
        learnt = (self.mode_mean, self.components), (self.area_mean, self.area_components)
        for flat, (mean, components) in zip(self._modal(x), learnt, strict=True):
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
        parts = [self.amplitudes(x)]
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
        x = fill_from_neighbours(x, lost, self.adjacency)
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


def fill_from_neighbours(x: torch.Tensor, lost: torch.Tensor, adjacency: torch.Tensor) -> torch.Tensor:
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


class VgnnModel(PinModel):
    """See the module."""

    counts_from_rest = True
    has_modes = True
    # They follow from the pins. The waves do not: waves of equal frequency can be any basis of their space, and another linear algebra
    # library would choose another one.
    derived = ("adjacency", "smoothing")

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> Vgnn:
        """See ``Model``; sizes are the fields of ``VgnnSize``."""
        refuse_sizes(self, size, tuple(field.name for field in fields(VgnnSize)))
        triangles = triangulate(reference.pins_px)
        if triangles is None:
            raise TrainingError(f"{self.name} needs pins that span an area; the {len(reference.pins_px)} pins at rest lie on one line")
        edges = directed_edges(triangles, len(reference.pins_px))
        return Vgnn(np.asarray(edges), len(reference.pins_px), outputs, VgnnSize(**size))

    def prepare_pins(self, pins: PinTable, train: np.ndarray) -> Prepared:
        """See ``Model``. How a contact changes a frame's similarity to the layout at rest is learnt from the training rows.

        In view 1 the whole difference of each frame from the expected camera is removed, as for a camera at another place.
        """
        registration, left = fit_registration(pins.nodes_px[train], pins.reference.pins_px)
        filled = fill_lost(registration, pins, pins.reference)
        taken = registration.difference(filled[0])
        taken[train] = left
        views = registration(*filled)[:2], registration.take_out(*filled, taken)
        features = np.concatenate([pin_features(nodes_px, area_px2, pins.reference) for nodes_px, area_px2 in views])
        inputs = PinInputs(features, np.concatenate([pins.lost, pins.lost]), np.repeat([0.0, 1.0], len(pins)))
        return Prepared(inputs, {"registration": vars(registration)}, views=2)

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> PinInputs:
        """See ``PinModel``. If a frame without contact shows the camera's place, no displacement of the camera is estimated."""
        registration = Registration(**learnt["registration"])
        pins = pins.relative_to(reference) if pins.measured else pins
        nodes_px, area_px2 = fill_lost(registration, pins, reference)
        share = None
        if not pins.measured:
            nodes_px, area_px2, _, share = registration(nodes_px, area_px2, together=together)
        return PinInputs(pin_features(nodes_px, area_px2, reference), pins.lost, share)

    def initialise(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor, numbers: torch.Tensor, code: LabelCode) -> None:
        """See ``Model``. Sets the scales of the features and the pin modes."""
        cast(Vgnn, network).prepare(cast(PinInputs, inputs).x[rows])

    def modes(self, network: nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """See ``Model``. The inputs are the first modes of the displacement and all modes of the areas."""
        vgnn, pins = cast(Vgnn, network), cast(PinInputs, inputs)
        with torch.no_grad():
            amplitudes = vgnn.amplitudes(vgnn.fill_lost_features(*pins.batch(rows))).double().numpy()
        modes = vgnn.size.modes
        seen = np.concatenate([amplitudes[:, : min(PROCESS_MODES, modes)], amplitudes[:, modes:]], axis=1)
        return Modes(seen, pins.displaced[rows].numpy())

    def pack(self, weights: Weights) -> Weights:
        """See ``Model``. Attention between pins that are not neighbours is left out, too."""
        kept = super().pack(weights)
        if "attention" in kept:
            kept["attention"] = kept["attention"][weights["adjacency"] > 0]
        return kept

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """See ``Model``."""
        weights = super().unpack(packed, blank)
        if "attention" in packed:
            attention = torch.zeros_like(blank["attention"])
            attention[blank["adjacency"] > 0] = packed["attention"]
            weights["attention"] = attention
        return weights


VGNN = VgnnModel(
    name="vgnn",
    description="ours: Voronoi graph network on matched pins, with pin modes, ensemble and calibrated intervals",
    recipe=Recipe(kernel=True),
    variants={
        "graph": Variant(size={"layers": 0}),
        "modes": Variant(size={"modes": 0, "area_modes": 0}, recipe={"kernel": False}),  # without modes the process has no inputs
        "kernel": Variant(recipe={"kernel": False}),
    },
)
