"""``vgnn``, our model: pins matched to the layout at rest, a graph network with pin modes, and a Gaussian process of the modes."""

from collections.abc import Mapping
from dataclasses import fields
from typing import cast

import numpy as np
import torch
from torch import nn

from training.data.label_code import LabelCode
from training.data.pins import PinTable
from training.errors import TrainingError
from training.models.part import Inputs, Learnt, Modes, PinModel, Prepared, Variant, Weights, refuse_sizes
from training.models.recipes import Recipe
from training.models.vgnn.inputs import PinInputs, fill_lost, pin_features, seated_inputs
from training.models.vgnn.network import Vgnn, VgnnSize
from training.models.vgnn.registration import Registration, fit_registration
from twin.pins.labelling.reference import Reference
from twin.pins.voronoi import directed_edges, triangulate

# Number of modes of the displacement that are inputs of the Gaussian process, with all modes of the areas. Finer modes are noise to it.
PROCESS_MODES = 30
# Buffers that a small copy leaves out, because they follow from the pins. The waves are kept: waves of equal frequency can be any
# basis of their space, and another linear algebra library would choose another one.
DERIVED = ("adjacency", "smoothing")


class VgnnModel(PinModel):
    """See the module."""

    counts_from_rest = True
    has_modes = True

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
        nodes_px, area_px2 = fill_lost(registration, pins.nodes_px, pins.area_px2, pins.lost, pins.reference)
        seated = seated_inputs(registration, nodes_px, area_px2, pins.lost, pins.reference)
        taken = registration.difference(nodes_px)
        taken[train] = left
        displaced = pin_features(*registration.take_out(nodes_px, area_px2, taken), pins.reference)
        both = np.concatenate([seated.x.numpy(), displaced])
        inputs = PinInputs(both, np.concatenate([pins.lost, pins.lost]), np.repeat([0.0, 1.0], len(pins)))
        return Prepared(inputs, {"registration": vars(registration)}, views=2)

    def inputs(self, pins: PinTable, learnt: Learnt, reference: Reference, *, together: bool) -> PinInputs:
        """See ``PinModel``. If a frame without contact shows the camera's place, no displacement of the camera is estimated."""
        registration = Registration(**learnt["registration"])
        pins = pins.relative_to(reference) if pins.measured else pins
        nodes_px, area_px2 = fill_lost(registration, pins.nodes_px, pins.area_px2, pins.lost, reference)
        if pins.measured:
            return PinInputs(pin_features(nodes_px, area_px2, reference), pins.lost)
        return seated_inputs(registration, nodes_px, area_px2, pins.lost, reference, together=together)

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
        """See ``Model``. Leaves out arrays that follow from the pins' graph, and attention between pins that are not neighbours."""
        kept = {key: value for key, value in weights.items() if key not in DERIVED}
        if "attention" in kept:
            kept["attention"] = kept["attention"][weights["adjacency"] > 0]
        return kept

    def unpack(self, packed: Weights, blank: Weights) -> Weights:
        """See ``Model``."""
        weights = packed | {key: blank[key] for key in DERIVED}
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
