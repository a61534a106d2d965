"""Rays of the raw frame's pixels through lens and window into the gel, in Dr.Jit's terms."""

from types import ModuleType

import numpy as np

from scenes.sensor import CameraSpec
from twin.optics.arrays import with_room
from twin.optics.lens import ray_table
from twin.optics.sampling import PixelSamples
from twin.optics.variant import DrJit
from twin.optics.window import Window
from twin.projection import sensor_to_camera


class CameraRays:
    """A thin lens with the camera's distortion, looking through the window.

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
            On the window's gel side.
        direction : mi.Vector3f
            Unit vectors in the gel.
        transmittance : mi.Float
        """
        x, y = mi.Float(pixel % self._columns), mi.Float(pixel // self._columns)
        at = random.next_2d()
        # texel centres lie at (i + 0.5) / n; the table's nodes are the pixels' corners
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
