"""Degradations of the gel: bubbles, haze, yellowing, softening."""

import numpy as np

from scenes.body import GelSpec
from scenes.sensor import SensorSpec, SpeckSpec
from twin.evaluation.degradation.condition import OnSection, in_family

# Smallest and largest radius of a bubble, mm. Chosen.
BUBBLE_RADIUS_MM = (0.15, 0.6)
# Share of the radius of the housing's opening within which bubbles are.
BUBBLE_REACH = 0.9
# Share of a cap's light that a bubble reflects into the camera. Chosen.
BUBBLE_LIGHT = 0.6
# Share of the light behind it that a bubble hides. Chosen.
BUBBLE_OPACITY = 0.5
# Number of bubbles whose random numbers are drawn at once, so that the first bubbles have the same places for any number.
MOST_BUBBLES = 1000
# Linear light of a cap at mid gray, as a share of saturation.
CAP_LIGHT = 0.25
# Absorption of aged silicone in red, green and blue, relative to blue. Chosen.
YELLOW = (0.25, 0.5, 1.0)
# Share of the light that is scattered forward at severity 1.
MOST_HAZE = 1.0


def bubbles(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """Bubbles at the window, which are added one after the other. A fraction of a bubble is a fainter bubble."""
    count = int(np.ceil(value))
    turn = rng.uniform(0, 2 * np.pi, MOST_BUBBLES)[:count]
    rho_mm = np.sqrt(rng.uniform(0, 1, MOST_BUBBLES))[:count] * spec.housing.aperture_radius_mm * BUBBLE_REACH
    radius_mm, part = rng.uniform(*BUBBLE_RADIUS_MM, MOST_BUBBLES)[:count], np.minimum(value - np.arange(count), 1)
    light = BUBBLE_LIGHT * (CAP_LIGHT / spec.response.exposure)
    new = [
        SpeckSpec(x_mm=r * np.cos(t), y_mm=r * np.sin(t), radius_mm=size, opacity=BUBBLE_OPACITY * p, light=light * p)
        for t, r, size, p in zip(turn.tolist(), rho_mm.tolist(), radius_mm.tolist(), part.tolist(), strict=True)
    ]
    return spec.alter(appearance={"specks": (*spec.appearance.specks, *new)})


def hazy(gel: GelSpec, value: float, rng: np.random.Generator) -> GelSpec:
    """Gel that scatters more light."""
    return gel.alter(haze=gel.haze + value * (MOST_HAZE - gel.haze))


def yellowed(gel: GelSpec, value: float, rng: np.random.Generator) -> GelSpec:
    """Gel that absorbs blue."""
    old = gel.absorption_per_mm
    return gel.alter(absorption_per_mm=tuple(a + value * share for a, share in zip(old, YELLOW, strict=True)))


def softened(gel: GelSpec, value: float, rng: np.random.Generator) -> GelSpec:
    """Gel that has lost stiffness."""
    return gel.alter(young_modulus_mpa=gel.young_modulus_mpa * (1 - value))


_condition = in_family("gel")
CONDITIONS = (
    _condition("gel-bubbles", "bubbles in the gel", "bubbles", "", 200.0, spec=bubbles),
    _condition("gel-haze", "hazy gel", "share of the light scattered forward", "", 1.0, spec=OnSection("gel", hazy)),
    _condition("gel-yellow", "yellowed gel", "absorption of blue", "1/mm", 0.6, spec=OnSection("gel", yellowed)),
    _condition(
        "gel-soft", "gel softened by temperature", "share of its stiffness lost", "", 0.9, spec=OnSection("gel", softened), solves=True
    ),
)
