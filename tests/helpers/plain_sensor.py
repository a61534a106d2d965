"""The laboratory's sensor: ``ur5-331`` with ideal optics and an even print, whatever its calibration says."""

from scenes import load_sensor
from scenes.sensor import SensorSpec

SECTIONS = {
    "gel": {"haze": 0.0, "absorption_per_mm": (0.0, 0.0, 0.0)},
    "lens": {"refractive_index": 1.49},
    "camera": {
        "aperture_mm": 0.0, "vignetting": 0.0, "red_scale": 1.0, "blue_scale": 1.0, "red_shift_px": (0.0, 0.0), "blue_shift_px": (0.0, 0.0),
    },
    "leds": {"size_mm": 1.6, "power": 0.7, "balance": (), "off": (), "mirror_share": 1.0, "core_share": 0.0},
    "housing": {
        "ambient": 0.8, "ambient_falloff_mm": 8.27586, "glow": 3.2, "glow_radius_mm": 16.4993, "glow_height_mm": 1.48726,
        "glow_exponent": 1.48105, "center_mm": (-0.22, 0.27), "rim": None, "background": None,
    },
    "appearance": {
        "skin_albedo": (0.0048, 0.0066, 0.023), "pin_albedo": (0.006, 0.009, 0.03), "cap_albedo": (0.2, 0.41, 0.8),
        "skin_gloss": 0.0, "cap_gloss": 0.0,
        "cap_bump": 0.0, "cap_variation": 0.0, "cap_levels": (), "cap_shapes": (), "cap_offsets": (), "specks": (), "relief": None,
    },
    "response": {
        "exposure": 1.0, "gamma": 2.2, "black_level": 4.0, "blur_sigma_px": 0.6, "read_noise": 2e-4, "shot_noise": 6e-5, "sharpening": 0.0,
        "sharpening_sigma_px": 1.5, "chroma_sigma_px": 0.0, "chroma_median_px": 0, "chroma_columns": 1, "noise_sigma_px": 0.0,
        "stream": "rgb", "jpeg_quality": 0, "residual": None,
    },
}  # fmt: skip


def changed(spec: SensorSpec, **sections) -> SensorSpec:
    """A copy of the specification with values changed, section by section."""
    return spec.model_copy(update={name: getattr(spec, name).model_copy(update=values) for name, values in sections.items()})


def plain() -> SensorSpec:
    """A specification that a new calibration of the shipped one does not change."""
    return changed(load_sensor("ur5-331"), **SECTIONS)
