"""The lights behind the window: LEDs as squares, and the bright ring as an annulus. All are flat and face +z."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import HousingSpec, LedRingSpec
from twin.types import FloatArray

LED_FLUX = 640.0
"""Radiance times area (mm^2) of an LED of power 1. With it a white cap's radiance is about 1, the unit of the linear image."""


@dataclass(frozen=True)
class Patch:
    """A flat light in the air that faces +z.

    Attributes
    ----------
    center_mm : (3,) float
    half_mm : (2, 2) float
        Half of a square's edge vectors in x and y; zero for the annulus.
    radii_mm : (2,) float
        Inner and outer radius of an annulus; zero for a square.
    radiance : (3,) float
        Linear RGB.
    """

    center_mm: FloatArray
    half_mm: FloatArray
    radii_mm: FloatArray
    radiance: FloatArray

    @property
    def area_mm2(self) -> float:
        """Area of the square or annulus."""
        inner, outer = self.radii_mm
        return 4 * abs(np.linalg.det(self.half_mm)) + np.pi * (outer**2 - inner**2)


def led_patches(leds: LedRingSpec) -> list[Patch]:
    """The LEDs in the order of ``leds.azimuth_deg``. Dead ones have no radiance."""
    turn = np.radians(leds.azimuth_deg)
    balance = np.array(leds.balance or np.ones(len(turn)))
    balance[[k for k in leds.off if k < len(turn)]] = 0
    patches = []
    for angle, share in zip(turn, balance, strict=True):
        out, side = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        center = np.append(leds.radius_mm * out, leds.z_mm)
        radiance = LED_FLUX * leds.power * share / leds.size_mm**2 * np.array(leds.color)
        patches.append(Patch(center, 0.5 * leds.size_mm * np.stack([out, side]), np.zeros(2), radiance))
    return patches


def lights(leds: LedRingSpec, ring: HousingSpec) -> list[Patch]:
    """All lights of the gel: the lit LEDs, and the housing's ring if it has a ``fill``."""
    found = [patch for patch in led_patches(leds) if patch.radiance.any()]
    if ring.fill > 0:
        lit = len(found) / len(leds.azimuth_deg)
        radii = np.array([ring.aperture_radius_mm, ring.aperture_radius_mm + ring.fill_width_mm])
        radiance = ring.fill * lit * leds.power * np.array(leds.color) * np.array(ring.albedo)
        found.append(Patch(np.array([*ring.center_mm, ring.z_mm]), np.zeros((2, 2)), radii, radiance))
    return found
