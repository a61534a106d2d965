"""The lights behind the window, and their light at places in the gel, in closed form and without shadows.

LEDs are squares, and the bright ring is an annulus. All are flat and face +z. The ray equation is that of ``twin.camera.projection``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scenes.body import GelSpec
from scenes.sensor import HousingSpec, LedRingSpec, LensSpec
from twin.compiled import compiled
from twin.optics.glass import NEWTON_STEPS, fresnel
from twin.types import FloatArray

LED_FLUX = 640.0
"""Radiance times area (mm^2) of an LED of power 1. With it a white cap's radiance is about 1, the unit of the linear image."""
RING_PLACES = 24
"""Number of point lights that approximate the housing's ring."""
ON_AXIS_MM = 1e-4
"""Distance from the vertical line through a light, below which a point is lit along this line."""
_reflectance = compiled(error_model="numpy")(fresnel)


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
    """Irradiance in the gel from all LEDs and the housing's ring. An LED is approximated by one point light, the ring by many.

    Parameters
    ----------
    lens : LensSpec
    gel : GelSpec
    patches : sequence of Patch
        The lights of the gel (see ``twin.optics.direct_light.lights``).
    """

    def __init__(self, lens: LensSpec, gel: GelSpec, patches: Sequence[Patch]) -> None:
        self._window = np.array([lens.back_mm, lens.z_mm, lens.refractive_index, gel.refractive_index])
        self._absorption = np.array(gel.absorption_per_mm, float)
        places, powers = [], []
        turn = np.arange(RING_PLACES) * 2 * np.pi / RING_PLACES
        for patch in patches:
            ring = 0 if patch.radii_mm[1] == 0 else np.sqrt(np.mean(patch.radii_mm**2))
            around = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1) if ring else np.zeros((1, 3))
            places.append(patch.center_mm + ring * around)
            powers.append(np.tile(patch.area_mm2 * patch.radiance / len(around), (len(around), 1)))
        self._places, self._powers = np.concatenate(places or [np.zeros((0, 3))]), np.concatenate(powers or [np.zeros((0, 3))])

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
        each = normals.reshape(len(points_mm), -1, 3)
        return _irradiance(points_mm, each, bump, self._places, self._powers, self._window, self._absorption).reshape(normals.shape)

    def refracted_rays(self, points_mm: FloatArray, place_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Refracted rays from points (n, 3) to a place (3,) in the air: unit directions (n, 3) and lengths (n,) in the gel."""
        return _ways(points_mm, np.asarray(place_mm, float), self._window)


@compiled(error_model="numpy")
def _irradiance(
    points: FloatArray, normals: FloatArray, bump: float, places: FloatArray, powers: FloatArray, window: FloatArray, absorption: FloatArray
) -> FloatArray:
    result = np.zeros(normals.shape)
    absorbs = np.any(absorption > 0)
    for i in range(len(points)):
        for k in range(len(places)):
            x, y, z, length, factor = _refracted_ray(points[i], places[k], window)
            arriving = factor * (powers[k] * np.exp(-absorption * length) if absorbs else powers[k])
            for j in range(normals.shape[1]):
                cosine = x * normals[i, j, 0] + y * normals[i, j, 1] + z * normals[i, j, 2]
                if cosine > 0:
                    for c in range(3):
                        result[i, j, c] += ((1 - bump) * cosine + 0.5 * bump) * arriving[c]
    return result


@compiled(error_model="numpy")
def _ways(points: FloatArray, place: FloatArray, window: FloatArray) -> tuple[FloatArray, FloatArray]:
    toward, lengths = np.empty((len(points), 3)), np.empty(len(points))
    for i in range(len(points)):
        toward[i, 0], toward[i, 1], toward[i, 2], lengths[i], _ = _refracted_ray(points[i], place, window)
    return toward, lengths


@compiled(error_model="numpy")
def _refracted_ray(point: FloatArray, place: FloatArray, window: FloatArray) -> tuple[float, float, float, float, float]:
    """The refracted ray from a point in the gel to a place in the air: direction and length in the gel, and a factor of the light.

    The factor is the solid angle at the point (``d omega = sin d(theta) d(phi)``) per area at the place, whose normal is +z, times
    the transmittance.
    """
    back, front, n_window, n_gel = window
    air, glass, gel = back - place[2], front - back, point[2] - front
    across_x, across_y = place[0] - point[0], place[1] - point[1]
    rho = np.sqrt(across_x * across_x + across_y * across_y)
    paraxial = 1 / (air + glass / n_window + gel / n_gel)
    u, slope = rho * paraxial, 0.0
    for step in range(NEWTON_STEPS + 1):
        reach = air * u
        slope = air
        rest = 1 / np.sqrt(n_window**2 + (n_window**2 - 1) * u * u)
        reach += glass * u * rest
        slope += glass * n_window**2 * rest**3
        rest = 1 / np.sqrt(n_gel**2 + (n_gel**2 - 1) * u * u)
        reach += gel * u * rest
        slope += gel * n_gel**2 * rest**3
        if step < NEWTON_STEPS:
            u = max(u + (rho - reach) / slope, 0.0)
    cos_air = 1 / np.sqrt(1 + u * u)
    sine = u * cos_air
    sin_gel = sine / n_gel
    cos_gel = np.sqrt(1 - sin_gel * sin_gel)
    cos_window = np.sqrt(1 - (sine / n_window) ** 2)
    sine_per_rho = sine / rho if rho > ON_AXIS_MM else paraxial
    solid = sine_per_rho * cos_air**3 / (n_gel**2 * cos_gel * slope)
    outer = _reflectance(1 / n_window, cos_air, cos_window)
    inner = _reflectance(n_gel / n_window, cos_gel, cos_window)
    through = (1 - outer) * (1 - inner) / (1 - outer * inner)
    bend = sin_gel / rho if rho > ON_AXIS_MM else 0.0
    return across_x * bend, across_y * bend, -cos_gel, gel / cos_gel, solid * through
