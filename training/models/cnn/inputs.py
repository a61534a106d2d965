"""Inputs of the convolutional networks: small grey images of the frames."""

from collections.abc import Callable

import cv2
import numpy as np
import torch

from training.data.dataset import Dataset
from training.data.pins import recording_key
from training.models.cnn.network import INPUT_PX
from twin.frames import open_recording
from twin.frames.forms import gray_levels
from twin.store import cached_arrays


class ImageInputs:
    """Frames of 128 x 128: ``batch`` gives (B, 128, 128) uint8.

    Parameters
    ----------
    images : (M, 128, 128) uint8
    """

    def __init__(self, images: np.ndarray) -> None:
        self.images = torch.from_numpy(images)

    def __len__(self) -> int:
        return len(self.images)

    def batch(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Arguments of the network for some rows."""
        return (self.images[rows],)


def small_image(image: np.ndarray) -> np.ndarray:
    """The small grey image of a frame, (128, 128) uint8."""
    return cv2.resize(gray_levels(image), (INPUT_PX, INPUT_PX), interpolation=cv2.INTER_AREA)


def image_inputs(dataset: Dataset, progress: Callable | None = None) -> ImageInputs:
    """Small images of a data set's frames, in the order of its rows."""

    recording = open_recording(dataset.folder, dataset.pins.sensor, dataset.pins.form)

    def compute() -> dict[str, np.ndarray]:
        images = {}
        for frame in recording:
            images[frame.name] = small_image(frame.image)
            if progress:
                progress(frame.sequence + 1, len(recording))
        return {"images": np.stack([images[name] for name in dataset.pins.image_name])}

    key = recording_key(recording, dataset.pins.sensor) | {"rows": dataset.pins.image_name.tolist(), "px": INPUT_PX}
    return ImageInputs(cached_arrays("small-images", key, compute)["images"])
