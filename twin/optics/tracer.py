"""Path tracing on the gel's side of the window.

At every vertex the light of all patches through the window is computed in closed form, without shadows. Then one patch is drawn with a
probability proportional to its light and tested for a shadow. If there is no shadow, this random choice causes no noise. Paths that leave
towards the window are reflected by it (including total reflection) or lost in the housing.
"""

from types import ModuleType

import numpy as np

from scenes.sensor import SensorSpec
from twin.optics.direct_light import Patch, lights, received_share
from twin.optics.glass import Window
from twin.optics.sampling import PixelSamples
from twin.optics.variant import DrJit
from twin.types import FloatArray

SURVIVAL_GAIN = 4.0
"""Ratio of the probability that a path continues to the path's weight (Russian roulette). The probability is at most 1."""
LEAST_SURVIVAL = 0.05
"""Smallest probability that a path continues."""
NEVER = 1e-12
"""Threshold below which a probability counts as 0."""


class GelTracer:
    """Light that arrives at the camera's side of the window along rays in the gel.

    Attributes
    ----------
    scene : mi.Scene
        Skin, stems and caps, without lights.
    window : Window
    patches, radiances : list of Patch, list of mi.Spectrum
        The lights; their radiances can have gradients.
    bounces : int
        Number of scatterings of a path after its first vertex.
    tints : list of (mi.ShapePtr, mi.Spectrum)
        Factors on the reflectances of shapes; they can have gradients.
    """

    def __init__(self, mi: ModuleType, spec: SensorSpec, scene: DrJit, bounces: int) -> None:
        self.scene, self.window, self.bounces = scene, Window(spec.view), bounces
        self.patches = lights(spec.leds, spec.housing)
        self.radiances = [spectrum(mi, p.radiance) for p in self.patches]
        self._absorption, self._bump = spec.gel.absorption_per_mm, spec.appearance.cap_bump
        self._caps = next(mi.ShapePtr(shape) for shape in scene.shapes() if shape.id() == "caps")
        self.tints: list[tuple[DrJit, DrJit]] = []

    def radiance(self, mi: ModuleType, dr: ModuleType, place: DrJit, direction: DrJit, random: PixelSamples) -> DrJit:
        """Radiance in the gel, divided by n^2, along rays that start on the window's gel side.

        Because the skin is dark, few paths continue after the first vertex. They are gathered in shorter arrays, so that ended paths take
        no time.

        Parameters
        ----------
        place : mi.Point3f
        direction : mi.Vector3f
        random : PixelSamples

        Returns
        -------
        mi.Spectrum
        """
        ray, weight = mi.Ray3f(place, direction), mi.Spectrum(1.0)
        hit = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        active = hit.is_valid()
        weight *= self._transmittance(mi, dr, hit.t, active)
        result, sample = mi.Spectrum(0.0), None
        for bounce in range(self.bounces + 1):
            bsdf = hit.bsdf(ray)
            light = dr.select(active, weight * self._direct(mi, dr, hit, bsdf, random, active), 0.0)
            if sample is None:
                result += light
            else:
                dr.scatter_add(result, light, sample, active, mode=dr.ReduceMode.NoConflicts)  # else kernels hold the array's size
            if bounce == self.bounces:
                break
            out, value = bsdf.sample(mi.BSDFContext(), hit, random.next_1d(), random.next_2d(), active)
            weight *= value * self._tint(mi, dr, hit)
            survival = dr.clip(SURVIVAL_GAIN * dr.detach(dr.max(weight)), LEAST_SURVIVAL, 1.0)
            active &= (random.next_1d() < survival) & (dr.max(weight) > 0)
            weight /= survival
            ray = hit.spawn_ray(hit.to_world(out.wo))
            dr.eval(active, ray.o, ray.d, weight, result)
            alive = dr.compress(active)
            if len(alive) == 0:
                break
            ray = mi.Ray3f(dr.gather(mi.Point3f, ray.o, alive), dr.gather(mi.Vector3f, ray.d, alive))
            weight = dr.gather(mi.Spectrum, weight, alive)
            sample = alive if sample is None else dr.gather(mi.UInt32, sample, alive)
            random = random.of(alive)
            ray, hit, weight, active = self._follow(mi, dr, ray, weight, random)
        return result / self.window.gel_index**2

    def _follow(self, mi: ModuleType, dr: ModuleType, ray: DrJit, weight: DrJit, random: PixelSamples) -> tuple[DrJit, DrJit, DrJit, DrJit]:
        """The next vertices of rays in the gel. The window reflects rays that reach it without meeting a surface."""
        first = self.scene.ray_intersect_preliminary(ray, coherent=False)
        up = ~first.is_valid() & (ray.d.z < -1e-6)
        far = dr.select(up, (self.window.front - ray.o.z) / dr.minimum(ray.d.z, -1e-6), 0.0)
        place, back, share = self.window.mirror(dr, mi, ray.o + ray.d * far, ray.d, random.next_1d())
        up &= dr.squared_norm(mi.Point2f(place.x, place.y)) < self.window.radius**2
        ray = mi.Ray3f(dr.select(up, place, ray.o), dr.select(up, back, ray.d))
        hit = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=up | first.is_valid())
        active = hit.is_valid()
        weight *= dr.select(up, share, 1.0) * self._transmittance(mi, dr, far + hit.t, active)
        return ray, hit, weight, active

    def _direct(self, mi: ModuleType, dr: ModuleType, hit: DrJit, bsdf: DrJit, random: PixelSamples, active: DrJit) -> DrJit:
        """Reflected radiance of the patches' light at a vertex."""
        place, ways, shares = random.next_2d(), [], []
        total = mi.Float(0.0)
        bump = dr.select(hit.shape == self._caps, self._bump, 0.0)
        for patch, radiance in zip(self.patches, self.radiances, strict=True):
            way, length, factor = self.window.connect(dr, hit.p, _point(mi, dr, patch, place))
            toward = mi.Vector3f(*way)
            ways.append((toward, length, factor * patch.area_mm2 * radiance))
            taken = received_share(dr, dr.dot(toward, hit.sh_frame.n), bump)
            strength = dr.detach(dr.max(radiance)) * factor * patch.area_mm2 * taken
            total += dr.select(active, strength, 0.0)
            shares.append(mi.Float(total))
        at = random.next_1d() * total
        toward, length, arriving, share = mi.Vector3f(0.0, 0.0, -1.0), mi.Float(0.0), mi.Spectrum(0.0), mi.Float(0.0)
        before = mi.Float(0.0)
        for (way, far, light), after in zip(ways, shares, strict=True):
            chosen = (at >= before) & (at < after)
            toward, length = dr.select(chosen, way, toward), dr.select(chosen, far, length)
            arriving, share = dr.select(chosen, light, arriving), dr.select(chosen, after - before, share)
            before = after
        leaves = hit.p + toward * length
        lit = active & (share > NEVER) & (dr.squared_norm(mi.Point2f(leaves.x, leaves.y)) < self.window.radius**2)
        shadow = hit.spawn_ray(toward)
        shadow.maxt = length * (1 - 1e-4)
        lit &= ~self.scene.ray_test(shadow, coherent=False, active=lit)
        local = hit.to_local(toward)
        reflected = bsdf.eval(mi.BSDFContext(), hit, local, lit) * (received_share(dr, local.z, bump) / dr.maximum(local.z, NEVER))
        arriving *= self._transmittance(mi, dr, length, lit) * self._tint(mi, dr, hit)
        return dr.select(lit, reflected * arriving * (total / dr.maximum(share, NEVER)), 0.0)

    def _tint(self, mi: ModuleType, dr: ModuleType, hit: DrJit) -> DrJit:
        factor = mi.Spectrum(1.0)
        for shape, tint in self.tints:
            factor = dr.select(hit.shape == shape, tint, factor)
        return factor

    def _transmittance(self, mi: ModuleType, dr: ModuleType, length: DrJit, active: DrJit) -> DrJit:
        if not any(self._absorption):
            return mi.Spectrum(1.0)
        return dr.exp(-spectrum(mi, np.array(self._absorption)) * dr.select(active, length, 0.0))


def spectrum(mi: ModuleType, rgb: FloatArray) -> DrJit:
    """Linear RGB (3,) as a spectrum of the current variant (luminance in a mono one)."""
    return mi.Spectrum(luminance(rgb)) if mi.variant().endswith("mono") else mi.Spectrum(*(float(c) for c in rgb))


def luminance(rgb: FloatArray) -> FloatArray:
    """Rec. 709 luminance (...,) of linear RGB (..., 3)."""
    return np.asarray(rgb) @ [0.212671, 0.715160, 0.072169]


def _point(mi: ModuleType, dr: ModuleType, patch: Patch, square: DrJit) -> DrJit:
    """Points of a patch for points of the unit square, uniform over its area."""
    (x, y, z), (inner, outer) = (float(v) for v in patch.center_mm), (float(r) for r in patch.radii_mm)
    if outer > 0:
        radius = dr.sqrt(inner**2 + (outer**2 - inner**2) * square.x)
        sine, cosine = dr.sincos(2 * dr.pi * square.y)
        return mi.Point3f(x + radius * cosine, y + radius * sine, z)
    u, v = 2 * square.x - 1, 2 * square.y - 1
    (ux, uy), (vx, vy) = patch.half_mm
    return mi.Point3f(x + float(ux) * u + float(vx) * v, y + float(uy) * u + float(vy) * v, z)
