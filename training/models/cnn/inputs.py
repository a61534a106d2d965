"""Inputs of the convolutional networks: small grey images of the frames."""

import cv2
import numpy as np

from training.data.dataset import Dataset
from training.data.pins import recording_key
from training.models.cnn.network import INPUT_PX
from training.models.part import ArrayInputs
from twin.frames import open_recording
from twin.frames.forms import gray_levels
from twin.store import cached_arrays


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
