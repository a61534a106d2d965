"""Degradations between window and camera chip: focus, motion, dirt, scratches."""

import cv2
import numpy as np

from twin.evaluation.degradation.condition import PictureView, in_family, over_channels

# Number of sub-pixels of a pixel along each axis, over which the kernel of a blur is averaged.
SUBPIXELS = 8
# Direction of the motion in the picture, deg from x towards y.
MOTION_DEG = 30.0
# Standard deviation of the Gaussian by which smudges are made from noise, mm at the caps. It is the smudges' size. Chosen.
DIRT_SPACING_MM = 1.5
# Share of the light that a smudge absorbs. Chosen.
DIRT_OPACITY = 0.9
# Standard deviation of a smudge's edge, mm at the caps. The edge is soft, because the lens' surface is out of focus.
DIRT_EDGE_MM = 0.5
# Width of a scratch, mm at the caps, and the light that it scatters, in saturations. Chosen.
SCRATCH_WIDTH_MM, SCRATCH_LIGHT = 0.12, 0.25
# Number of scratches whose places are drawn at once, so that the first scratches have the same places for any number.
MOST_SCRATCHES = 1000
# Number of blurs between which a focus that varies over the picture is interpolated.
FOCUS_STEPS = 6


def blurred_by(light: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Light (H, W[, 3]) blurred by a kernel of sum 1. The picture is mirrored at its border."""
    return cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REFLECT)


def disc_kernel(diameter_px: float) -> np.ndarray:
    """Coverage of pixels by a disc, with the sum 1: the circle of confusion."""
    half = int(np.ceil(diameter_px / 2 + 0.5))
    fine = (np.arange((2 * half + 1) * SUBPIXELS) + 0.5) / SUBPIXELS - half - 0.5
    inside = fine[:, None] ** 2 + fine**2 <= (diameter_px / 2) ** 2
    kernel = inside.reshape(2 * half + 1, SUBPIXELS, 2 * half + 1, SUBPIXELS).mean(axis=(1, 3))
    if kernel.sum() == 0:  # the disc is smaller than a sub-pixel
        kernel[half, half] = 1
    return (kernel / kernel.sum()).astype(np.float32)


def line_kernel(length_px: float, degrees: float) -> np.ndarray:
    """Coverage of pixels by a straight line, with the sum 1."""
    half = int(np.ceil(length_px / 2 + 1))
    along = np.linspace(-0.5, 0.5, 20 * half + 1) * length_px
    x, y = along * np.cos(np.radians(degrees)) + half, along * np.sin(np.radians(degrees)) + half
    kernel = np.zeros((2 * half + 2, 2 * half + 2))
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for dx in (0, 1):
        for dy in (0, 1):
            np.add.at(kernel, (top + dy, left + dx), np.abs(1 - dx - (x - left)) * np.abs(1 - dy - (y - top)))
    return (kernel[: 2 * half + 1, : 2 * half + 1] / kernel.sum()).astype(np.float32)


def defocus(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A focus that has moved."""
    return blurred_by(light, disc_kernel(value * view.px_per_mm))


def motion(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A camera that moves during the exposure."""
    return blurred_by(light, line_kernel(value * view.px_per_mm, MOTION_DEG))


def rolled_focus(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A tilted lens: the diameter of the circle of confusion is linear from one rim of the disc to the other."""
    x, y = view.grid(light.shape)
    place = np.clip(0.5 + 0.5 * (0.8 * y - 0.6 * x), 0, 1) * FOCUS_STEPS
    sharp_to_soft = [light] + [blurred_by(light, disc_kernel(value * view.px_per_mm * k / FOCUS_STEPS)) for k in range(1, FOCUS_STEPS + 1)]
    mixed = np.zeros_like(light)
    for k, layer in enumerate(sharp_to_soft):
        mixed += layer * over_channels(np.clip(1 - np.abs(place - k), 0, 1), light)
    return mixed


def dirt(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Smudges that cover a share of the disc and absorb most of the light."""
    noise = rng.standard_normal(light.shape[:2], dtype=np.float32)
    field = cv2.GaussianBlur(noise, (0, 0), DIRT_SPACING_MM * view.px_per_mm)
    x, y = view.grid(light.shape)
    level = np.quantile(field[x * x + y * y < 1], 1 - value)
    cover = cv2.GaussianBlur((field >= level).astype(np.float32), (0, 0), DIRT_EDGE_MM * view.px_per_mm)
    return light * over_channels(1 - np.float32(DIRT_OPACITY) * cover, light)


def scratched(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Straight scratches across the disc that scatter the LEDs' light."""
    turn, away = rng.uniform(0, np.pi, MOST_SCRATCHES), rng.uniform(-0.9, 0.9, MOST_SCRATCHES)
    bright = rng.uniform(0.3, 1.0, MOST_SCRATCHES)
    x, y = view.grid(light.shape)
    half = max(0.5 * SCRATCH_WIDTH_MM * view.px_per_mm, 0.5) / view.radius_px
    added = np.zeros(light.shape[:2], np.float32)
    for k in range(int(np.ceil(value))):
        part = min(value - k, 1.0)  # the last scratch may be only a part of one
        distance = np.abs(np.cos(turn[k]) * x + np.sin(turn[k]) * y - away[k])
        added += np.float32(part * bright[k] * SCRATCH_LIGHT * view.saturation) * np.exp(-0.5 * (distance / half) ** 2)
    added *= x * x + y * y < 1
    return light + over_channels(added, light)


_condition = in_family("optics", image_level=True)
CONDITIONS = (
    _condition("defocus", "camera out of focus", "circle of confusion at the caps", "mm", 4.0, light=defocus),
    _condition("focus-rolled", "focus rolled off to one side", "circle of confusion at the far rim", "mm", 6.0, light=rolled_focus),
    _condition("motion-blur", "motion blur", "path of the picture during the exposure", "mm", 5.0, light=motion),
    _condition("lens-dirt", "dirt on the lens", "share of the disc under smudges", "", 0.9, light=dirt),
    _condition("lens-scratches", "scratched lens", "scratches", "", 120.0, light=scratched),
)
