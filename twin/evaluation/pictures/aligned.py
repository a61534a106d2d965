"""Real frames with the skin fitted to their pins, which all stages of the calibration use."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import CameraSpec, ResponseSpec, SensorSpec
from twin.camera.projection import lens_disc
from twin.errors import FrameError
from twin.evaluation.pictures.frames import FEW_LOST, read_real
from twin.frames.recording import BadFrame
from twin.mechanics.skin_fit import FittedPins
from twin.progress import Step

# Gray level from which on a pixel counts as saturated.
SATURATED = 250


@dataclass(frozen=True)
class Aligned:
    """A real frame and its pins in space.

    Attributes
    ----------
    name : str
    image : (H, W, 3) or (H, W) uint8
    pins_px : (N, 2) float
        Raw-frame px, in the specification's order.
    state : FittedPins
        Pins of the fitted skin.
    """

    name: str
    image: np.ndarray
    pins_px: np.ndarray
    state: FittedPins


def read_frames(
    folder: Path, spec: SensorSpec, limit: int, progress: Step
) -> tuple[list[tuple[str, np.ndarray, np.ndarray]], list[BadFrame]]:
    """Read usable frames of a folder, spread evenly: name, image (H, W[, 3]) uint8 and pins (N, 2) px of each; and the refused ones.

    A frame may lack a few pins (``FEW_LOST``), which are NaN.

    Raises
    ------
    FrameError
        No frame can be used, or a frame does not fit the camera: its size differs, or one of both is colour and the other mono. The
        message names the first such frame and the reason.
    """
    real = read_real(folder, spec, lens_disc(spec.view, spec.housing), limit=limit, lost=FEW_LOST, progress=progress)
    read = [(found.frame.name, in_channels(found.frame.image, spec.camera), found.pins_px) for found in real.frames]
    for name, image, _ in read:
        require_cameras_own(image, name, spec.camera)
    return read, real.refused


def in_channels(image: np.ndarray, camera: CameraSpec) -> np.ndarray:
    """A frame (H, W[, C]) with one channel for a mono camera, if its channels are alike: files often hold gray frames as colour."""
    alike = image.ndim == 3 and bool((image == image[..., :1]).all())
    return image[..., 0] if alike and camera.channels == "mono" else image


def require_cameras_own(image: np.ndarray, name: str, camera: CameraSpec) -> None:
    """Raise ``FrameError`` if an image does not have the camera's size and channels, because it could not be compared with renders."""
    height, width = image.shape[:2]
    if (height, width) != (camera.height_px, camera.width_px):
        raise FrameError(
            f"{name}: {width} x {height} px, the specification's camera has {camera.width_px} x {camera.height_px}; "
            "give frames as they come"
        )
    colour = image.ndim == 3 and image.shape[2] == 3
    if colour and camera.channels == "mono":
        raise FrameError(
            f'{name}: a colour frame, but the specification\'s camera is mono; set channels = "color" under [camera], '
            "or convert the frames to gray"
        )
    if not colour and camera.channels == "color":
        raise FrameError(
            f'{name}: a gray frame, but the specification\'s camera has colour; set channels = "mono" under [camera], '
            "or give the colour frames"
        )


def to_light(levels: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Light in the renderer's unit from gray levels, by the inverse of response curve, white balance and exposure."""
    share = np.clip((np.asarray(levels, float) - response.black_level) / (255 - response.black_level), 0, 1)
    gain = _gain(levels, response)
    return share**response.gamma / gain


def to_levels(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Gray levels (float, not rounded) from light: the inverse of ``to_light``."""
    gain = _gain(light, response)
    return response.black_level + (255 - response.black_level) * np.clip(gain * light, 0, 1) ** (1 / response.gamma)


def levels_slope(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Derivative of ``to_levels`` by the light; it is finite in the dark."""
    gain = _gain(light, response)
    share = np.clip(gain * light, 1e-6, 1)
    return (255 - response.black_level) / response.gamma * share ** (1 / response.gamma - 1) * gain


def _gain(values: np.ndarray, response: ResponseSpec) -> float | np.ndarray:
    """Factor on the light before the response curve: exposure, and white balance if the last axis has the three colours."""
    colour = np.ndim(values) and np.shape(values)[-1] == 3
    return response.exposure * (np.array(response.white_balance) if colour else 1.0)


def with_changes(spec: SensorSpec, **sections: Mapping[str, Any]) -> SensorSpec:
    """A validated copy with values changed section by section (``camera={"k1": 0.1}``)."""
    data = spec.model_dump()
    for name, values in sections.items():
        data[name] = data[name] | values
    return SensorSpec.model_validate(data)
