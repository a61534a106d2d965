"""Exact signed distances of simple solids.

Every solid has ``distance``, ``gradient`` and ``unroll``: two coordinates (k, 2) in mm along the
surface below a point, with their gradients (k, 2, 3), on which a texture is wrapped.
"""

from dataclasses import dataclass

import numpy as np

_TINY = 1e-12


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)


def project_on_xy(points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of a pattern projected along z."""
    slopes = np.zeros((len(points_mm), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    return points_mm[:, :2].copy(), slopes


@dataclass(frozen=True)
class Plane:
    """Half space z >= 0."""

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return -points_mm[:, 2]

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        return np.tile([0.0, 0.0, -1.0], (len(points_mm), 1))

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return project_on_xy(points_mm)


@dataclass(frozen=True)
class Sphere:
    """Ball behind its pole at the origin. A texture is projected along z."""

    radius_mm: float

    def _from_centre(self, points_mm):
        return points_mm - [0.0, 0.0, self.radius_mm]

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self._from_centre(points_mm), axis=1) - self.radius_mm

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        return _unit(self._from_centre(points_mm))

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return project_on_xy(points_mm)


@dataclass(frozen=True)
class Cylinder:
    """Cylinder along y that touches the origin from z > 0."""

    radius_mm: float

    def _from_axis(self, points_mm):
        return (points_mm - [0.0, 0.0, self.radius_mm]) * [1.0, 0.0, 1.0]

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return np.linalg.norm(self._from_axis(points_mm), axis=1) - self.radius_mm

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        return _unit(self._from_axis(points_mm))

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out = self._from_axis(points_mm)
        azimuth = np.arctan2(out[:, 0], -out[:, 2])
        slopes = np.zeros((len(out), 2, 3))
        scale = self.radius_mm / np.maximum((out**2).sum(1), _TINY)
        slopes[:, 0, 0], slopes[:, 0, 2] = -out[:, 2] * scale, out[:, 0] * scale
        slopes[:, 1, 1] = 1.0
        return np.column_stack([self.radius_mm * azimuth, points_mm[:, 1]]), slopes


@dataclass(frozen=True)
class Edge:
    """Quarter space x >= 0, z >= 0, its edge rounded by a fillet (which takes the edge back from the origin)."""

    fillet_mm: float

    def _beyond(self, points_mm):
        """(k, 2) how far a point lies in front of the faces moved in by the fillet: -x, -z."""
        return self.fillet_mm - points_mm[:, [0, 2]]

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        beyond = self._beyond(points_mm)
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        return outside + np.minimum(beyond.max(axis=1), 0) - self.fillet_mm

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        beyond = self._beyond(points_mm)
        inside = beyond.max(axis=1) <= 0
        nearest_face = np.where(np.arange(2) == beyond.argmax(axis=1)[:, None], 1.0, 0.0)
        section = np.where(inside[:, None], nearest_face, _unit(np.maximum(beyond, 0)))
        return np.column_stack([-section[:, 0], np.zeros(len(section)), -section[:, 1]])

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return project_on_xy(points_mm)


@dataclass(frozen=True)
class Prism:
    """Regular polygon in x-z extruded along y, edges rounded, faces leaning by a taper about x.

    Face 0 passes through the origin and looks to -z; with a positive taper its normal leans to +y
    (the prism narrows towards +y). The rounded solid is the polyhedron moved in by the fillet,
    grown by the fillet; a point is folded into the sector of its nearest face, where the nearest
    point lies on that face or on the edge between two faces.
    """

    sides: int
    inradius_mm: float
    fillet_mm: float
    taper_rad: float

    def _fold(self, points_mm):
        """Nearest face's azimuth (k,), mirror sign (k,), and (out, along, y) coordinates (k, 3) in its sector."""
        x, z = points_mm[:, 0], points_mm[:, 2] - self.inradius_mm
        azimuth = np.arctan2(x, -z)
        face = np.round(azimuth / (2 * np.pi / self.sides)) * (2 * np.pi / self.sides)
        out = np.hypot(x, z) * np.cos(azimuth - face)
        along = np.hypot(x, z) * np.sin(azimuth - face)
        return face, np.where(along < 0, -1.0, 1.0), np.column_stack([out, np.abs(along), points_mm[:, 1]])

    def _section(self, folded):
        """Signed distance to the moved-in polyhedron and its gradient, in the sector's coordinates."""
        cos, sin = np.cos(self.taper_rad), np.sin(self.taper_rad)
        normal = np.array([cos, 0.0, sin])
        height = folded @ normal - (self.inradius_mm * cos - self.fillet_mm)
        foot = folded - height[:, None] * normal
        half = np.tan(np.pi / self.sides)
        edge_point = np.array([1.0, half, 0.0]) * (self.inradius_mm - self.fillet_mm / cos)
        edge = np.array([-sin, -sin * half, cos]) / np.sqrt(1 + (sin * half) ** 2)
        away = folded - edge_point
        away -= (away @ edge)[:, None] * edge
        on_edge = (height > 0) & (foot[:, 1] > foot[:, 0] * half)
        distance = np.where(on_edge, np.linalg.norm(away, axis=1), height)
        return distance, np.where(on_edge[:, None], _unit(away), normal)

    def distance(self, points_mm: np.ndarray) -> np.ndarray:
        return self._section(self._fold(points_mm)[2])[0] - self.fillet_mm

    def gradient(self, points_mm: np.ndarray) -> np.ndarray:
        face, mirror, folded = self._fold(points_mm)
        slope = self._section(folded)[1]
        out, along = slope[:, 0], slope[:, 1] * mirror
        cos, sin = np.cos(face), np.sin(face)
        return np.column_stack([out * sin + along * cos, slope[:, 2], -out * cos + along * sin])

    def unroll(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        face, mirror, folded = self._fold(points_mm)
        width = 2 * self.inradius_mm * np.tan(np.pi / self.sides)
        turn = np.round(face / (2 * np.pi / self.sides))
        slopes = np.zeros((len(folded), 2, 3))
        slopes[:, 0, 0], slopes[:, 0, 2] = np.cos(face), np.sin(face)
        slopes[:, 1, 1] = 1.0
        return np.column_stack([mirror * folded[:, 1] + turn * width, points_mm[:, 1]]), slopes
