"""What goes wrong with skin and caps."""

import cv2
import numpy as np

from twin.geometry.pins import rest_pins
from twin.optics.surfaces import cap_albedo
from twin.robustness.condition import Condition, View, chosen, over_channels, revised

GONE = 1e-6  # reflectance of a cap that has come off, relative to a whole one
BROKEN = (-0.45, 0.2, 0.1, 0.15, 0.1)  # a broken cap's outline: about a third of its area left, askew
FINE_BITS = 4  # of a pixel's fraction, as OpenCV draws
FINE = 2**FINE_BITS
TEAR_AT = (-0.3, 0.35)  # of a tear, from the disc's centre, in its radius
TEAR_LIGHT = 0.7  # room light through a tear, in saturations


def cap_levels(spec) -> np.ndarray:
    """Level (N,) of each cap relative to ``cap_albedo``: measured, or as the print's random pattern has it."""
    albedo = np.array(spec.appearance.cap_albedo)
    k = int(albedo.argmax())
    return (
        np.array(spec.appearance.cap_levels)
        if spec.appearance.cap_levels
        else np.maximum(cap_albedo(spec.appearance, spec.pins.count)[:, k] / albedo[k], GONE)
    )


def with_levels(spec, levels):
    return revised(spec, appearance={"cap_levels": tuple(levels.tolist())})


def missing(spec, value, rng):
    if not value:
        return spec
    return with_levels(spec, np.where(chosen(spec.pins.count, value, rng), GONE, cap_levels(spec)))


def those_missing(value, view: View, rng):
    return chosen(len(view.caps_px), value, rng)


def broken(spec, value, rng):
    if not value:
        return spec
    old = np.array(spec.appearance.cap_shapes or np.zeros((spec.pins.count, len(BROKEN))))
    turn = rng.uniform(0, 2 * np.pi, spec.pins.count)
    new = np.zeros_like(old)
    new[:, 0] = BROKEN[0]
    for k, order in ((1, 2), (3, 3)):
        new[:, k] = BROKEN[k] * np.cos(order * turn)
        new[:, k + 1] = BROKEN[k] * np.sin(order * turn)
    shapes = np.where(chosen(spec.pins.count, value, rng)[:, None], new, old)
    return revised(spec, appearance={"cap_shapes": tuple(map(tuple, shapes.tolist()))})


def faded(spec, value, rng):
    return revised(spec, appearance={"cap_albedo": tuple(a * (1 - value) for a in spec.appearance.cap_albedo)}) if value else spec


def uneven(spec, value, rng):
    if not value:
        return spec
    return with_levels(spec, cap_levels(spec) * np.exp(-value * np.abs(rng.standard_normal(spec.pins.count))))


def pale(spec, value, rng):
    old = spec.appearance.skin_albedo
    return revised(spec, appearance={"skin_albedo": tuple(a + value * (1 - a) for a in old)}) if value else spec


def translucent(light, value, view: View, rng):
    """Room light through the skin, stronger on one side; caps stand before it and hold it back."""
    if not value:
        return light
    x, y = view.grid(light.shape)
    bright = value * view.saturation * np.clip(0.7 + 0.3 * (0.6 * x - 0.8 * y), 0, 1) * (x * x + y * y < 1)
    return light + over_channels(bright * (1 - cap_cover(light.shape, view)), light)


def torn(light, value, view: View, rng):
    """A round hole: room light instead of skin and caps."""
    if not value:
        return light
    x, y = view.grid(light.shape)
    away_px = np.hypot(x - TEAR_AT[0], y - TEAR_AT[1]) * view.radius_px
    cover = over_channels(np.clip(0.5 * value * view.px_per_mm - away_px + 0.5, 0, 1), light)
    return light * (1 - cover) + np.float32(TEAR_LIGHT * view.saturation) * cover


def those_torn_off(value, view: View, rng):
    at = view.center_px + np.array(TEAR_AT) * view.radius_px
    return np.linalg.norm(view.caps_px - at, axis=1) < 0.5 * value * view.px_per_mm if value else np.zeros(len(view.caps_px), bool)


def swollen(spec, value, rng):
    """Skin swollen by oil: thicker and larger."""
    grown = {name: getattr(spec.skin, name) * (1 + value) for name in ("outer_radius_mm", "thickness_mm")}
    return revised(spec, skin=grown) if value else spec


def cap_cover(shape, view: View) -> np.ndarray:
    """(H, W) share of each pixel under a cap, caps taken as discs at their places in this view; leaning ones look smaller."""
    facing = np.clip(np.abs(rest_pins(view.spec.geometry).axis[:, 2]), 0.3, 1)
    cover = np.zeros(shape[:2], np.uint8)
    for (x, y), radius in zip(view.caps_px, view.cap_radius_px * np.sqrt(facing), strict=True):
        cv2.circle(cover, (round(x * FINE), round(y * FINE)), round(radius * FINE), 255, -1, cv2.LINE_AA, FINE_BITS)
    return cover / np.float32(255)


CONDITIONS = (
    Condition("caps-missing", "caps come off", "skin", "share of the caps", "", 0.6, spec=missing, hides=those_missing),
    Condition("caps-broken", "broken caps", "skin", "share of the caps", "", 1.0, spec=broken),
    Condition("caps-faded", "faded caps", "skin", "share of their reflectance lost", "", 0.995, spec=faded),
    Condition("caps-uneven", "unevenly soiled caps", "skin", "sd of the logarithm of their reflectance", "", 4.0, spec=uneven),
    Condition("skin-pale", "skin worn pale", "skin", "reflectance gained", "", 0.6, spec=pale),
    Condition("skin-translucent", "translucent skin", "skin", "room light through it, in saturations", "", 0.8, light=translucent),
    Condition("skin-torn", "torn skin", "skin", "diameter of the hole", "mm", 22.0, light=torn, hides=those_torn_off),
    Condition("skin-swollen", "skin swollen by oil", "skin", "growth", "", 0.2, spec=swollen, solves=True),
)
