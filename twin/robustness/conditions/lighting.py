"""What goes wrong with the light: LEDs, and light that doesn't belong."""

import numpy as np

from twin.robustness.condition import Condition, View, over_channels, revised

GLARE = 3.0  # light of a glare's middle, in saturations: the camera shows it white well beyond its half width
GLARE_AT = (0.35, -0.25)  # from the disc's centre, in its radius


def dimmed(spec, value, rng):
    return revised(spec, leds={"power": spec.leds.power * (1 - value)}) if value else spec


def dead(spec, value, rng):
    """Lit LEDs go out one after the other around the ring."""
    if not value:
        return spec
    balance = np.array(spec.leds.balance or (1.0,) * len(spec.leds.azimuth_deg))
    lit = np.setdiff1d(np.arange(len(balance)), spec.leds.off)
    balance[lit] *= np.clip(1 - (value * len(lit) - np.arange(len(lit))), 0, 1)
    return revised(spec, leds={"balance": tuple(balance.tolist())})


def reddened(spec, value, rng):
    red, green, blue = spec.leds.color
    return revised(spec, leds={"color": (red, green * (1 - value), blue * (1 - value))})


def room_light(light, value, view: View, rng):
    """A veil that rises from one side of the disc to the other, over everything the camera sees."""
    if not value:
        return light
    x, y = view.grid(light.shape)
    ramp = np.clip(0.5 + 0.5 * (0.8 * x + 0.6 * y), 0, 1)
    return light + over_channels(value * view.saturation * ramp, light)


def glare(light, value, view: View, rng):
    """A mirrored lamp: flat in the middle, falling off steeply."""
    if not value:
        return light
    x, y = view.grid(light.shape)
    radius = 0.5 * value * view.px_per_mm / view.radius_px
    away2 = ((x - GLARE_AT[0]) ** 2 + (y - GLARE_AT[1]) ** 2) / radius**2
    return light + over_channels(GLARE * view.saturation * np.exp(-np.log(GLARE) * away2**2), light)


CONDITIONS = (
    Condition("leds-dim", "LEDs grown dim", "light", "share of the LEDs' light lost", "", 0.995, spec=dimmed),
    Condition("leds-dead", "LEDs dead, one after the other", "light", "share of the LEDs", "", 1.0, spec=dead),
    Condition("leds-red", "LED colour shifted to red", "light", "share of green and blue lost", "", 0.995, spec=reddened),
    Condition(
        "room-light",
        "room light leaking in",
        "light",
        "light at the bright side, in saturations",
        "",
        1.5,
        light=room_light,
        image_level=True,
    ),
    Condition("glare", "saturated glare", "light", "diameter at the caps", "mm", 16.0, light=glare, image_level=True),
)
