"""Rays of the raw frame's pixels through lens and window into the gel.

A table holds the direction of the ray of each place on the film. It is exact for any distortion, and fast to read in Dr.Jit.
"""

from functools import lru_cache
from types import ModuleType

import numpy as np

from scenes.sensor import CameraSpec
from twin.camera.projection import distort, sensor_to_camera, undistort
from twin.optics.glass.window import Window
from twin.optics.sampling import PixelSamples
from twin.optics.variants.arrays import with_room
from twin.optics.variants.variant import DrJit
from twin.types import FloatArray

FIELD_MARGIN = 0.97
"""Largest radius at which the distortion model is used, relative to the radius at which it folds back. Beyond it the table is extrapolated
linearly."""
WIDEST_FIELD = 6.0
"""Largest tangent of a perspective camera (80 deg off its axis)."""
WIDEST_FISHEYE = 57.0
"""Largest tangent of a fisheye camera (89 deg off its axis)."""


def valid_radius(camera: CameraSpec) -> float:
    """Tangent up to which the distorted radius increases by more than a twentieth of the undistorted one (inf: everywhere)."""
    fisheye = camera.projection == "fisheye"
    radius = np.linspace(0, np.pi / 2 if fisheye else WIDEST_FIELD, 6001)
    slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
    folded = np.flatnonzero(slope <= 0.05)
    if not len(folded):
        return float("inf")
    return float(np.tan(radius[folded[0]]) if fisheye else radius[folded[0]])


def ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    """Unit directions (H + 1, W + 1, 3) in the camera frame, in air, at the corners of a window's pixels.

    ``window_px`` = (x0, y0, x1, y1), end exclusive; corner (j, i) is at pixel (x0 + i - 0.5, y0 + j - 0.5).
    Beyond the distortion's valid field the tangents are extrapolated linearly. The array is shared and can't be written to.
    """
    return _ray_table(camera, tuple(window_px))


@lru_cache(maxsize=4)
def _ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    x0, y0, x1, y1 = window_px
    x, y = np.meshgrid(np.arange(x0, x1 + 1) - 0.5, np.arange(y0, y1 + 1) - 0.5)
    seen = np.stack([(x - camera.cx_px) / camera.fx_px, (y - camera.cy_px) / camera.fy_px], axis=-1)
    widest = WIDEST_FISHEYE if camera.projection == "fisheye" else WIDEST_FIELD
    edge = min(FIELD_MARGIN * valid_radius(camera), widest)
    tangent = np.tan(np.linspace(0, np.arctan(edge), 6001))
    image = distort(camera.alter(p1=0.0, p2=0.0), np.stack([tangent, np.zeros_like(tangent)], axis=-1))[:, 0]
    seen_radius = np.linalg.norm(seen, axis=-1, keepdims=True)
    beyond = np.maximum(1.0, seen_radius / image[-1])
    inside = seen / beyond
    guess = inside * np.interp(seen_radius / beyond, image, tangent) / np.maximum(seen_radius / beyond, 1e-12)
    ideal = beyond * undistort(camera, inside, guess=guess)
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    rays.flags.writeable = False
    return rays


def subpixel_rays(corners: FloatArray, across: int) -> FloatArray:
    """Directions (n, across^2, 3) of a regular grid of places within n pixels, not normalised; ``corners`` (2, 2, n, 3) by row, column."""
    offset = (np.arange(across) + 0.5) / across
    s, t = (g.ravel()[:, None] for g in np.meshgrid(offset, offset))
    first, second = ((1 - s) * row[0, :, None] + s * row[1, :, None] for row in corners)
    return (1 - t) * first + t * second


class CameraRays:
    """Rays of a thin lens with the camera's distortion, through the window.

    Parameters
    ----------
    mi, dr : modules
        Mitsuba, its variant set, and Dr.Jit.
    camera : CameraSpec
    window : Window
    window_px : (x0, y0, x1, y1)
        Part of the raw frame, end exclusive.
    """

    def __init__(self, mi: ModuleType, dr: ModuleType, camera: CameraSpec, window: Window, window_px: tuple[int, int, int, int]) -> None:
        table = ray_table(camera, window_px)
        self._columns, self._rows = table.shape[1] - 1, table.shape[0] - 1
        texels = mi.TensorXf(with_room(table, np.float32))
        self._directions = mi.Texture2f(texels, filter_mode=dr.FilterMode.Linear, wrap_mode=dr.WrapMode.Clamp)
        self._to_sensor = mi.Matrix3f(sensor_to_camera(camera)[:3, :3].T)
        self._camera, self._window = camera, window

    def sample(self, mi: ModuleType, dr: ModuleType, pixel: DrJit, random: PixelSamples) -> tuple[DrJit, DrJit, DrJit]:
        """Rays in the gel for pixel numbers (row by row).

        Returns
        -------
        place : mi.Point3f
            Places on the window's gel side.
        direction : mi.Vector3f
            Unit vectors in the gel.
        transmittance : mi.Float
        """
        x, y = mi.Float(pixel % self._columns), mi.Float(pixel // self._columns)
        at = random.next_2d()
        # centres of texels are at (i + 0.5) / n; the table's nodes are the corners of pixels
        uv = mi.Point2f((x + at.x + 0.5) / (self._columns + 1), (y + at.y + 0.5) / (self._rows + 1))
        direction = mi.Vector3f(self._directions.eval(uv))
        pupil = mi.Point3f(0.0)
        if self._camera.aperture_mm > 0:
            sharp = direction * (self._camera.focus_mm / direction.z)
            disc = mi.warp.square_to_uniform_disk_concentric(random.next_2d()) * (0.5 * self._camera.aperture_mm)
            pupil = mi.Point3f(disc.x, disc.y, 0.0)
            direction = mi.Vector3f(sharp - pupil)
        origin = self._to_sensor @ mi.Vector3f(pupil)
        origin.z -= self._camera.distance_mm
        return self._window.enter(dr, mi, mi.Point3f(origin), dr.normalize(self._to_sensor @ direction))
