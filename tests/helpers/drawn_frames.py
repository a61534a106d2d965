"""Frames drawn with known sub-pixel truth: discs at given places, anti-aliased, optionally blurred and noisy."""

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.frames.forms import frame_size
from twin.pins import nominal_reference
from twin.types import Form, Frame

SUBPIXELS = 16  # per pixel and axis: places are drawn to 1/16 px or better
HALF_DIAGONAL_PX = 0.708  # of a pixel


def draw_discs(size_px, centers_px, radius_px, *, level=(15, 200), blur_px=0.0, noise_sd=0.0, rng=None) -> np.ndarray:
    """(H, W) uint8 picture of bright discs on a dark ground; coverage computed by supersampling."""
    coverage = _coverage(size_px, np.reshape(centers_px, (-1, 2)), np.broadcast_to(radius_px, len(centers_px)))
    image = level[0] + (level[1] - level[0]) * coverage
    if blur_px:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    if noise_sd:
        image = image + rng.normal(0, noise_sd, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _coverage(size_px, centers_px, radii_px) -> np.ndarray:
    """(H, W) share of each pixel that the largest of the discs covers; only pixels on a disc's edge are divided into smaller ones."""
    width, height = size_px
    coverage = np.zeros((height, width))
    if not len(centers_px):
        return coverage
    reach = int(np.ceil(max(radii_px))) + 1
    around = np.arange(-reach, reach + 1)
    columns, rows = (np.round(centers_px).astype(int)[:, k, None] + around for k in (0, 1))
    dx, dy = columns - centers_px[:, :1], rows - centers_px[:, 1:]
    beyond = np.hypot(dx[:, None, :], dy[:, :, None]) - radii_px[:, None, None]  # of a pixel's middle: (discs, rows, columns)
    seen = ((columns >= 0) & (columns < width))[:, None, :] & ((rows >= 0) & (rows < height))[:, :, None]
    disc, j, i = np.nonzero((beyond < HALF_DIAGONAL_PX) & seen)
    part = np.ones(len(disc))
    edge = np.flatnonzero(beyond[disc, j, i] > -HALF_DIAGONAL_PX)
    of = disc[edge]
    offsets = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
    dx2 = (columns[of, i[edge], None] + offsets - centers_px[of, :1]) ** 2
    dy2 = (rows[of, j[edge], None] + offsets - centers_px[of, 1:]) ** 2
    inside = dx2[:, None, :] + dy2[:, :, None] < (radii_px[of] ** 2)[:, None, None]
    part[edge] = np.count_nonzero(inside.reshape(-1, SUBPIXELS**2), axis=1) / SUBPIXELS**2
    np.maximum.at(coverage, (rows[disc, j], columns[disc, i]), part)
    return coverage


def cap_radii_px(spec: SensorSpec, form: Form) -> np.ndarray:
    """Plausible cap radii (N,) px: in proportion to the pitch around each pin."""
    return 0.28 * nominal_reference(spec, form).spacing_px


def drawn_frame(spec: SensorSpec, form: Form, centers_px, *, noise_sd=0.0, rng=None, radius_px=None, name="drawn") -> Frame:
    """A frame of a sensor with its N caps (or others of given radii) at ``centers_px``: gray (raw) or thresholded (recording)."""
    radius = cap_radii_px(spec, form) if radius_px is None else radius_px
    blur = 0.8 if form == Form.RAW else 0.5
    image = draw_discs(frame_size(spec, form), centers_px, radius, blur_px=blur, noise_sd=noise_sd, rng=rng)
    if form == Form.PROCESSED:
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
