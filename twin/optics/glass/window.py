"""The plane window between camera, LEDs and gel, computed in Dr.Jit (see ``twin.camera.projection`` for the equation of rays)."""

from dataclasses import dataclass
from types import ModuleType

from scenes.sensor import ViewSpec
from twin.optics.variants.variant import DrJit

NEWTON_STEPS = 5
"""Steps of Newton's method from the paraxial start; a sixth step changes a direction by less than 1e-5."""


@dataclass(frozen=True)
class Window:
    """Planes (z, mm) and indices of air | window | gel."""

    back: float
    front: float
    window_index: float
    gel_index: float
    radius: float

    @classmethod
    def of(cls, view: ViewSpec) -> "Window":
        """The window of a sensor."""
        lens = view.lens
        return cls(lens.back_mm, lens.z_mm, lens.refractive_index, view.gel_index, lens.radius_mm)

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
        return place, in_gel, self.transmittance(dr, direction.z, in_window.z, in_gel.z)

    def connect(self, dr: ModuleType, mi: ModuleType, point: DrJit, light: DrJit) -> tuple[DrJit, DrJit, DrJit]:
        """The refracted ray from points in the gel to points of a light in the air whose normal is +z.

        Returns
        -------
        toward : mi.Vector3f
            Unit direction in the gel, from the point to the place at which the ray leaves the gel.
        length : mi.Float
            Length of the ray in the gel, mm.
        factor : mi.Float
            Solid angle at the point per area of the light, times transmittance and n^2. Times the light's radiance in air and the
            cosine at the point, it is the irradiance per area of the light. Light from behind has the factor zero.
        """
        across = mi.Vector2f(light.x - point.x, light.y - point.y)
        rho2 = dr.squared_norm(across)
        rho = dr.sqrt(dr.maximum(rho2, 1e-12))
        layers = ((self.back - light.z, 1.0), (self.front - self.back, self.window_index), (point.z - self.front, self.gel_index))
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
        toward = mi.Vector3f(across.x / rho * sin_gel, across.y / rho * sin_gel, -cos_gel)
        factor = solid * self.transmittance(dr, cos_air, cos_window, cos_gel) * self.gel_index**2
        return toward, (point.z - self.front) / cos_gel, factor

    def transmittance(self, dr: ModuleType, cos_air: DrJit, cos_window: DrJit, cos_gel: DrJit) -> DrJit:
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


def _reach(dr: ModuleType, layers: tuple[tuple[DrJit, float], ...], u: DrJit) -> tuple[DrJit, DrJit]:
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
