"""The convolutional baselines ``cnn-v1`` and ``cnn-v2``: PoseNet (Lepora 2020) and the paper's smaller version of it.

Their input is the frame itself, not the pins. Frames are resized to 128 x 128. Five 3x3 convolutions with ELU and max-pooling are followed
by dense layers with ELU and a small dropout. ``cnn-v1`` has 256 filters and one hidden dense layer of 64 units; ``cnn-v2`` has 48 filters
and two such layers.

The pooling is done before the ELU. Because ELU is increasing, the maximum is the same, and ELU is computed for a quarter of the values
only. The channels are last in memory: ``cnn-v2`` then trains twice as fast on a CPU as in the usual order.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import cv2
import numpy as np
import torch
from torch import nn

from training.data.dataset import Dataset
from training.data.pins import recording_key
from training.models.part import ArrayInputs, Model, Prediction, Prepared, Recipe, Trained, refuse_sizes
from twin.frames import open_recording
from twin.frames.forms import gray_levels
from twin.pins.labelling.reference import Reference
from twin.store import cached_arrays
from twin.types import Frame

# Side of the network's input image, px.
INPUT_PX = 128
# Share of the dense layers' inputs that are set to 0 in training.
DROPOUT = 0.06
# Number of convolutions.
LAYERS = 5
# Weights of the L1 and L2 penalties of the hidden dense layers' weights (PoseNet, Lepora 2020).
L1, L2 = 6e-4, 1e-3


def small_image(image: np.ndarray) -> np.ndarray:
    """The small grey image of a frame, (128, 128) uint8."""
    return cv2.resize(gray_levels(image), (INPUT_PX, INPUT_PX), interpolation=cv2.INTER_AREA)


def image_inputs(dataset: Dataset) -> ArrayInputs:
    """Small images (M, 128, 128) uint8 of a data set's frames, in the order of its rows."""
    recording = open_recording(dataset.folder, dataset.pins.sensor, dataset.pins.form)

    def compute() -> dict[str, np.ndarray]:
        images = {frame.name: small_image(frame.image) for frame in recording}
        return {"images": np.stack([images[name] for name in dataset.pins.image_name])}

    key = recording_key(recording, dataset.pins.sensor) | {"rows": dataset.pins.image_name.tolist(), "px": INPUT_PX}
    return ArrayInputs(cached_arrays("small-images", key, compute)["images"])


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
        """See ``Model``: the regularisation of the hidden dense weights."""
        weights = [layer.weight for layer in list(cast(Cnn, network).dense)[:-1] if isinstance(layer, nn.Linear)]
        return torch.stack([L1 * w.abs().sum() + L2 * w.square().sum() for w in weights]).sum()

    def estimate_frame(self, trained: Trained, frame: Frame) -> Prediction:
        """See ``Model``."""
        trained.pipeline.check(frame)
        return trained.ensemble(ArrayInputs(small_image(frame.image)[None]), torch.zeros(1, dtype=torch.long))

    def estimate_rows(self, trained: Trained, data: Dataset, rows: np.ndarray) -> Prediction:
        """See ``Model``."""
        return trained.ensemble(image_inputs(data), torch.from_numpy(rows))


# Settings of PoseNet (Lepora 2020).
POSENET_RECIPE = Recipe(batch=16, rate=1e-4, schedule="constant", patience=10, decay=0.0, average=0.0, loss="l2", scaling="unit", members=1)
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
