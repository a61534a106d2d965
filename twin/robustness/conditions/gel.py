"""What goes wrong in the gel: bubbles, haze, yellowing, softening."""

import numpy as np

from scenes.sensor import SpeckSpec
from twin.robustness.condition import Condition, revised

BUBBLE_RADIUS_MM = (0.15, 0.6)
BUBBLE_LIGHT = 0.6  # of a cap's light that a bubble mirrors into the camera
YELLOW = (0.25, 0.5, 1.0)  # absorption of aged silicone by colour, relative to blue
MOST_HAZE = 1.0


def bubbles(spec, value, rng):
    """Bubbles at the window, drawn one after the other; the last one is as opaque as its part of the count."""
    if not value:
        return spec
    count = int(np.ceil(value))
    turn, rho = rng.uniform(0, 2 * np.pi, 1000)[:count], np.sqrt(rng.uniform(0, 1, 1000))[:count] * spec.housing.aperture_radius_mm * 0.9
    radius, part = rng.uniform(*BUBBLE_RADIUS_MM, 1000)[:count], np.minimum(value - np.arange(count), 1)
    light = BUBBLE_LIGHT * cap_light(spec)
    new = [
        SpeckSpec(x_mm=r * np.cos(t), y_mm=r * np.sin(t), radius_mm=size, opacity=0.5 * p, light=light * p)
        for t, r, size, p in zip(turn.tolist(), rho.tolist(), radius.tolist(), part.tolist(), strict=True)
    ]
    return revised(spec, appearance={"specks": (*spec.appearance.specks, *new)})


def cap_light(spec) -> float:
    """Linear light of a cap at mid gray, as the camera would show it: a quarter of saturation."""
    return 0.25 / spec.response.exposure


def hazy(spec, value, rng):
    return revised(spec, gel={"haze": spec.gel.haze + value * (MOST_HAZE - spec.gel.haze)}) if value else spec


def yellowed(spec, value, rng):
    old = spec.gel.absorption_per_mm
    return revised(spec, gel={"absorption_per_mm": tuple(a + value * share for a, share in zip(old, YELLOW, strict=True))})


def softened(spec, value, rng):
    return revised(spec, gel={"young_modulus_mpa": spec.gel.young_modulus_mpa * (1 - value)})


CONDITIONS = (
    Condition("gel-bubbles", "bubbles in the gel", "gel", "bubbles", "", 200.0, spec=bubbles),
    Condition("gel-haze", "hazy gel", "gel", "share of the light scattered forward", "", 1.0, spec=hazy),
    Condition("gel-yellow", "yellowed gel", "gel", "absorption of blue", "1/mm", 0.6, spec=yellowed),
    Condition("gel-soft", "gel softened by temperature", "gel", "share of its stiffness lost", "", 0.9, spec=softened, solves=True),
)
