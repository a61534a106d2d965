"""A degradation."""

import numpy as np

from twin.extend import Condition, PictureView


def hazy(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Light scattered evenly over the window; ``value`` is its share of the brightest light."""
    return light + value * light.max() if value else light


HAZE = Condition("example-haze", "an even haze", "optics", "share of the brightest light", "", 0.5, light=hazy, image_level=True)
