"""Real frames with the skin fitted to their pins: what every stage of the calibration works on."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.sensor import ResponseSpec, SensorSpec
from twin.errors import FrameError
from twin.geometry.skin_fit import FittedPins
from twin.realism.disc import lens_disc
from twin.realism.frames import read_real

SATURATED = 250  # gray level from which on a pixel tells nothing


@dataclass(frozen=True)
class Aligned:
    """A real frame and the pins in space that it shows.

    Attributes
    ----------
    name : str
    image : (H, W, 3) or (H, W) uint8
    pins_px : (N, 2) float
        Raw-frame px, specification's order.
    state : FittedPins
    """

    name: str
    image: np.ndarray
    pins_px: np.ndarray
    state: FittedPins


def read_frames(folder: Path, spec: SensorSpec, limit: int, progress) -> list:
    """Usable frames of a folder, evenly spread, all of the camera's own size.

    Raises
    ------
    FrameError
        None can be used, or sizes differ from the specification's: names the first and why.
    """
    real = read_real(folder, spec, lens_disc(spec), limit=limit, progress=progress)
    size = (spec.camera.height_px, spec.camera.width_px)
    for found in real.frames:
        if found.frame.image.shape[:2] != size:
            height, width = found.frame.image.shape[:2]
            raise FrameError(
                f"{found.frame.name}: {width} x {height} px, the camera of {spec.name} has {size[1]} x {size[0]}; give frames as they come"
            )
    return [(found.frame.name, found.frame.image, found.pins_px) for found in real.frames]


def to_light(levels: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Light in the renderer's unit from gray levels: the response curve, white balance and exposure undone."""
    share = np.clip((np.asarray(levels, float) - response.black_level) / (255 - response.black_level), 0, 1)
    gain = _gain(levels, response)
    return share**response.gamma / gain


def to_levels(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Gray levels (float, not rounded) from light: the inverse of ``to_light``."""
    gain = _gain(light, response)
    return response.black_level + (255 - response.black_level) * np.clip(gain * light, 0, 1) ** (1 / response.gamma)


def levels_slope(light: np.ndarray, response: ResponseSpec) -> np.ndarray:
    """Derivative of ``to_levels`` by the light, finite in the dark."""
    gain = _gain(light, response)
    share = np.clip(gain * light, 1e-6, 1)
    return (255 - response.black_level) / response.gamma * share ** (1 / response.gamma - 1) * gain


def _gain(values: np.ndarray, response: ResponseSpec):
    """What light is multiplied by before the curve; white balance where the last axis (of 3) is colour."""
    colour = np.ndim(values) and np.shape(values)[-1] == 3
    return response.exposure * (np.array(response.white_balance) if colour else 1.0)


def revised(spec: SensorSpec, **sections) -> SensorSpec:
    """A copy with values changed section by section, validated again."""
    data = spec.model_dump()
    for name, values in sections.items():
        data[name] = data[name] | values
    return SensorSpec.model_validate(data)
