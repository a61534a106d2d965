"""Degradations of the light: LEDs that fail, and light from outside."""

import numpy as np

from scenes.sensor import LedRingSpec
from twin.evaluation.degradation.condition import OnSection, PictureView, in_family, over_channels

# Light in the middle of a glare, in saturations. It is large, so that the camera is saturated far beyond the glare's half width.
GLARE = 3.0
# Place of the glare's middle: x and y from the disc's centre, in units of the disc's radius.
GLARE_AT = (0.35, -0.25)


def dimmed(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """All LEDs weaker."""
    return leds.alter(power=leds.power * (1 - value))


def dead(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """Lit LEDs go out one after the other around the ring."""
    balance = np.array(leds.balance or (1.0,) * len(leds.azimuth_deg))
    lit = np.setdiff1d(np.arange(len(balance)), leds.off)
    balance[lit] *= np.clip(1 - (value * len(lit) - np.arange(len(lit))), 0, 1)
    return leds.alter(balance=tuple(balance.tolist()))


def reddened(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """LEDs that have changed their colour."""
    red, green, blue = leds.color
    return leds.alter(color=(red, green * (1 - value), blue * (1 - value)))


def room_light(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Additional light over the whole frame, which increases from one side of the disc to the other."""
    x, y = view.grid(light.shape)
    ramp = np.clip(0.5 + 0.5 * (0.8 * x + 0.6 * y), 0, 1)
    return light + over_channels(value * view.saturation * ramp, light)


def glare(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """The reflection of a lamp: uniform in the middle, with a steep edge."""
    x, y = view.grid(light.shape)
    radius = 0.5 * value * view.px_per_mm / view.radius_px
    away2 = ((x - GLARE_AT[0]) ** 2 + (y - GLARE_AT[1]) ** 2) / radius**2
    return light + over_channels(GLARE * view.saturation * np.exp(-np.log(GLARE) * away2**2), light)


_condition = in_family("light")
CONDITIONS = (
    _condition("leds-dim", "LEDs grown dim", "share of the LEDs' light lost", "", 0.995, spec=OnSection("leds", dimmed)),
    _condition("leds-dead", "LEDs dead, one after the other", "share of the LEDs", "", 1.0, spec=OnSection("leds", dead)),
    _condition("leds-red", "LED colour shifted to red", "share of green and blue lost", "", 0.995, spec=OnSection("leds", reddened)),
    _condition(
        "room-light", "room light leaking in", "light at the bright side, in saturations", "", 1.5, light=room_light, image_level=True
    ),
    _condition("glare", "saturated glare", "diameter at the caps", "mm", 16.0, light=glare, image_level=True),
)
