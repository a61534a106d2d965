"""The same scene with its real interfaces, for Mitsuba's own path tracer: slow to converge, and nothing of ours but the meshes."""

import numpy as np
from plain_sensor import changed, plain
from scipy import stats

from scenes.sensor import SensorSpec
from twin.optics.direct_light import lights
from twin.optics.scene import build_pinhole_camera, build_scene, mesh
from twin.optics.surfaces import PaintedSurface

DEPTH = 24
RR_DEPTH = 8
BLOCK_PX = 4
HALF_FIELD = 0.2  # tangent: the caps fill the film, the LEDs' mirror images stay outside


def laboratory(size_px: int) -> SensorSpec:
    """A bright sensor that plain path tracing can manage: 19 big caps, glossy gray skin, large LEDs, no housing in sight."""
    middle, gray = (size_px - 1) / 2, (0.3, 0.3, 0.3)
    focal = size_px / 2 / HALF_FIELD
    ideal = dict.fromkeys(("tilt_x_deg", "tilt_y_deg", "k1", "k2", "p1", "p2", "aperture_mm"), 0.0)
    return changed(
        plain(),
        pins={"rings": 2, "cap_diameter_mm": 5.0, "cap_height_mm": 0.6, "max_polar_deg": 40.0},
        gel={"absorption_per_mm": (0.0, 0.0, 0.0)},
        camera=ideal | {
            "channels": "mono", "projection": "perspective", "width_px": size_px, "height_px": size_px,
            "fx_px": focal, "fy_px": focal, "cx_px": middle, "cy_px": middle,
        },
        leds={
            "azimuth_deg": (12.0, 55.0, 100.0, 145.0, 190.0, 230.0, 275.0, 322.0),
            "radius_mm": 16.0, "z_mm": -8.0, "size_mm": 6.0, "core_share": 0.0, "balance": (), "off": (),
        },
        housing={"aperture_radius_mm": 1000.0, "outer_radius_mm": 2000.0, "center_mm": (0.0, 0.0), "fill": 0.0},
        appearance={
            "skin_albedo": gray, "skin_gloss": 1.0, "pin_albedo": gray, "cap_albedo": (0.9, 0.9, 0.9), "cap_gloss": 0.0,
            "cap_bump": 0.0, "cap_variation": 0.0, "cap_levels": (), "cap_shapes": (), "specks": (),
        },
    )  # fmt: skip


def blocks(images: np.ndarray) -> np.ndarray:
    """Means over BLOCK_PX x BLOCK_PX px of square films (..., size, size): (..., blocks)."""
    count = images.shape[-1] // BLOCK_PX
    parts = images.reshape(*images.shape[:-2], count, BLOCK_PX, count, BLOCK_PX)
    return parts.mean(axis=(-3, -1)).reshape(*images.shape[:-2], -1)


def z_scores(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Differences of means over independent batches (batches, ...), as normal scores: Welch's t-test, its p-values turned into z."""
    t, p = stats.ttest_ind(ours, theirs, axis=0, equal_var=False)
    return np.sign(t) * stats.norm.isf(np.maximum(p, 1e-300) / 2)


def reference(mi, spec, surfaces, size_px, spp, seed):
    """Linear light (size, size) on a square film seen by the camera in the air, in a mono variant; mean of ``spp`` samples."""
    lens = spec.lens
    faces = {"front": (lens.z_mm, spec.gel.refractive_index, lens.refractive_index), "back": (lens.back_mm, lens.refractive_index, 1.0)}
    extra = {"integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": RR_DEPTH}}
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
    for k, patch in enumerate(lights(spec.leds, spec.housing)):
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ patch.half_mm
        corners = patch.center_mm + np.column_stack([square, np.zeros(4)])
        emitter = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": patch.radiance.tolist()}})
        surface = PaintedSurface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
        extra[f"led{k}"] = mesh(mi, f"led{k}", surface, mi.load_dict({"type": "null"}), smooth=False, emitter=emitter)
    scene = build_scene(mi, spec.appearance, spec.gel.refractive_index, surfaces, extra=extra)
    to_world = np.eye(4)
    to_world[2, 3] = -spec.camera.distance_mm
    camera = build_pinhole_camera(mi, to_world, size_px / 2 / spec.camera.fx_px, size_px, spp)
    return np.array(mi.render(scene, sensor=camera, spp=spp, seed=seed))[..., 0]
