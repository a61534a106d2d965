"""``touch``, our model of contacts with forces: modes of the pins, relative modes, light of the caps; an ensemble and a Gaussian process.

It needs a few hundred labelled frames and trains in minutes. ``vgnn`` estimates depth and angles of a surface. ``touch`` also distinguishes
light contacts, in which all pins move little, and uses the caps' brightness if there are pictures.

Its features are the information in a frame's pins as a few numbers:

- modes: amplitudes of the principal components of all displacements, in rest spacings;
- relative modes: the same for the displacements divided by their size plus a small number. They show place and kind of a light contact,
  which is small among the modes of deep contacts;
- light: amplitudes of the principal components of the caps' brightness. A cap brightens as it moves towards the LEDs, and the whole
  picture darkens as the LEDs warm up.

Mode k is scaled to the standard deviation sqrt(s_k / s_0), with s_k the singular values: small modes carry finer detail.

The network is the sum of a multi-layer perceptron and a linear map. Outside the range of its training data, a network's own error scale has
no meaning. Therefore the distance by which a feature exceeds its largest value in training is added to the error scale, in standard
deviations of the label.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from torch import nn

from training.data.dataset import Dataset
from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import ArrayInputs, Inputs, Learnt, Modes, PinModel, Prepared, Recipe, refuse_sizes
from training.models.vgnn.registration import Registration, align, count_modes, fit_registration
from twin.pins.labelling.reference import Reference

SMALL = 0.15
"""Size, in rest spacings times the root of the number of coordinates, below which displacements are noise rather than a contact."""
MOST_LOST = 0.1
"""Largest share of the training frames in which a used pin may be lost."""
LEAST_BEYOND = 1e-6
"""Distance that counts as zero."""
SIZES = {"modes": 40, "light_modes": 20, "width": 256, "depth": 3}
"""Numbers of modes of displacements (and of relative modes) and of modes of light; width and depth of the network."""
GAIN = 3.0
"""Factor on all features. With it, the network learns fastest from their small modes."""
HEADROOM = 1.2
"""Size of a feature, relative to its largest size in training, above which intervals grow."""
LEAST_FEATURE = 1e-3
"""Least size of a feature, for features that are constant in training."""
FAR = 0.08
"""Distance, in rest spacings, between a pin and its place by the modes of all pins above which it is not a pin."""
ROUNDS = 2
"""Rounds in which the modes are learnt. Pins that were not trusted in the round before are filled in."""
LIGHT_WEIGHT = 0.2
"""Weight of the light among the inputs of the Gaussian process. Light mostly shows the state of the lamps."""
BRIGHTER = 0.05
"""Common change of the light of all caps (logarithm of levels) above which no contact causes it. Contacts cause 0.023 (rms)."""
LIGHT_DECIMALS = 4
"""Decimals of the caps' light (logarithms of levels) that are compared between frames."""


@dataclass(frozen=True)
class Bases:
    """Means and directions of the three kinds of modes, fitted to training frames.

    Attributes
    ----------
    moved_mean, relative_mean : (2 N,) float
    moved, relative : (2 N, m) float
    light_mean : (N,) float
    light : (N, l) float
    small : (1,) float
        Norm of the displacements that is added before the division, rest spacings.
    seen : (N,) float
        1 for pins that were found in most training frames, 0 for the others. These are left out, because their places are mostly guesses.
    """

    moved_mean: np.ndarray
    moved: np.ndarray
    relative_mean: np.ndarray
    relative: np.ndarray
    light_mean: np.ndarray
    light: np.ndarray
    small: np.ndarray
    seen: np.ndarray

    def __call__(self, moved: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Features (M, D) of displacements (M, 2 N), rest spacings, and levels (M, N)."""
        moved, light = moved * np.repeat(self.seen, 2), light * self.seen
        relative = (moved / (np.linalg.norm(moved, axis=1, keepdims=True) + self.small) - self.relative_mean) @ self.relative
        return np.concatenate([(moved - self.moved_mean) @ self.moved, relative, (light - self.light_mean) @ self.light], axis=1)

    @classmethod
    def learn_bases(cls, moved: np.ndarray, light: np.ndarray, lost: np.ndarray, *, modes: int, light_modes: int) -> "Bases":
        """Learn the bases from displacements (m, 2 N), levels (m, N) and lost pins (m, N) of training frames."""
        seen = (lost.mean(axis=0) <= MOST_LOST).astype(float)
        if not seen.any():
            seen[:] = 1.0
        moved, light = moved * np.repeat(seen, 2), light * seen
        small = np.array([SMALL * np.sqrt(moved.shape[1])])
        relative = moved / (np.linalg.norm(moved, axis=1, keepdims=True) + small)
        means = [values.mean(axis=0) for values in (moved, relative, light)]
        kinds = zip((moved, relative, light), means, (modes, modes, light_modes), strict=True)
        directions = [_directions(values - mean, count) for values, mean, count in kinds]
        return cls(means[0], directions[0], means[1], directions[1], means[2], directions[2], small, seen)


def _directions(centred: np.ndarray, count: int) -> np.ndarray:
    """Directions (D, count) of the largest modes of centred rows (m, D), scaled as in the module's docstring; missing modes are 0."""
    _, sizes, rows = np.linalg.svd(centred, full_matrices=False)
    found = np.zeros((centred.shape[1], count))
    if sizes.size and sizes[0] > 0:
        keep = count_modes(sizes, count)
        found[:, :keep] = rows[:keep].T * np.sqrt(len(centred) / (sizes[:keep] * sizes[0]))
    return found


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


def _scale(features: np.ndarray) -> ArrayInputs:
    """Inputs from features (M, D)."""
    return ArrayInputs((GAIN * features).astype(np.float32))


class TouchModel(PinModel):
    """See the module."""

    counts_from_rest = True
    has_modes = True
    modes_scaled = True
    derived = ()
    sees_light = True
    unmeasured_widens = 2.0  # in the twin, a camera moved by 3 px, 1 deg and 1 % has errors 1.0 to 2.2 times those of an unmoved one

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> TouchNetwork:
        """See ``Model``; width and depth can be chosen. The modes are fitted before; their numbers are those of ``SIZES``."""
        refuse_sizes(self, size, ("width", "depth"))
        sizes = SIZES | dict(size)
        features = 2 * sizes["modes"] + sizes["light_modes"]
        return TouchNetwork(features, outputs, width=sizes["width"], depth=sizes["depth"])

    def prepare_pins(self, pins: PinTable, train: np.ndarray) -> Prepared:
        """See ``Model``. Learns from the training rows the modes, and how a contact changes the similarity to the layout at rest."""
        nodes_px = pins.nodes_px
        for _ in range(ROUNDS):
            registration, _ = fit_registration(nodes_px[train], pins.reference.pins_px)
            lost = _find_untrusted(registration, pins, pins.reference)
            nodes_px = registration.fill(pins.nodes_px, lost)
        moved = _remove_camera_motion(registration, pins, pins.reference, lost, together=False)
        bases = Bases.learn_bases(moved[train], pins.light[train], lost[train], modes=SIZES["modes"], light_modes=SIZES["light_modes"])
        learnt = {"registration": vars(registration), "bases": vars(bases)}
        return Prepared(_scale(bases(moved, pins.light)), learnt)

    def inputs_seen(self, data: Dataset) -> object:
        """See ``Model``: the pins, their places at rest, and the light of the caps."""
        return [super().inputs_seen(data), np.round(data.pins.light, LIGHT_DECIMALS) + 0.0]

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> ArrayInputs:
        """See ``PinModel``. If a frame without contact shows the camera's place, no displacement of the camera is estimated."""
        pins = pins.relative_to(reference) if pins.measured else pins
        registration, bases = Registration(**learnt["registration"]), Bases(**learnt["bases"])
        if bases.light_mean.any() and not pins.light.any():
            raise TrainingError("the model also needs the light on the caps, which these pins do not contain; give it frames")
        moved = _remove_camera_motion(registration, pins, reference, _find_untrusted(registration, pins, reference), together=together)
        return _scale(bases(moved, _as_bright(pins.light, bases)))

    def initialise(self, network: torch.nn.Module, inputs: Inputs, rows: torch.Tensor, numbers: torch.Tensor, code: LabelCode) -> None:
        """See ``Model``. Sets the largest size of each feature in training."""
        cast(TouchNetwork, network).limit.copy_(HEADROOM * inputs.batch(rows)[0].abs().amax(dim=0).clamp(min=LEAST_FEATURE))

    def modes(self, network: torch.nn.Module, inputs: Inputs, rows: torch.Tensor) -> Modes:
        """See ``Model``. The inputs are all features; the light has a smaller weight."""
        x = inputs.batch(rows)[0].double().numpy() / GAIN
        weight = np.repeat([1.0, LIGHT_WEIGHT], [2 * SIZES["modes"], SIZES["light_modes"]])
        return Modes(x * weight, np.zeros(len(x)))


def _remove_camera_motion(
    registration: Registration, pins: PinTable, reference: Reference, lost: np.ndarray, *, together: bool
) -> np.ndarray:
    """Displacements (M, 2 N) in rest spacings, with lost pins filled in, without the displacement of a moved camera."""
    nodes_px = registration.fill(pins.nodes_px, lost)
    if not pins.measured:
        nodes_px = registration(nodes_px, pins.area_px2, together=together)[0]
    return ((nodes_px - reference.pins_px) / reference.spacing_px.mean()).reshape(len(nodes_px), -1)


def _as_bright(light: np.ndarray, bases: Bases) -> np.ndarray:
    """Light (M, N) without a common change of all caps that is larger than contacts cause: the camera's exposure, or the lamps."""
    brighter = ((light - bases.light_mean) * bases.seen).sum(axis=1, keepdims=True) / bases.seen.sum()
    return light - np.where(np.abs(brighter) > BRIGHTER, brighter, 0.0)


def _find_untrusted(registration: Registration, pins: PinTable, reference: Reference) -> np.ndarray:
    """Pins (M, N) that are lost, or so far from their places by the modes of all pins that they are something else (reflections)."""
    aligned, _ = align(pins.nodes_px, reference.pins_px)
    away = aligned.reshape(len(aligned), -1) - registration.mean
    directions = registration.components / np.maximum(np.linalg.norm(registration.components, axis=0), 1e-12)
    left = (away - away @ directions @ directions.T).reshape(len(away), -1, 2)
    return pins.lost | (np.linalg.norm(left, axis=2) > FAR * reference.spacing_px.mean())


TOUCH = TouchModel(
    name="touch",
    description="ours for forces: modes of pins and light of caps, ensemble and Gaussian process, calibrated intervals",
    recipe=Recipe(epochs=150, batch=128, decay=0.05, members=6, kernel=True),
)
