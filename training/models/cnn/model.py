"""The convolutional baselines as models: ``cnn-v1`` and ``cnn-v2``. Their input is the frame itself, not the pins."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import nn

from training.data.dataset import Dataset
from training.models.cnn.inputs import image_inputs, small_image
from training.models.cnn.network import Cnn
from training.models.part import ArrayInputs, Model, Prediction, Prepared, Trained, refuse_sizes
from training.models.recipes import Recipe
from twin.pins.labelling.reference import Reference
from twin.types import Frame


@dataclass(frozen=True, kw_only=True)
class CnnModel(Model):
    """A convolutional network on small images.

    Attributes
    ----------
    filters : int
        Number of filters of each convolution.
    dense : tuple of int
        Units of the dense layers before the last one.
    """

    filters: int
    dense: tuple[int, ...]

    def prepare(self, data: Dataset, train: np.ndarray) -> Prepared:
        """See ``Model``."""
        return Prepared(image_inputs(data))

    def inputs_seen(self, data: Dataset) -> object:
        """See ``Model``: the small images."""
        return image_inputs(data).values.numpy()

    def build(self, reference: Reference, outputs: int, size: Mapping[str, int]) -> Cnn:
        """See ``Model``; there are no sizes."""
        refuse_sizes(self, size)
        return Cnn(self.filters, self.dense, outputs)

    def penalty(self, network: nn.Module) -> torch.Tensor:
        """See ``Model``."""
        return cast(Cnn, network).penalty()

    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction:
        """See ``Model``."""
        trained.pipeline.check(frame)
        return trained.ensemble(ArrayInputs(small_image(frame.image)[None]), torch.zeros(1, dtype=torch.long))

    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """See ``Model``."""
        return trained.ensemble(image_inputs(data), torch.from_numpy(rows))


# Settings of PoseNet (Lepora 2020).
POSENET_RECIPE = Recipe(
    epochs=100, batch=16, rate=1e-4, schedule="constant", patience=10, decay=0.0, average=0.0, loss="l2", scaling="unit", members=1
)
CNN_V1 = CnnModel(
    name="cnn-v1",
    description="PoseNet: 5 convolutions of 256 filters",
    recipe=POSENET_RECIPE,
    filters=256,
    dense=(64,),
    published_mm_deg=(0.06, 1.20),
    timed_batches=2,
)
CNN_V2 = replace(
    CNN_V1,
    name="cnn-v2",
    description="5 convolutions of 48 filters, one more dense layer",
    filters=48,
    dense=(64, 64),
    published_mm_deg=(0.07, 1.25),
    timed_batches=4,
)
