"""A wire mesh wrapped on a solid."""

from dataclasses import dataclass

import numpy as np

_BLEND = 0.15  # blending length of a joint, as a fraction of the wire's diameter


@dataclass(frozen=True)
class WireMesh:
    """Round wires that lie on the base's surface, in two crossing families at a pitch; one wire of
    each family passes over the origin.

    A wire's distance is sqrt((D - d/2)^2 + s^2) - d/2 with the base's distance D, the wire's
    diameter d and the distance s along the surface to the nearest wire; base and wires are joined
    by the polynomial smooth minimum (Quilez), which only adds material.
    """

    base: object
    pitch_mm: float
    wire_diameter_mm: float

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return self._join(points_mm)[0]

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        slope = self._join(points_mm)[1]
        return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)

    def _join(self, points_mm):
        radius = self.wire_diameter_mm / 2
        base, base_slope = self.base.distance(points_mm), self.base.gradient(points_mm)
        along, along_slope = self.base.unroll(points_mm)
        to_wire = along - self.pitch_mm * np.round(along / self.pitch_mm)
        distance, slope = base, base_slope
        for family in range(2):
            s, s_slope = to_wire[:, family], along_slope[:, family]
            from_axis = np.maximum(np.hypot(base - radius, s), 1e-9)
            wire_slope = ((base - radius)[:, None] * base_slope + s[:, None] * s_slope) / from_axis[:, None]
            distance, slope = _smooth_minimum(distance, slope, from_axis - radius, wire_slope, _BLEND * self.wire_diameter_mm)
        return distance, slope


def _smooth_minimum(a, a_slope, b, b_slope, blend):
    """min(a, b) - max(k - |a - b|, 0)^2 / (4 k), with its gradient."""
    near = np.maximum(blend - np.abs(a - b), 0)
    share = near / (2 * blend)
    weight_b = np.where(b < a, 1 - share, share)[:, None]
    return np.minimum(a, b) - near**2 / (4 * blend), (1 - weight_b) * a_slope + weight_b * b_slope
