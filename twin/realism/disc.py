"""The part of the raw frame that shows the gel: the housing's aperture."""

from dataclasses import dataclass

import numpy as np

from scenes.sensor import SensorSpec
from twin.projection import project

# Corners of the polygon that stands for the aperture's rim.
CORNERS = 360


@dataclass(frozen=True)
class Disc:
    """The lens disc in the raw frame.

    Attributes
    ----------
    center_px : (2,) float
    radius_px : float
    inside : (H, W) bool
        Pixels whose centre lies in it.
    """

    center_px: np.ndarray
    radius_px: float
    inside: np.ndarray

    def distance_px(self, points_px: np.ndarray) -> np.ndarray:
        """Distance (...,) of points (..., 2) from the disc's centre, px."""
        return np.linalg.norm(np.asarray(points_px, float) - self.center_px, axis=-1)


def round_disc(size_px: tuple[int, int], center_px: np.ndarray, radius_px: float) -> Disc:
    """A disc in a (width, height) frame."""
    y, x = np.mgrid[: size_px[1], : size_px[0]]
    inside = (x - center_px[0]) ** 2 + (y - center_px[1]) ** 2 <= radius_px**2
    return Disc(np.asarray(center_px, float), float(radius_px), inside)


def lens_disc(spec: SensorSpec) -> Disc:
    """The housing's aperture as the specification's camera sees it: centre and mean radius of its projected rim."""
    turn, housing = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False), spec.housing
    rim = np.column_stack([housing.aperture_radius_mm * np.cos(turn), housing.aperture_radius_mm * np.sin(turn), np.zeros(CORNERS)])
    rim_px = project(spec.view, rim + [*housing.center_mm, housing.z_mm])
    center = rim_px.mean(axis=0)
    radius = float(np.linalg.norm(rim_px - center, axis=1).mean())
    return round_disc((spec.camera.width_px, spec.camera.height_px), center, radius)
