"""``touch``, our model of contacts with forces: modes of the pins, relative modes, light of the caps; an ensemble and a Gaussian process.

It needs a few hundred labelled frames and trains in minutes. ``vgnn`` estimates depth and angles of a surface. ``touch`` also distinguishes
light contacts, in which all pins move little, and uses the caps' brightness if there are pictures.
"""

from collections.abc import Mapping
from typing import cast

import numpy as np
import torch

from training.data.dataset import Dataset
from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import ArrayInputs, Inputs, Learnt, Modes, PinModel, Prepared, Weights, refuse_sizes
from training.models.recipes import Recipe
from training.models.touch.features import Bases
from training.models.touch.network import TouchNetwork
from training.models.vgnn.registration import Registration, align, fit_registration
from twin.pins.labelling.reference import Reference

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


def _scale(features: np.ndarray) -> ArrayInputs:
    """Inputs from features (M, D)."""
    return ArrayInputs((GAIN * features).astype(np.float32))


class TouchModel(PinModel):
    """See the module."""

    counts_from_rest = True
    has_modes = True
    modes_scaled = True
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
        nodes_px, lost = pins.nodes_px, pins.lost
        for _ in range(ROUNDS):
            registration, _ = fit_registration(nodes_px[train], pins.reference.pins_px)
            lost = _find_untrusted(registration, pins, pins.reference)
            nodes_px = np.stack(
                [registration.fill(each, gone) if gone.any() else each for each, gone in zip(pins.nodes_px, lost, strict=True)]
            )
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

    def pack(self, weights: Weights) -> Weights:
        """See ``Model``: all weights."""
        return weights

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """See ``Model``."""
        return packed


def _remove_camera_motion(
    registration: Registration, pins: PinTable, reference: Reference, lost: np.ndarray, *, together: bool
) -> np.ndarray:
    """Displacements (M, 2 N) in rest spacings, with lost pins filled in, without the displacement of a moved camera."""
    nodes_px = pins.nodes_px.copy()
    for k in np.flatnonzero(lost.any(axis=1)):
        nodes_px[k] = registration.fill(nodes_px[k], lost[k])
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
