"""Degradations of the light: LEDs, light from outside, and what lies between window and camera chip: focus, motion, dirt, scratches."""

import cv2
import numpy as np

from scenes.sensor import LedRingSpec
from twin.evaluation.degradation.condition import OnSection, PictureView, in_family, over_channels

# Light in the middle of a glare, in saturations. It is large, so that the camera is saturated far beyond the glare's half width.
GLARE = 3.0
# Place of the glare's middle: x and y from the disc's centre, in units of the disc's radius.
GLARE_AT = (0.35, -0.25)
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


def dimmed(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """All LEDs weaker."""
    return leds.alter(power=leds.power * (1 - value))


def dead(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """Lit LEDs go out one after the other around the ring."""
    balance = np.array(leds.balance or (1.0,) * len(leds.azimuth_deg))
    lit = np.setdiff1d(np.arange(len(balance)), leds.off)
    balance[lit] *= np.clip(1 - (value * len(lit) - np.arange(len(lit))), 0, 1)
    return leds.alter(balance=tuple(balance.tolist()))


def reddened(leds: LedRingSpec, value: float, rng: np.random.Generator) -> LedRingSpec:
    """LEDs that have changed their colour."""
    red, green, blue = leds.color
    return leds.alter(color=(red, green * (1 - value), blue * (1 - value)))


def room_light(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Additional light over the whole frame, which increases from one side of the disc to the other."""
    x, y = view.grid(light.shape)
    ramp = np.clip(0.5 + 0.5 * (0.8 * x + 0.6 * y), 0, 1)
    return light + over_channels(value * view.saturation * ramp, light)


def glare(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """The reflection of a lamp: uniform in the middle, with a steep edge."""
    x, y = view.grid(light.shape)
    radius = 0.5 * value * view.px_per_mm / view.radius_px
    away2 = ((x - GLARE_AT[0]) ** 2 + (y - GLARE_AT[1]) ** 2) / radius**2
    return light + over_channels(GLARE * view.saturation * np.exp(-np.log(GLARE) * away2**2), light)


def blurred_by(light: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Light (H, W[, 3]) blurred by a kernel of sum 1. The picture is mirrored at its border."""
    return cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REFLECT)


def disc_kernel(diameter_px: float) -> np.ndarray:
    """Coverage of pixels by a disc, with the sum 1: the circle of confusion. The smallest disc covers the pixel in the middle alone."""
    diameter_px = max(diameter_px, 2 / SUBPIXELS)
    half = int(np.ceil(diameter_px / 2 + 0.5))
    fine = (np.arange((2 * half + 1) * SUBPIXELS) + 0.5) / SUBPIXELS - half - 0.5
    inside = fine[:, None] ** 2 + fine**2 <= (diameter_px / 2) ** 2
    kernel = inside.reshape(2 * half + 1, SUBPIXELS, 2 * half + 1, SUBPIXELS).mean(axis=(1, 3))
    return (kernel / kernel.sum()).astype(np.float32)


def line_kernel(length_px: float, degrees: float) -> np.ndarray:
    """Coverage of pixels by a straight line, with the sum 1."""
    half, angle = int(np.ceil(length_px / 2 + 1)), np.radians(degrees)
    along, pixels = np.linspace(-0.5, 0.5, 20 * half + 1)[:, None] * length_px, np.arange(-half, half + 1)
    columns, rows = (np.maximum(1 - np.abs(pixels - share * along), 0) for share in (np.cos(angle), np.sin(angle)))
    kernel = rows.T @ columns
    return (kernel / kernel.sum()).astype(np.float32)


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


_light, _optics = in_family("light"), in_family("optics", image_level=True)
CONDITIONS = (
    _light("leds-dim", "LEDs grown dim", "share of the LEDs' light lost", "", 0.995, spec=OnSection("leds", dimmed)),
    _light("leds-dead", "LEDs dead, one after the other", "share of the LEDs", "", 1.0, spec=OnSection("leds", dead)),
    _light("leds-red", "LED colour shifted to red", "share of green and blue lost", "", 0.995, spec=OnSection("leds", reddened)),
    _light("room-light", "room light leaking in", "light at the bright side, in saturations", "", 1.5, light=room_light, image_level=True),
    _light("glare", "saturated glare", "diameter at the caps", "mm", 16.0, light=glare, image_level=True),
    _optics("defocus", "camera out of focus", "circle of confusion at the caps", "mm", 4.0, light=defocus),
    _optics("focus-rolled", "focus rolled off to one side", "circle of confusion at the far rim", "mm", 6.0, light=rolled_focus),
    _optics("motion-blur", "motion blur", "path of the picture during the exposure", "mm", 5.0, light=motion),
    _optics("lens-dirt", "dirt on the lens", "share of the disc under smudges", "", 0.9, light=dirt),
    _optics("lens-scratches", "scratched lens", "scratches", "", 120.0, light=scratched),
)
