"""Where the pins of a sensor sit at rest, in the specification's pin order."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import GeometrySpec
from twin.types import FloatArray


@dataclass(frozen=True)
class PinRest:
    """Pins at rest, in the sensor frame.

    Attributes
    ----------
    base_mm : (N, 3) float
        Foot of each pin, on the inside of the skin.
    axis : (N, 3) float
        Unit vector from the foot to the cap (inwards, towards the camera).
    caps_mm : (N, 3) float
        Centre of the cap's solid (mid-height), ``base + (length + cap_height / 2) axis``.
    """

    base_mm: FloatArray
    axis: FloatArray
    caps_mm: FloatArray


def pin_lattice(layout: str, rings: int) -> FloatArray:
    """Unit-disc lattice of a layout: (N, 2) of (radius / outermost radius, azimuth in rad).

    Order: the centre, then ring by ring, each from its first pin by increasing azimuth
    (x towards y). A hexagonal ring's sides are divided into equal parts; its corners lie at
    multiples of 60 deg.
    """
    points = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        for k in range(6 * ring):
            if layout == "rings":
                points.append((ring / rings, 2 * np.pi * k / (6 * ring)))
            else:
                side, step = divmod(k, ring)
                start, end = np.exp(1j * np.pi / 3 * side), np.exp(1j * np.pi / 3 * (side + 1))
                z = ring / rings * (start + (end - start) * step / ring)
                points.append((abs(z), float(np.angle(z)) % (2 * np.pi)))
    return np.array(points)


def rest_pins(geometry: GeometrySpec) -> PinRest:
    """Pins at rest of a sensor: the lattice wrapped onto the inside of the dome as ``PinsSpec.spacing`` says."""
    pins, skin = geometry.pins, geometry.skin
    lattice = pin_lattice(pins.layout, pins.rings)
    largest = np.radians(pins.max_polar_deg)
    polar = largest * lattice[:, 0] if pins.spacing == "polar" else np.arcsin(np.sin(largest) * lattice[:, 0])
    azimuth = lattice[:, 1] + np.radians(pins.phase_deg)
    outward = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    base = (skin.outer_radius_mm - skin.thickness_mm) * outward
    return PinRest(base, -outward, base - (pins.length_mm + pins.cap_height_mm / 2) * outward)
