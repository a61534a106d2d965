"""Degradations of gel, skin and caps."""

import cv2
import numpy as np

from scenes.base import Rgb
from scenes.body import GelSpec, SkinSpec
from scenes.sensor import AppearanceSpec, SensorSpec, SpeckSpec
from twin.evaluation.degradation.condition import OnSection, PictureView, choose_share, in_family, over_channels
from twin.geometry.pins import rest_pins
from twin.optics.surfaces import cap_albedo

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
# Reflectance of a cap that has come off, relative to an intact one. It is not 0, because levels must be positive.
GONE = 1e-6
# Outline of a broken cap, in the form of ``appearance.cap_shapes``: about a third of the area is left, on one side. Chosen.
BROKEN = (-0.45, 0.2, 0.1, 0.15, 0.1)
# Number of fractional bits of the places at which OpenCV draws, and the resulting number of steps of a pixel.
FINE_BITS = 4
FINE = 2**FINE_BITS
# Middle of a tear: x and y from the disc's centre, in units of the disc's radius.
TEAR_AT = (-0.3, 0.35)
# Room light through a tear, in saturations. Chosen.
TEAR_LIGHT = 0.7
# Least cosine of a cap's tilt that is used for drawing, because a cap with a larger tilt would vanish.
LEAST_FACING = 0.3


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


def cap_levels(appearance: AppearanceSpec, count: int) -> np.ndarray:
    """Reflectance (count,) of each cap relative to ``cap_albedo``: the measured one, else that of the print's random pattern."""
    if appearance.cap_levels:
        return np.array(appearance.cap_levels)
    albedo = np.array(appearance.cap_albedo)
    k = int(albedo.argmax())
    return np.maximum(cap_albedo(appearance, count)[:, k] / albedo[k], GONE)


def missing(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """Caps that have come off."""
    look = spec.appearance
    gone = sum(look.skin_albedo) / max(sum(look.cap_albedo), GONE) if look.dark_caps else GONE
    levels = np.where(choose_share(spec.pins.count, value, rng), gone, cap_levels(look, spec.pins.count))
    return spec.alter(appearance={"cap_levels": tuple(levels.tolist())})


def those_missing(value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Which caps (N,) have come off."""
    return choose_share(len(view.caps_px), value, rng)


def broken(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """Caps of which a part has broken off."""
    old = np.array(spec.appearance.cap_shapes or np.zeros((spec.pins.count, len(BROKEN))))
    turn = rng.uniform(0, 2 * np.pi, spec.pins.count)
    new = np.zeros_like(old)
    new[:, 0] = BROKEN[0]
    for k, order in ((1, 2), (3, 3)):
        new[:, k] = BROKEN[k] * np.cos(order * turn)
        new[:, k + 1] = BROKEN[k] * np.sin(order * turn)
    shapes = np.where(choose_share(spec.pins.count, value, rng)[:, None], new, old)
    return spec.alter(appearance={"cap_shapes": tuple(map(tuple, shapes.tolist()))})


def faded(appearance: AppearanceSpec, value: float, rng: np.random.Generator) -> AppearanceSpec:
    """Caps that have darkened; dark caps have become as bright as the skin."""
    if appearance.dark_caps:
        return appearance.alter(cap_albedo=_towards(appearance.cap_albedo, appearance.skin_albedo, value))
    return appearance.alter(cap_albedo=tuple(a * (1 - value) for a in appearance.cap_albedo))


def _towards(albedo: Rgb, other: Rgb, value: float) -> tuple[float, ...]:
    """A reflectance between two."""
    return tuple(a + value * (b - a) for a, b in zip(albedo, other, strict=True))


def uneven(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """Caps of different brightness."""
    levels = cap_levels(spec.appearance, spec.pins.count) * np.exp(-value * np.abs(rng.standard_normal(spec.pins.count)))
    return spec.alter(appearance={"cap_levels": tuple(levels.tolist())})


def pale(appearance: AppearanceSpec, value: float, rng: np.random.Generator) -> AppearanceSpec:
    """A skin that has lost its black; a bright skin has become as dark as the caps."""
    end = appearance.cap_albedo if appearance.dark_caps else (1.0, 1.0, 1.0)
    return appearance.alter(skin_albedo=_towards(appearance.skin_albedo, end, value))


def translucent(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Room light through the skin, stronger on one side. Caps are in front of the skin and block the light."""
    x, y = view.grid(light.shape)
    bright = value * view.saturation * np.clip(0.7 + 0.3 * (0.6 * x - 0.8 * y), 0, 1) * (x * x + y * y < 1)
    return light + over_channels(bright * (1 - cap_cover(light.shape, view)), light)


def torn(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A round hole, which shows room light instead of skin and caps."""
    x, y = view.grid(light.shape)
    away_px = np.hypot(x - TEAR_AT[0], y - TEAR_AT[1]) * view.radius_px
    cover = over_channels(np.clip(0.5 * value * view.px_per_mm - away_px + 0.5, 0, 1), light)
    return light * (1 - cover) + np.float32(TEAR_LIGHT * view.saturation) * cover


def those_torn_off(value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Which caps (N,) lie in the hole."""
    at = view.center_px + np.array(TEAR_AT) * view.radius_px
    return np.linalg.norm(view.caps_px - at, axis=1) < 0.5 * value * view.px_per_mm


def swollen(skin: SkinSpec, value: float, rng: np.random.Generator) -> SkinSpec:
    """Skin swollen by oil: thicker and larger."""
    grown = {name: getattr(skin, name) * (1 + value) for name in (*skin.size_keys, "thickness_mm")}
    return skin.alter(**grown)


def cap_cover(shape: tuple[int, ...], view: PictureView) -> np.ndarray:
    """Share (H, W) of each pixel that is covered by a cap. Caps are drawn as discs at their places, tilted caps as smaller discs."""
    facing = np.clip(np.abs(rest_pins(view.spec.geometry).axis[:, 2]), LEAST_FACING, 1)
    cover = np.zeros(shape[:2], np.uint8)
    for (x, y), radius in zip(view.caps_px, view.cap_radius_px * np.sqrt(facing), strict=True):
        cv2.circle(cover, (round(x * FINE), round(y * FINE)), round(radius * FINE), 255, -1, cv2.LINE_AA, FINE_BITS)
    return cover / np.float32(255)


_gel, _skin = in_family("gel"), in_family("skin")
CONDITIONS = (
    _gel("gel-bubbles", "bubbles in the gel", "bubbles", "", 200.0, spec=bubbles),
    _gel("gel-haze", "hazy gel", "share of the light scattered forward", "", 1.0, spec=OnSection("gel", hazy)),
    _gel("gel-yellow", "yellowed gel", "absorption of blue", "1/mm", 0.6, spec=OnSection("gel", yellowed)),
    _gel("gel-soft", "gel softened by temperature", "share of its stiffness lost", "", 0.9, spec=OnSection("gel", softened), solves=True),
    _skin("caps-missing", "caps come off", "share of the caps", "", 0.6, spec=missing, hides=those_missing),
    _skin("caps-broken", "broken caps", "share of the caps", "", 1.0, spec=broken),
    _skin("caps-faded", "faded caps", "share of their reflectance lost", "", 0.995, spec=OnSection("appearance", faded)),
    _skin("caps-uneven", "unevenly soiled caps", "sd of the logarithm of their reflectance", "", 4.0, spec=uneven),
    _skin("skin-pale", "skin worn pale", "reflectance gained", "", 0.6, spec=OnSection("appearance", pale)),
    _skin("skin-translucent", "translucent skin", "room light through it, in saturations", "", 0.8, light=translucent),
    _skin("skin-torn", "torn skin", "diameter of the hole", "mm", 22.0, light=torn, hides=those_torn_off),
    _skin("skin-swollen", "skin swollen by oil", "growth", "", 0.2, spec=OnSection("skin", swollen), solves=True),
)
