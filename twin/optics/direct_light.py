"""The lights behind the window, and their light at places in the gel, in closed form and without shadows.

LEDs are squares, and the bright ring is an annulus. All are flat and face +z. The rays are those of `Window.connect`.
"""

from dataclasses import dataclass
from types import ModuleType

import numpy as np

from scenes.sensor import HousingSpec, LedRingSpec, SensorSpec
from twin.optics.glass import NumPy, Window
from twin.optics.variant import DrJit
from twin.types import FloatArray

LED_FLUX = 640.0
"""Radiance times area (mm^2) of an LED of power 1. With it a white cap's radiance is about 1, the unit of the linear image."""
RING_PLACES = 24
"""Number of point lights that approximate the housing's ring."""


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


class DirectLight:
    """Irradiance in the gel from all LEDs and the housing's ring. An LED is approximated by one point light, the ring by many."""

    def __init__(self, spec: SensorSpec) -> None:
        self._window, self._absorption = Window(spec.view), np.array(spec.gel.absorption_per_mm, float)
        places, powers = [np.zeros((0, 3))], [np.zeros((0, 3))]
        turn = np.arange(RING_PLACES) * 2 * np.pi / RING_PLACES
        for patch in lights(spec.leds, spec.housing):
            ring = 0 if patch.radii_mm[1] == 0 else np.sqrt(np.mean(patch.radii_mm**2))
            around = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1) if ring else np.zeros((1, 3))
            places.append(patch.center_mm + ring * around)
            powers.append(np.tile(patch.area_mm2 * patch.radiance / len(around), (len(around), 1)))
        self._places, self._powers = np.concatenate(places), np.concatenate(powers) / self._window.gel_index**2

    def __call__(self, points_mm: FloatArray, normals: FloatArray, bump: float = 0.0) -> FloatArray:
        """Irradiance divided by n^2 of the gel. The radiance of a matt surface in air is ``albedo / pi`` times this.

        Parameters
        ----------
        points_mm : (n, 3) float
            Places in the gel, in the sensor frame.
        normals : (n, 3) or (n, m, 3) float
            Unit normals of surfaces there that point into the gel.
        bump : float
            Share of the light that a place receives as a ball does, from any direction (``AppearanceSpec.cap_bump``).

        Returns
        -------
        (n, 3) or (n, m, 3) float
            Linear RGB.
        """
        toward, lengths, factor = self.refracted_rays(points_mm[:, None], self._places)
        arriving = factor[..., None] * self._powers * np.exp(-self._absorption * lengths[..., None])
        cosine = normals.reshape(len(points_mm), -1, 3) @ toward.swapaxes(1, 2)
        return (received_share(NumPy, cosine, bump) @ arriving).reshape(normals.shape)

    def refracted_rays(self, points_mm: FloatArray, places_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Refracted rays from points (..., 3) to places (..., 3) in the air, see `Window.connect`: directions, lengths, and factors."""
        toward, lengths, factor = self._window.connect(NumPy, np.moveaxis(points_mm, -1, 0), np.moveaxis(places_mm, -1, 0))
        return np.stack(toward, axis=-1), lengths, factor

    def transmittance(self, points_mm: FloatArray, place_mm: FloatArray) -> FloatArray:
        """Transmittance (n, 3) of the gel from points (n, 3) to a place (3,) in the air."""
        if not self._absorption.any():
            return np.ones_like(points_mm)
        return np.exp(-self._absorption * self.refracted_rays(points_mm, place_mm)[1][:, None])


def received_share(dr: ModuleType | type[NumPy], cosine: DrJit, bump: DrJit) -> DrJit:
    """Received share of light: by the cosine law of a flat place, mixed with that of a ball (one half, averaged over its visible side)."""
    return dr.select(cosine > 0, (1 - bump) * cosine + 0.5 * bump, 0.0)
