"""The same scene with its real interfaces, for Mitsuba's own path tracer: slow to converge, and nothing of ours but the meshes."""

import numpy as np

from twin.optics.lights import lights
from twin.optics.scene import build_pinhole_camera, build_scene, mesh
from twin.optics.surfaces import Surface

DEPTH = 24


def reference(mi, spec, surfaces, size_px, spp, seed):
    """Linear light (size, size, channels) on a square film seen by the camera in the air; mean of ``spp`` samples."""
    lens = spec.lens
    faces = {
        "front": (lens.z_mm, spec.gel.refractive_index, lens.refractive_index),
        "back": (lens.back_mm, lens.refractive_index, 1.0),
    }
    extra = {"integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": 8}}
    for name, (z, above, below) in faces.items():
        place = mi.ScalarTransform4f().translate([0, 0, z]).scale([lens.radius_mm, lens.radius_mm, 1])
        extra[name] = {"type": "disk", "to_world": place, "bsdf": {"type": "dielectric", "ext_ior": above, "int_ior": below}}
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    extra["edge"] = {
        "type": "cylinder",
        "p0": [0, 0, lens.back_mm],
        "p1": [0, 0, lens.z_mm],
        "radius": lens.radius_mm,
        "bsdf": {"type": "twosided", "b": dark},
    }
    for k, patch in enumerate(lights(spec)):
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ patch.half_mm
        corners = patch.center_mm + np.column_stack([square, np.zeros(4)])
        emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": patch.radiance.tolist()}})
        surface = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
        extra[f"led{k}"] = mesh(mi, f"led{k}", surface, mi.load_dict({"type": "null"}), smooth=False, emitter=emitter)
    scene = build_scene(mi, spec, **surfaces, extra=extra)
    to_world = np.eye(4)
    to_world[2, 3] = -spec.camera.distance_mm
    camera = build_pinhole_camera(mi, to_world, size_px / 2 / spec.camera.fx_px, size_px, spp)
    return np.array(mi.render(scene, sensor=camera, spp=spp, seed=seed))
