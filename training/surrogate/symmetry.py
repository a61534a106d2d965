"""Lattices of rings around the apex, and their twelve symmetries: turns and mirrorings that map a lattice onto itself.

The sensor is a body of revolution, so a turned or mirrored contact gives the turned or mirrored answer: every solved contact gives twelve
training states.
"""

from dataclasses import dataclass

import numpy as np

from twin.types import FloatArray, IntArray


def ring_directions(rings: int, largest_polar_deg: float, phase_deg: float) -> FloatArray:
    """Unit vectors (3 rings (rings + 1) + 1, 3): the apex, then ring by ring by increasing azimuth."""
    out = [np.array([[0.0, 0.0, 1.0]])]
    for ring in range(1, rings + 1):
        polar = np.radians(largest_polar_deg) * ring / rings
        azimuth = 2 * np.pi * np.arange(6 * ring) / (6 * ring) + np.radians(phase_deg)
        out.append(np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.full(6 * ring, np.cos(polar))]))
    return np.concatenate(out)


@dataclass(frozen=True)
class Symmetry:
    """A turn by a multiple of 60 deg about z, with or without a mirroring before it at the plane through z and the lattice's phase.

    Attributes
    ----------
    turns : int
        Number of turns by 60 deg.
    mirrored : bool
    matrix : (3, 3) float
        Matrix that maps vectors. Torques are mapped by this matrix times ``parity``.
    """

    turns: int
    mirrored: bool
    matrix: FloatArray

    @property
    def parity(self) -> float:
        """Factor for torques: -1 for a mirroring, because torques are axial vectors."""
        return -1.0 if self.mirrored else 1.0

    def places(self, rings: int) -> IntArray:
        """Index (M,) of the point to which each point of a lattice is mapped."""
        out, start = [np.zeros(1, int)], 1
        for ring in range(1, rings + 1):
            place = np.arange(6 * ring)
            out.append(start + ((-place if self.mirrored else place) + self.turns * ring) % (6 * ring))
            start += 6 * ring
        return np.concatenate(out)

    def move_vectors(self, vectors: FloatArray, rings: int) -> FloatArray:
        """Vectors (S, M, 3) at a lattice's points, turned and mirrored together with the points."""
        out = np.empty_like(vectors)
        out[:, self.places(rings)] = vectors @ self.matrix.T.astype(vectors.dtype)
        return out


def about_z(angle_rad: float) -> FloatArray:
    """A turn (3, 3) about the sensor's axis."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def symmetries(phase_deg: float) -> list[Symmetry]:
    """The twelve symmetries of a lattice of rings, the identity first."""
    along = about_z(np.radians(phase_deg))
    found = []
    for mirrored in (False, True):
        for turns in range(6):
            turn = about_z(np.radians(60.0 * turns))
            found.append(Symmetry(turns, mirrored, along @ turn @ np.diag([1.0, -1.0 if mirrored else 1.0, 1.0]) @ along.T))
    return found
