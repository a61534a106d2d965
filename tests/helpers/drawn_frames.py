"""Frames drawn with known sub-pixel truth: discs at given places, anti-aliased, optionally blurred and noisy."""

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.frames.forms import frame_size
from twin.pins import nominal_reference
from twin.types import Form, Frame

SUBPIXELS = 16  # per pixel and axis: places are drawn to 1/16 px or better


def draw_discs(size_px, centers_px, radius_px, *, level=(15, 200), blur_px=0.0, noise_sd=0.0, rng=None) -> np.ndarray:
    """(H, W) uint8 picture of bright discs on a dark ground; coverage computed by supersampling."""
    width, height = size_px
    coverage = np.zeros((height, width))
    radii = np.broadcast_to(radius_px, len(centers_px))
    offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    for (x, y), radius in zip(centers_px, radii, strict=True):
        reach = int(np.ceil(radius)) + 1
        columns = np.arange(max(int(round(x)) - reach, 0), min(int(round(x)) + reach + 1, width))
        rows = np.arange(max(int(round(y)) - reach, 0), min(int(round(y)) + reach + 1, height))
        if not len(columns) or not len(rows):
            continue
        dx2 = ((columns[:, None] + offsets).ravel() - x) ** 2
        dy2 = ((rows[:, None] + offsets).ravel() - y) ** 2
        inside = dx2[None] + dy2[:, None] < radius**2
        part = inside.reshape(len(rows), SUBPIXELS, len(columns), SUBPIXELS).mean(axis=(1, 3))
        patch = coverage[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        np.maximum(patch, part, out=patch)
    image = level[0] + (level[1] - level[0]) * coverage
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    if noise_sd:
        image = image + rng.normal(0, noise_sd, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def cap_radii_px(spec: SensorSpec, form: Form) -> np.ndarray:
    """Plausible cap radii (N,) px: in proportion to the pitch around each pin."""
    return 0.28 * nominal_reference(spec, form).spacing_px


def drawn_frame(spec: SensorSpec, form: Form, centers_px, *, noise_sd=0.0, rng=None, radius_px=None, name="drawn") -> Frame:
    """A frame of a sensor with its N caps (or others of given radii) at ``centers_px``: gray (raw) or thresholded (recording)."""
    radius = cap_radii_px(spec, form) if radius_px is None else radius_px
    blur = 0.8 if form == Form.RAW else 0.5
    image = draw_discs(frame_size(spec, form), centers_px, radius, blur_px=blur, noise_sd=noise_sd, rng=rng)
    if form == Form.RECORDING:
        image = np.where(image > 107, 255, 0).astype(np.uint8)
    elif spec.camera.channels == "color":
        image = np.repeat(image[..., None], 3, axis=2)
    return Frame(image, form, name)


def smooth_warp(points_px, amplitude_px, rng) -> np.ndarray:
    """Points (N, 2) displaced by a random shear and dome-like bump that fade out towards the rim, ``amplitude_px`` at most."""
    center = points_px[0]
    radius = np.linalg.norm(points_px - center, axis=1).max()
    r = (points_px - center) / radius
    angle, spread = rng.uniform(0, 2 * np.pi), rng.uniform(-0.4, 1.0)
    focus = rng.uniform(-0.3, 0.3, 2)
    away = r - focus
    fade = np.clip(1 - (r**2).sum(axis=1), 0, None)
    field = fade[:, None] * ([np.cos(angle), np.sin(angle)] + spread * away * np.exp(-2 * (away**2).sum(axis=1))[:, None])
    return points_px + amplitude_px * field / np.linalg.norm(field, axis=1).max()
