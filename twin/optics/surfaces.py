"""Fine triangle surfaces for rendering: skin, stems, caps, housing, glints.

Topology depends on the specification alone, so that between states only vertex positions
change. All positions are in the sensor frame, mm.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator

from scenes.sensor import SensorSpec
from twin.errors import RenderError

SKIN_POLAR_STEPS = 64
SKIN_AZIMUTH_STEPS = 128
STEM_SIDES = 12
CAP_SIDES = 24
HOUSING_AZIMUTH_STEPS = 360
CAP_BEVEL = 0.25  # of the cap's height: printed edges are never sharp
STEM_ROOT_MM = 0.3  # stems start inside the skin, so that no gap opens where it bends
MOST_CONTROL_POINTS = 1200  # displacement interpolation solves a dense system of this size once


@dataclass(frozen=True)
class Surface:
    """Triangles ``faces (m, 3)`` over ``vertices_mm (n, 3)``; ``paint (n, 3)`` per vertex: radiance of what shines, reflectance of caps."""

    vertices_mm: np.ndarray
    faces: np.ndarray
    paint: np.ndarray | None = None


class SkinSurface:
    """The skin's inside as a fine dome grid that follows scattered displacements smoothly.

    The displacement of the fine grid is the thin-plate spline (Duchon 1977) through the control
    points' displacements in the dome's azimuthal equidistant chart; with the control points
    fixed it is one constant matrix.

    Parameters
    ----------
    spec : SensorSpec
    control_mm : (n, 3) float
        Rest positions, on the inside of the skin, at which displacements will be given.
    """

    def __init__(self, spec: SensorSpec, control_mm: np.ndarray):
        inner_mm = spec.skin.outer_radius_mm - spec.skin.thickness_mm
        rim_rad = np.arccos(np.clip(spec.skin.rim_z_mm / inner_mm, -1, 1))
        polar = np.linspace(0, rim_rad, SKIN_POLAR_STEPS + 1)[1:]
        azimuth = np.arange(SKIN_AZIMUTH_STEPS) * 2 * np.pi / SKIN_AZIMUTH_STEPS
        theta, phi = (a.ravel() for a in np.meshgrid(polar, azimuth, indexing="ij"))
        apex = np.array([[0.0, 0.0, 1.0]])
        outward = np.concatenate([apex, np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)])
        self.rest_mm = inner_mm * outward
        self.faces = _fan_grid(SKIN_POLAR_STEPS, SKIN_AZIMUTH_STEPS)
        # The rim is clamped: fixed points there keep the spline still where no control point is.
        self._keep = np.unique(np.linspace(0, len(control_mm) - 1, min(len(control_mm), MOST_CONTROL_POINTS)).astype(int))
        chart = _chart(control_mm[self._keep])
        rim_chart = _chart(self.rest_mm[-SKIN_AZIMUTH_STEPS::4])
        apart = np.min(np.linalg.norm(rim_chart[:, None] - chart[None], axis=2), axis=1) > 0.02
        sites = np.concatenate([chart, rim_chart[apart]])
        unit = np.eye(len(sites))[:, : len(chart)]
        self._weights = RBFInterpolator(sites, unit, kernel="thin_plate_spline")(_chart(self.rest_mm)).astype(np.float32)
        self.control_mm = control_mm

    def vertices(self, control_mm: np.ndarray) -> np.ndarray:
        """Fine grid (v, 3) when the control points have moved to ``control_mm`` (n, 3)."""
        moved = (control_mm - self.control_mm)[self._keep]
        return self.rest_mm + self._weights @ moved


def stems(spec: SensorSpec, base_mm: np.ndarray, axis: np.ndarray) -> Surface:
    """All pin stems, one surface: cylinders from the skin to the cap."""
    length = spec.pins.length_mm
    profile = np.array([[0.5 * spec.pins.diameter_mm, -STEM_ROOT_MM], [0.5 * spec.pins.diameter_mm, length]])
    return _lathe(profile, base_mm, axis, STEM_SIDES)


def caps(spec: SensorSpec, caps_mm: np.ndarray, axis: np.ndarray) -> Surface:
    """All caps, one surface: bevelled discs about their centres."""
    radius, half = 0.5 * spec.pins.cap_diameter_mm, 0.5 * spec.pins.cap_height_mm
    bevel = min(CAP_BEVEL * spec.pins.cap_height_mm, 0.5 * radius)
    edge = [[radius, half - bevel], [radius - 0.3 * bevel, half - 0.3 * bevel], [radius - bevel, half]]
    body = _lathe(np.array([[0, -half], [radius, -half], *edge, [0, half]]), caps_mm, axis, CAP_SIDES)
    look, count = spec.appearance, len(caps_mm)
    each = 1 + look.cap_variation * np.random.default_rng(look.cap_pattern).standard_normal((count, 1))
    paint = np.clip(each * np.array(look.cap_albedo), 0, 1)
    return Surface(body.vertices_mm, body.faces, np.repeat(paint, len(body.vertices_mm) // count, axis=0))


def housing(spec: SensorSpec) -> Surface:
    """The ring and wall around the disc, painted with the light it sends to the camera.

    Radiance at p, at a distance rho from the ring's axis: ``albedo * power * (ambient * lit share of LEDs *
    exp(-(rho - aperture) / falloff) + glow * sum over lit LEDs of (1 + |p - led|^2 / h^2)^-n)``.
    """
    part, lit = spec.housing, _lit_leds(spec)
    band = part.outer_radius_mm - part.aperture_radius_mm
    steps = np.concatenate([np.linspace(0, 1, 49) ** 2 * band, part.lip_width_mm + np.array([0.0, 0.01])])
    rho = part.aperture_radius_mm + np.unique(np.clip(steps, 0, band))
    turn = np.arange(HOUSING_AZIMUTH_STEPS) * 2 * np.pi / HOUSING_AZIMUTH_STEPS
    r, phi = (g.ravel() for g in np.meshgrid(rho, turn, indexing="ij"))
    xy = np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)
    out = r - part.aperture_radius_mm
    light = part.ambient * len(lit) / len(spec.leds.azimuth_deg) * np.exp(-out / part.ambient_falloff_mm)
    for led in lit:
        away = np.linalg.norm(xy - part.glow_radius_mm * led, axis=1) / part.glow_height_mm
        light = light + part.glow * (1 + away**2) ** -part.glow_exponent
    light = spec.leds.power * light * np.where(out < part.lip_width_mm + 0.005, 1.0, part.wall_fraction)
    vertices = np.concatenate([xy + part.center_mm, np.full((len(xy), 1), part.z_mm)], axis=1)
    return Surface(vertices, _facing_camera(vertices, _ring_grid(len(rho) - 1, len(turn))), light[:, None] * np.array(part.albedo))


def glints(spec: SensorSpec) -> Surface | None:
    """Reflections of the lit LEDs in the lens: pale squares with a bright heart, or None if there are none to show."""
    look, lit = spec.appearance, _lit_leds(spec)
    if look.glint_strength == 0:
        return None
    n = 9
    u, v = (g.ravel() for g in np.meshgrid(np.linspace(-0.5, 0.5, n), np.linspace(-0.5, 0.5, n), indexing="ij"))
    heart = 0.8 + 6.0 * np.exp(-((u - 0.15) ** 2 + v**2) / (2 * 0.16**2))
    vertices, faces, light = [], [], []
    for k, led in enumerate(lit):
        side = np.array([-led[1], led[0]])
        xy = spec.housing.center_mm + look.glint_radius_mm * led + look.glint_size_mm * (u[:, None] * led + v[:, None] * side)
        vertices.append(np.concatenate([xy, np.full((len(xy), 1), spec.housing.z_mm + 0.01)], axis=1))
        faces.append(_sheet(n) + k * n * n)
        light.append(look.glint_strength * spec.leds.power * heart[:, None] * np.array(spec.leds.color))
    vertices = np.concatenate(vertices)
    return Surface(vertices, _facing_camera(vertices, np.concatenate(faces)), np.concatenate(light))


def led_ring(spec: SensorSpec) -> Surface:
    """The lit LEDs, one surface: squares whose normals look along +z, away from the camera."""
    half = 0.5 * spec.leds.size_mm
    square = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    lit = _lit_leds(spec)
    places = np.concatenate([spec.leds.radius_mm * lit, np.full((len(lit), 1), spec.leds.z_mm)], axis=1)
    two = np.array([[0, 1, 2], [0, 2, 3]])
    return Surface((places[:, None] + square).reshape(-1, 3), (4 * np.arange(len(lit))[:, None, None] + two).reshape(-1, 3))


def _lit_leds(spec: SensorSpec) -> np.ndarray:
    """Unit vectors (k, 2) towards the LEDs that work."""
    lit = np.radians([a for k, a in enumerate(spec.leds.azimuth_deg) if k not in spec.leds.off])
    if not len(lit):
        raise RenderError(f"all {len(spec.leds.azimuth_deg)} LEDs of {spec.name} are off: shorten leds.off")
    return np.stack([np.cos(lit), np.sin(lit)], axis=1)


def _chart(points_mm: np.ndarray) -> np.ndarray:
    """Azimuthal equidistant chart (n, 2), rad, of points seen from the dome's centre."""
    unit = points_mm / np.linalg.norm(points_mm, axis=1, keepdims=True)
    polar = np.arccos(np.clip(unit[:, 2], -1, 1))
    rho = np.hypot(unit[:, 0], unit[:, 1])
    return unit[:, :2] * np.divide(polar, rho, out=np.ones_like(rho), where=rho > 1e-9)[:, None]


def _fan_grid(rings: int, around: int) -> np.ndarray:
    """Triangles of an apex (vertex 0) and ``rings`` circles of ``around`` vertices; normals towards the inside of a dome."""
    k = np.arange(around)
    fan = np.stack([np.zeros_like(k), 1 + (k + 1) % around, 1 + k], axis=1)
    return np.concatenate([fan, 1 + _ring_grid(rings - 1, around)[:, ::-1]])


def _ring_grid(bands: int, around: int) -> np.ndarray:
    """Triangles between ``bands + 1`` circles of ``around`` vertices each."""
    j, k = (g.ravel() for g in np.meshgrid(np.arange(bands), np.arange(around), indexing="ij"))
    a, b = j * around + k, j * around + (k + 1) % around
    return np.concatenate([np.stack([a, a + around, b], axis=1), np.stack([b, a + around, b + around], axis=1)])


def _sheet(n: int) -> np.ndarray:
    """Triangles of an n by n grid of vertices."""
    j, k = (g.ravel() for g in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a = j * n + k
    return np.concatenate([np.stack([a, a + n, a + 1], axis=1), np.stack([a + 1, a + n, a + n + 1], axis=1)])


def _facing_camera(vertices_mm: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The flat faces, wound so that their normals look along -z."""
    a, b, c = (vertices_mm[faces[:, i]] for i in range(3))
    up = np.cross(b - a, c - a)[:, 2] > 0
    return np.where(up[:, None], faces[:, ::-1], faces)


def _lathe(profile: np.ndarray, origin_mm: np.ndarray, axis: np.ndarray, sides: int) -> Surface:
    """Copies of a turned body, profile (k, 2) of (radius, height), at each origin along its axis; normals outwards."""
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, axis)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(axis, u)
    turn = np.arange(sides) * 2 * np.pi / sides
    circle = np.cos(turn)[None, :, None] * u[:, None] + np.sin(turn)[None, :, None] * v[:, None]
    body = profile[None, :, None, :1] * circle[:, None] + profile[None, :, None, 1:] * axis[:, None, None]
    vertices = origin_mm[:, None, None] + body
    each = len(profile) * sides
    one = _ring_grid(len(profile) - 1, sides)[:, ::-1]
    faces = (np.arange(len(origin_mm))[:, None, None] * each + one[None]).reshape(-1, 3)
    return Surface(vertices.reshape(-1, 3), faces)
