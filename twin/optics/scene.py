"""The optical scene in Mitsuba's terms; the only module that names its plugins.

Light comes from the apparent LEDs (squares that light the gel and are themselves invisible from behind),
is scattered by skin, stems and caps, and reaches the film through the table camera. What the camera sees
of the housing and of the LEDs' reflections in the lens is painted light: it faces the camera and lights
nothing, so it costs no noise.
"""

import numpy as np

from scenes.sensor import SensorSpec
from twin.optics import sensor as camera_plugin
from twin.optics.surfaces import Surface, glints, housing, led_ring
from twin.projection import sensor_to_camera

GEL_INDEX, SKIN_INDEX = 1.41, 1.52  # silicone gel; acrylate rubber
SKIN_ROUGHNESS = 0.25
LED_RADIANCE = 250.0  # of an LED of power 1: a white cap then sends about 1, the unit of the linear image

PAINT = {"type": "mesh_attribute", "name": "vertex_paint"}


def build_scene(mi, spec: SensorSpec, *, skin: Surface, stems: Surface, caps: Surface, max_depth: int):
    """A Mitsuba scene without a camera.

    Returns
    -------
    mi.Scene
        Its updatable meshes have the ids ``skin``, ``stems`` and ``caps``.
    """
    look = spec.appearance
    description = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth, "rr_depth": 100},
        "skin": _mesh(mi, "skin", skin, _skin_bsdf(mi, look), smooth=True),
        "stems": _mesh(mi, "stems", stems, _diffuse(mi, look.pin_albedo), smooth=True),
        "caps": _mesh(mi, "caps", caps, _by_vertex(mi), smooth=False),
        "leds": _leds(mi, spec),
        "housing": _painted(mi, "housing", housing(spec)),
    }
    reflections = glints(spec)
    if reflections is not None:
        description["glints"] = _painted(mi, "glints", reflections)
    return mi.load_dict(description, parallel=False)


def build_table_camera(mi, spec: SensorSpec, table: np.ndarray, *, spp: int):
    """The spec's camera with its distortion, for Dr.Jit variants; the film has the table's window."""
    camera_plugin.register(mi.variant())
    height, width = table.shape[0] - 1, table.shape[1] - 1
    return mi.load_dict(
        {
            "type": camera_plugin.PLUGIN,
            "to_world": mi.ScalarTransform4f(np.linalg.inv(sensor_to_camera(spec.camera))),
            "table": mi.TensorXf(table.astype(np.float32)),
            "film": _film(mi, width, height),
            "sampler": _sampler(spp),
        }
    )


def build_pinhole_camera(mi, spec: SensorSpec, half_field: float, size_px: int, *, spp: int):
    """An ideal square pinhole camera on the spec's axes that sees normalised coordinates within +-half_field.

    Its image has x right and y down as the spec's camera has: pixel (i, j) sees
    ``((i + 0.5) / size_px * 2 - 1) * half_field`` in each.
    """
    # Mitsuba's image x and y run against its camera's.
    to_world = np.linalg.inv(sensor_to_camera(spec.camera)) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(half_field))),
            "near_clip": 0.01,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(to_world),
            "film": _film(mi, size_px, size_px),
            "sampler": _sampler(spp),
        }
    )


def _film(mi, width: int, height: int) -> dict:
    pixel = "luminance" if mi.variant().endswith("mono") else "rgb"
    form = {"pixel_format": pixel, "component_format": "float32"}
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **form}


def _sampler(spp: int) -> dict:
    return {"type": "multijitter", "sample_count": spp}


def _diffuse(mi, albedo) -> object:
    return mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}})


def _by_vertex(mi) -> object:
    return mi.load_dict({"type": "diffuse", "reflectance": PAINT})


def _skin_bsdf(mi, look) -> object:
    """Matt rubber with a faint gloss where it meets the gel."""
    if look.skin_gloss == 0:
        return _diffuse(mi, look.skin_albedo)
    return mi.load_dict(
        {
            "type": "roughplastic",
            "diffuse_reflectance": {"type": "rgb", "value": list(look.skin_albedo)},
            "specular_reflectance": look.skin_gloss,
            "int_ior": SKIN_INDEX,
            "ext_ior": GEL_INDEX,
            "alpha": SKIN_ROUGHNESS,
        }
    )


def _leds(mi, spec: SensorSpec):
    """All LEDs as one emitter, so that which one a sample picks does not depend on the order of loading."""
    color = {"type": "rgb", "value": [LED_RADIANCE * spec.leds.power * c for c in spec.leds.color]}
    unseen = mi.load_dict({"type": "null"})
    return _mesh(mi, "leds", led_ring(spec), unseen, smooth=False, emitter={"type": "area", "radiance": color})


def _painted(mi, name: str, surface: Surface):
    """A black surface that sends out its painted radiance; never sampled as a light."""
    emitter = {"type": "area", "sampling_weight": 0.0, "radiance": PAINT}
    return _mesh(mi, name, surface, _diffuse(mi, (0.0, 0.0, 0.0)), smooth=False, emitter=emitter)


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Rec. 709 luminance (...,) of linear RGB (..., 3)."""
    return np.asarray(rgb) @ [0.212671, 0.715160, 0.072169]


def _mesh(mi, name: str, surface: Surface, bsdf, *, smooth: bool, emitter=None):
    props = mi.Properties()
    props["bsdf"] = bsdf
    props["face_normals"] = not smooth
    if emitter is not None:
        props["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh(name, len(surface.vertices_mm), len(surface.faces), props=props, has_vertex_normals=smooth)
    if surface.paint is not None:
        paint = luminance(surface.paint)[:, None] if mi.variant().endswith("mono") else surface.paint
        mesh.add_attribute(PAINT["name"], paint.shape[1], np.ascontiguousarray(paint, np.float32).ravel())
    params = mi.traverse(mesh)
    params["faces"] = np.ascontiguousarray(surface.faces, np.uint32).ravel()
    params["vertex_positions"] = np.ascontiguousarray(surface.vertices_mm, np.float32).ravel()
    params.update()
    mesh.set_id(name)
    return mesh
