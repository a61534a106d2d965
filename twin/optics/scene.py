"""The Mitsuba scene of skin, stems and caps. This is the only module that names Mitsuba's plugins."""

from collections.abc import Mapping
from types import ModuleType

import numpy as np

from scenes.sensor import AppearanceSpec
from twin.optics.surfaces import PaintedSurface, vertex_normals
from twin.optics.tracer import luminance
from twin.optics.variants.variant import DrJit, with_room
from twin.types import FloatArray

# Refractive index of the skin and the caps (acrylate rubber).
SKIN_INDEX = 1.52

PAINT = {"type": "mesh_attribute", "name": "vertex_paint"}


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
