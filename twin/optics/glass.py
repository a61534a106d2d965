"""Rays of the raw frame's pixels through lens and window into the gel, and the plane window between camera, LEDs and gel.

The window is computed in Dr.Jit (see ``twin.camera.projection`` for the equation of rays). A table holds the direction of the ray of each
place on the film. It is exact for any distortion, and fast to read in Dr.Jit.
"""

from functools import lru_cache
from types import ModuleType

import numpy as np

from scenes.sensor import CameraSpec, ViewSpec
from twin.camera.projection import distort, sensor_to_camera, undistort
from twin.optics.sampling import PixelSamples
from twin.optics.variant import DrJit, with_room
from twin.types import FloatArray

NEWTON_STEPS = 5
"""Steps of Newton's method from the paraxial start; a sixth step changes a direction by less than 1e-5."""
FIELD_MARGIN = 0.97
"""Largest radius at which the distortion model is used, relative to the radius at which it folds back. Beyond it the table is extrapolated
linearly."""
WIDEST_FIELD = 6.0
"""Largest tangent of a perspective camera (80 deg off its axis)."""
WIDEST_FISHEYE = 57.0
"""Largest tangent of a fisheye camera (89 deg off its axis)."""


class NumPy:
    """Dr.Jit's functions that `Window.connect` uses, for arrays."""

    sqrt, maximum, select, rcp = np.sqrt, np.maximum, np.where, np.reciprocal

    @staticmethod
    def rsqrt(x: FloatArray) -> FloatArray:
        """1 / sqrt(x)."""
        return 1 / np.sqrt(x)

    @staticmethod
    def fma(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
        """a b + c."""
        return a * b + c


class Window:
    """The window of a sensor: planes (z, mm) and indices of air | window | gel."""

    def __init__(self, view: ViewSpec) -> None:
        lens = view.lens
        self.back, self.front, self.radius = lens.back_mm, lens.z_mm, lens.radius_mm
        self.window_index, self.gel_index = lens.refractive_index, view.gel_index

    def enter(self, dr: ModuleType, mi: ModuleType, origin: DrJit, direction: DrJit) -> tuple[DrJit, DrJit, DrJit]:
        """Follow a ray in the air, with ``direction.z > 0``, to the window's gel side.

        Returns
        -------
        place : mi.Point3f
            Place on the gel side of the window.
        inward : mi.Vector3f
            Unit direction in the gel.
        transmittance : mi.Float
            Transmittance for radiance, without the factor n^2 of the denser medium.
        """
        place = origin + direction * ((self.back - origin.z) / direction.z)
        in_window = _refract(dr, mi, direction, 1 / self.window_index)
        place = place + in_window * ((self.front - self.back) / in_window.z)
        in_gel = _refract(dr, mi, in_window, self.window_index / self.gel_index)
        return place, in_gel, self.transmittance(direction.z, in_window.z, in_gel.z)

    def connect(self, dr: ModuleType | type[NumPy], point: DrJit, light: DrJit) -> tuple[DrJit, DrJit, DrJit]:
        """The refracted ray from points in the gel to points of a light in the air whose normal is +z.

        Parameters
        ----------
        dr : module
            Dr.Jit, or `NumPy` for arrays.
        point, light : x, y and z
            In the sensor frame, mm.

        Returns
        -------
        toward : x, y and z
            Unit direction in the gel, from the point to the place at which the ray leaves the gel.
        length
            Length of the ray in the gel, mm.
        factor
            Solid angle at the point per area of the light, times transmittance and n^2. Times the light's radiance in air and the
            cosine at the point, it is the irradiance per area of the light. Light from behind has the factor zero.
        """
        (x, y, z), (light_x, light_y, light_z) = point, light
        across_x, across_y = light_x - x, light_y - y
        rho2 = dr.fma(across_y, across_y, across_x * across_x)
        rho = dr.sqrt(dr.maximum(rho2, 1e-12))
        layers = ((self.back - light_z, 1.0), (self.front - self.back, self.window_index), (z - self.front, self.gel_index))
        per_rho = dr.rcp(layers[0][0] + layers[1][0] / self.window_index + layers[2][0] / self.gel_index)
        u = rho * per_rho
        for _ in range(NEWTON_STEPS):
            reach, slope = _reach(dr, layers, u)
            u = dr.maximum(u + (rho - reach) / slope, 0.0)
        _, slope = _reach(dr, layers, u)
        cos_air = dr.rsqrt(1 + u * u)
        sine = u * cos_air
        sin_gel, sin_window = sine / self.gel_index, sine / self.window_index
        cos_gel, cos_window = dr.sqrt(1 - sin_gel * sin_gel), dr.sqrt(1 - sin_window * sin_window)
        sine_per_rho = dr.select(rho2 > 1e-8, sine / rho, per_rho)
        # d omega = sin(gel) d(gel) d(phi),  d area = rho d(rho) d(phi),  cos(gel) d(gel) = cos_air^3 du / n
        solid = sine_per_rho * cos_air**3 / (self.gel_index**2 * cos_gel * slope)
        factor = solid * self.transmittance(cos_air, cos_window, cos_gel) * self.gel_index**2
        return (across_x / rho * sin_gel, across_y / rho * sin_gel, -cos_gel), (z - self.front) / cos_gel, factor

    def transmittance(self, cos_air: DrJit, cos_window: DrJit, cos_gel: DrJit) -> DrJit:
        """Transmittance of the slab for light that is unpolarised at each face, including multiple reflections within the slab."""
        outer, inner = fresnel(1 / self.window_index, cos_air, cos_window), self._inner_face(cos_gel, cos_window)
        return (1 - outer) * (1 - inner) / (1 - outer * inner)

    def mirror(self, dr: ModuleType, mi: ModuleType, place: DrJit, direction: DrJit, choice: DrJit) -> tuple[DrJit, DrJit, DrJit]:
        """Reflect a ray that reaches the window's gel side at ``place`` from the gel.

        The uniform random number ``choice`` decides which face reflects the ray. The back face also displaces it.

        Returns
        -------
        place : mi.Point3f
        back : mi.Vector3f
        weight : mi.Float
            Reflectance of the whole slab.
        """
        cos_gel = -direction.z
        sine2 = (1 - cos_gel * cos_gel) * self.gel_index**2
        cos_window = dr.sqrt(dr.maximum(1 - sine2 / self.window_index**2, 0))
        total = sine2 >= 1
        cos_air = dr.sqrt(dr.maximum(1 - sine2, 0))
        inner = self._inner_face(cos_gel, cos_window)
        outer = dr.select(total, 1.0, fresnel(self.window_index, cos_window, cos_air))
        through = (1 - inner) ** 2 * outer / (1 - inner * outer)
        weight = inner + through
        shift = dr.select(choice * weight < inner, 0.0, 2 * (self.front - self.back) / dr.maximum(cos_window, 1e-4))
        bend = self.gel_index / self.window_index
        moved = mi.Point3f(place.x + direction.x * bend * shift, place.y + direction.y * bend * shift, place.z)
        return moved, mi.Vector3f(direction.x, direction.y, cos_gel), weight

    def _inner_face(self, cos_gel: DrJit, cos_window: DrJit) -> DrJit:
        return fresnel(self.gel_index / self.window_index, cos_gel, cos_window)


def _refract(dr: ModuleType, mi: ModuleType, direction: DrJit, ratio: float) -> DrJit:
    x, y = direction.x * ratio, direction.y * ratio
    return mi.Vector3f(x, y, dr.sqrt(dr.maximum(1 - x * x - y * y, 1e-8)))


def _reach(dr: ModuleType | type[NumPy], layers: tuple[tuple[DrJit, float], ...], u: DrJit) -> tuple[DrJit, DrJit]:
    reach, slope = 0.0, 0.0
    for height, n in layers:
        rest = dr.rsqrt(n * n + (n * n - 1) * u * u)
        reach = reach + height * u * rest
        slope = slope + height * n * n * rest**3
    return reach, slope


def fresnel(index: DrJit, cos_here: DrJit, cos_there: DrJit) -> DrJit:
    """Unpolarised reflectance of a face with n_here / n_there = ``index``, for numbers or arrays of any kind."""
    s = (index * cos_here - cos_there) / (index * cos_here + cos_there)
    p = (cos_here - index * cos_there) / (cos_here + index * cos_there)
    return 0.5 * (s * s + p * p)


def valid_radius(camera: CameraSpec) -> float:
    """Tangent up to which the distorted radius increases by more than a twentieth of the undistorted one (inf: everywhere)."""
    fisheye = camera.projection == "fisheye"
    radius = np.linspace(0, np.pi / 2 if fisheye else WIDEST_FIELD, 6001)
    slope = 1 + 3 * camera.k1 * radius**2 + 5 * camera.k2 * radius**4
    folded = np.flatnonzero(slope <= 0.05)
    if not len(folded):
        return float("inf")
    return float(np.tan(radius[folded[0]]) if fisheye else radius[folded[0]])


@lru_cache(maxsize=4)
def ray_table(camera: CameraSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    """Unit directions (H + 1, W + 1, 3) in the camera frame, in air, at the corners of a window's pixels.

    ``window_px`` = (x0, y0, x1, y1), end exclusive; corner (j, i) is at pixel (x0 + i - 0.5, y0 + j - 0.5).
    Beyond the distortion's valid field the tangents are extrapolated linearly. The array is shared and can't be written to.
    """
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
