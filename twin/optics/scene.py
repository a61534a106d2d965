"""The Mitsuba scene of skin, stems and caps, and its rendering with the scalar variant. No other module names Mitsuba's plugins.

The scalar variant works on every machine. Its rendering of the gel is an approximation with Mitsuba's own path tracer. The camera is a
pinhole in the gel, at the point nearest to the caps' rays. The LEDs are in the gel, at their apparent positions as seen from the caps. The
picture is then warped to the refracted image through the window, for points at the depth of the caps. The window reflects no light.
"""

from collections.abc import Mapping, Sequence
from types import ModuleType

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import map_coordinates

from scenes.sensor import AppearanceSpec, SensorSpec, ViewSpec
from twin.camera.projection import pixel_rays, project, window_tangent
from twin.geometry.pins import rest_pins
from twin.optics.direct_light import Patch, lights
from twin.optics.surfaces import PaintedSurface, vertex_normals
from twin.optics.tracer import luminance
from twin.optics.variant import DrJit, with_room
from twin.types import FloatArray, IntArray, PinState

# Refractive index of the skin and the caps (acrylate rubber).
SKIN_INDEX = 1.52

PAINT = {"type": "mesh_attribute", "name": "vertex_paint"}
OVERSAMPLING = 1.3
"""Number of pixels of the pinhole camera's image for one pixel of the frame, along a side."""
COARSE = 8
"""Spacing of the points at which the caps' depth is interpolated, px."""
DEPTH_NEIGHBOURS = 24
"""Number of nearest caps from which the depth of a point is interpolated."""


def build_scene(
    mi: ModuleType, look: AppearanceSpec, gel_index: float, surfaces: Mapping[str, PaintedSurface], *, extra: dict[str, DrJit] | None = None
) -> DrJit:
    """A Mitsuba scene of the surfaces in the gel, without camera or lights.

    Parameters
    ----------
    look : AppearanceSpec
    gel_index : float
    surfaces : mapping of str to Surface
        By the names ``skin``, ``stems`` and ``caps``.
    extra : dict, optional
        Further entries of the scene's dictionary, for example lights and an integrator.

    Returns
    -------
    mi.Scene
        Its updatable meshes have the ids ``skin``, ``stems`` and ``caps``.
    """
    skin = _rubber(mi, {"type": "rgb", "value": list(look.skin_albedo)}, look.skin_gloss, look.skin_roughness, gel_index)
    stem = _rubber(mi, {"type": "rgb", "value": list(look.pin_albedo)}, 0.0, 1.0, gel_index)
    cap = _rubber(mi, PAINT, look.cap_gloss, look.cap_roughness, gel_index)
    description = {"type": "scene"}
    for name, bsdf, smooth in (("skin", skin, True), ("stems", stem, True), ("caps", cap, False)):
        description[name] = mesh(mi, name, surfaces[name], bsdf, smooth=smooth)
    return mi.load_dict(description | (extra or {}), parallel=False)


def build_pinhole_camera(mi: ModuleType, to_world: FloatArray, half_field: float, size_px: int, spp: int) -> DrJit:
    """An ideal square pinhole camera for tangents within +-half_field.

    ``to_world`` is the pose (4, 4) of a frame with z forwards, x right and y down. The tangent of pixel (i, j) along x is
    ``((i + 0.5) / size_px * 2 - 1) * half_field``, and along y the same with j.
    """
    film = {"type": "hdrfilm", "width": size_px, "height": size_px, "rfilter": {"type": "box"}, "component_format": "float32"}
    camera = {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(half_field))),
        "near_clip": 0.01,
        "far_clip": 1e4,
        # Mitsuba's image x and y have the opposite directions of its camera's x and y
        "to_world": mi.ScalarTransform4f(to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": film | {"pixel_format": "luminance" if mi.variant().endswith("mono") else "rgb"},
        "sampler": {"type": "multijitter", "sample_count": spp},
    }
    return mi.load_dict(camera)


def mesh(mi: ModuleType, name: str, surface: PaintedSurface, bsdf: DrJit, *, smooth: bool, emitter: DrJit | None = None) -> DrJit:
    """A Mitsuba mesh with the id ``name``. The surface's paint becomes a vertex attribute."""
    props = mi.Properties()
    props["bsdf"] = bsdf
    props["face_normals"] = not smooth
    if emitter is not None:
        props["emitter"] = emitter
    made = mi.Mesh(name, len(surface.vertices_mm), len(surface.faces), props=props, has_vertex_normals=smooth)
    if surface.paint is not None:
        paint = luminance(surface.paint)[:, None] if mi.variant().endswith("mono") else surface.paint
        made.add_attribute(PAINT["name"], paint.shape[1], with_room(paint.ravel(), np.float32))
    params = mi.traverse(made)
    params["faces"] = with_room(surface.faces.ravel(), np.uint32)
    params["vertex_positions"] = with_room(surface.vertices_mm.ravel(), np.float32)
    params.update()
    _set_normals(params, {"": surface})
    made.set_id(name)
    return made


def move_meshes(params: DrJit, surfaces: dict[str, PaintedSurface]) -> None:
    """Move the vertices of a scene's meshes; ``params`` are the scene's traversed parameters, ``surfaces`` has the meshes' ids as keys."""
    for name, surface in surfaces.items():
        params[f"{name}.vertex_positions"] = with_room(surface.vertices_mm.ravel(), np.float32)
    params.update()
    _set_normals(params, {f"{name}.": surface for name, surface in surfaces.items()})


def _set_normals(params: DrJit, surfaces: Mapping[str, PaintedSurface]) -> None:
    """Set the vertex normals of smooth meshes, by the prefix of their parameters.

    Mitsuba computes them, too, but its threads add to the same numbers in any order: last digits, and so pictures, would differ from run
    to run.
    """
    for prefix, surface in surfaces.items():
        if len(params[f"{prefix}vertex_normals"]):
            params[f"{prefix}vertex_normals"] = with_room(vertex_normals(surface.vertices_mm, surface.faces).ravel(), np.float32)
    params.update()


def _rubber(mi: ModuleType, reflectance: Mapping[str, object], gloss: float, roughness: float, gel_index: float) -> DrJit:
    """A matt material with a rough specular lobe of weight ``gloss`` at its boundary to the gel."""
    if gloss == 0:
        return mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    boundary = {"int_ior": SKIN_INDEX, "ext_ior": gel_index, "alpha": roughness}
    return mi.load_dict({"type": "roughplastic", "diffuse_reflectance": reflectance, "specular_reflectance": gloss} | boundary)


class ScalarView:
    """The counterpart of ``GelView`` for scalar variants."""

    def __init__(
        self, mi: ModuleType, spec: SensorSpec, window_px: tuple[int, int, int, int], surfaces: dict[str, PaintedSurface], bounces: int
    ) -> None:
        self._mi, self._view, self._window_px = mi, spec.view, window_px
        rest_mm = rest_pins(spec.geometry).caps_mm
        rest_px = project(self._view, rest_mm)
        emitters = _apparent_lights(mi, self._view, lights(spec.leds, spec.housing), rest_mm)
        integrator = {"type": "path", "max_depth": bounces + 2, "rr_depth": 100}
        self._scene = build_scene(mi, spec.appearance, spec.gel.refractive_index, surfaces, extra=emitters | {"integrator": integrator})
        self.params = mi.traverse(self._scene)
        place, direction = pixel_rays(self._view, rest_px)
        self._eye_mm = np.array([0.0, 0.0, nearest_point(place, direction)[2]])
        across = rest_mm - self._eye_mm
        self._half_field = 1.25 * float(np.abs(across[:, :2] / across[:, 2:]).max())
        pitch_px = np.ptp(rest_px, axis=0).max()
        self._size = int(OVERSAMPLING * 1.25 * pitch_px)

    def gel_light(self, pixels: IntArray, spp: int, seed: int, state: PinState) -> FloatArray:
        """Mean light (n, channels) of the given pixels (n,) of the window, numbered row by row."""
        mi = self._mi
        to_world = np.eye(4)
        to_world[:3, 3] = self._eye_mm
        camera = build_pinhole_camera(mi, to_world, self._half_field, self._size, spp)
        image = np.atleast_3d(np.array(mi.render(self._scene, sensor=camera, spp=spp, seed=seed % 2**32)))
        at = self._places(state)[pixels]
        return np.stack([map_coordinates(channel, at[:, ::-1].T, order=3, mode="nearest") for channel in np.moveaxis(image, 2, 0)], axis=1)

    def _places(self, state: PinState) -> FloatArray:
        """Position (H W, 2) in the pinhole image for each pixel of the window: the image of its ray's point at the depth of nearby caps."""
        caps_mm = state.caps_mm
        x0, y0, x1, y1 = self._window_px
        coarse = [np.arange(lo, hi + COARSE, COARSE) for lo, hi in ((x0, x1), (y0, y1))]
        grid = np.stack(np.meshgrid(*coarse), axis=-1)
        depth = RBFInterpolator(project(self._view, caps_mm), caps_mm[:, 2], neighbors=min(DEPTH_NEIGHBOURS, len(caps_mm)))
        z = np.maximum(depth(grid.reshape(-1, 2)), self._view.lens.z_mm).reshape(grid.shape[:2])
        place, direction = pixel_rays(self._view, grid.astype(float))
        seen = place + direction * ((z - place[..., 2]) / direction[..., 2])[..., None] - self._eye_mm
        ideal = (seen[..., :2] / np.maximum(seen[..., 2:], 1e-3) / self._half_field + 1) * 0.5 * self._size - 0.5
        fine = np.stack([_interpolate_grid(channel, (y1 - y0, x1 - x0)) for channel in np.moveaxis(ideal, 2, 0)], axis=-1)
        return fine.reshape(-1, 2)


def nearest_point(place: FloatArray, direction: FloatArray) -> FloatArray:
    """The point (3,) with the smallest sum of squared distances to the lines through ``place`` (n, 3) along ``direction``."""
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, place))


def _interpolate_grid(values: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Values at every pixel from those on a grid with a spacing of COARSE px."""
    rows, columns = (np.arange(n) / COARSE for n in shape)
    return map_coordinates(values, np.meshgrid(rows, columns, indexing="ij"), order=3, mode="nearest")


def _apparent_lights(mi: ModuleType, view: ViewSpec, patches: Sequence[Patch], caps_mm: FloatArray) -> dict[str, DrJit]:
    """An emitter for every LED, at the apparent position of the LED in the gel, with its apparent brightness."""
    made, unseen = {}, mi.load_dict({"type": "null"})
    for k, patch in enumerate(p for p in patches if p.half_mm.any()):
        place, direction, gain = _refracted_rays(view, patch, caps_mm)
        middle = nearest_point(place, direction)
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ patch.half_mm
        corners = middle + np.column_stack([square, np.zeros(4)])
        away = caps_mm - middle
        dist2 = np.sum(away**2, axis=1)
        flat = away[:, 2] / np.sqrt(dist2) / dist2  # solid angle per area of the square in the gel
        radiance = patch.radiance * float(np.median(gain / np.maximum(flat, 1e-9)))
        emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": [float(c) for c in radiance]}})
        surface = PaintedSurface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
        made[f"led{k}"] = mesh(mi, f"led{k}", surface, unseen, smooth=False, emitter=emitter)
    return made


def _refracted_rays(view: ViewSpec, patch: Patch, points_mm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Refracted rays from points in the gel to a patch: places and unit directions (n, 3), and solid angle per area of the patch."""
    across = points_mm[:, :2] - patch.center_mm[:2]
    rho = np.linalg.norm(across, axis=1)
    lift = 1e-3
    u, wider = (window_tangent(view, r, points_mm[:, 2], behind_mm=patch.center_mm[2]) for r in (rho, rho + lift))
    n = view.gel_index
    sine, next_sine = (t / np.sqrt(1 + t * t) / n for t in (u, wider))
    cosine = np.sqrt(1 - sine**2)
    direction = np.column_stack([across / np.maximum(rho, 1e-9)[:, None] * sine[:, None], cosine])
    solid = sine * (next_sine - sine) / lift / cosine / np.maximum(rho, 1e-9) * n**2
    return points_mm - direction, direction, solid
