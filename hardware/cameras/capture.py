"""From a camera's picture to a sensor's frame: check the size, make it gray for a mono camera, threshold it for the recordings' form."""

import numpy as np

from hardware.errors import DeviceError
from scenes.sensor import SensorSpec
from twin.camera import record
from twin.recordings.forms import frame_size, gray_levels
from twin.types import Form


def capture(image: np.ndarray, spec: SensorSpec | None, form: Form, name: str) -> np.ndarray:
    """A picture (H, W) or (H, W, 3) uint8 RGB as the sensor's frame of a form. Without a sensor the picture is returned unchanged.

    Raises
    ------
    DeviceError
        Its size is not that of the sensor's camera.
    """
    if spec is None:
        return image
    size = (spec.camera.width_px, spec.camera.height_px)
    if image.shape[1::-1] != size:
        if form is Form.RECORDING and image.shape[1::-1] == frame_size(spec, form):
            return gray_levels(image)  # thresholded by the sender
        raise DeviceError(
            f"{name}: delivers {image.shape[1]}x{image.shape[0]}, {spec.name} has {size[0]}x{size[1]}; give the matching sensor"
        )
    if spec.camera.channels == "mono":
        image = gray_levels(image)
    return record(image, spec.recording) if form is Form.RECORDING and spec.recording is not None else image
