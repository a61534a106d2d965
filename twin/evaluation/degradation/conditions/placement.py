"""Degradations by the camera's place and lens."""

import cv2
import numpy as np

from scenes.sensor import CameraSpec, SensorSpec
from twin.camera.projection import lens_disc
from twin.evaluation.degradation.condition import OnSection, PictureView, in_family

# Direction of a shift in the picture: unit vector at 30 deg from x towards y.
AWAY = (np.cos(np.radians(30.0)), np.sin(np.radians(30.0)))


def shifted(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """The chip is displaced from the lens' axis."""
    by = value * PictureView.of(spec, np.zeros((0, 2))).px_per_mm
    return spec.alter(camera={"cx_px": spec.camera.cx_px + AWAY[0] * by, "cy_px": spec.camera.cy_px + AWAY[1] * by})


def tilted(camera: CameraSpec, value: float, rng: np.random.Generator) -> CameraSpec:
    """A camera that is rotated about x."""
    return camera.alter(tilt_x_deg=camera.tilt_x_deg + value)


def zoomed(camera: CameraSpec, value: float, rng: np.random.Generator) -> CameraSpec:
    """Another focal length."""
    return camera.alter(fx_px=camera.fx_px * (1 + value), fy_px=camera.fy_px * (1 + value))


def distorted(spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
    """Another lens, with a barrel distortion that moves the disc's rim inwards by a share of its radius."""
    rim = lens_disc(spec.view, spec.housing).radius_px / spec.camera.fx_px
    return spec.alter(camera={"k1": spec.camera.k1 - value / rim**2})


def vignetted(camera: CameraSpec, value: float, rng: np.random.Generator) -> CameraSpec:
    """Darker corners."""
    return camera.alter(vignetting=camera.vignetting + value * (1 - camera.vignetting))


def roll(degrees: float, view: PictureView) -> np.ndarray:
    """Map (2, 3) of pixels for a camera that is rotated about its axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn, about = np.array([[c, -s], [s, c]]), np.array([view.spec.camera.cx_px, view.spec.camera.cy_px])
    return np.column_stack([turn, about - turn @ about])


def skew(rise: float, view: PictureView) -> np.ndarray:
    """Map (2, 3) of pixels for a rolling shutter: the shift of a row is proportional to its distance from the disc's centre."""
    return np.array([[1.0, rise, -rise * view.center_px[1]], [0.0, 1.0, 0.0]])


def warped(light: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Light (H, W[, 3]) with its pixels moved by a map (2, 3). Beyond the border the last row or column is repeated."""
    return cv2.warpAffine(light, matrix, light.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def mapped(px: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Positions (n, 2) that a map (2, 3) of pixels moves to."""
    return px @ matrix[:, :2].T + matrix[:, 2]


def rolled(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A camera that is rotated about its axis."""
    return warped(light, roll(value, view))


def rolled_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in the picture of a rolled camera."""
    return mapped(px, roll(value, view))


def sheared(light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """Rows that are exposed one after the other while the camera moves."""
    return warped(light, skew(0.5 * value * view.px_per_mm / view.radius_px, view))


def sheared_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a sheared picture."""
    return mapped(px, skew(0.5 * value * view.px_per_mm / view.radius_px, view))


_condition = in_family("camera")
CONDITIONS = (
    _condition("camera-shifted", "camera shifted", "shift at the caps", "mm", 16.0, spec=shifted),
    _condition("camera-rolled", "camera rotated", "angle", "deg", 60.0, light=rolled, moves=rolled_points, image_level=True),
    _condition("camera-tilted", "camera tilted", "angle", "deg", 24.0, spec=OnSection("camera", tilted)),
    _condition("camera-zoomed", "camera zoomed in", "growth of the picture", "", 0.4, spec=OnSection("camera", zoomed)),
    _condition("camera-distorted", "another camera's distortion", "rim drawn in, of its radius", "", 0.3, spec=distorted),
    _condition(
        "vignetting", "vignetting", "share of light lost at the corners", "", 1.0, spec=OnSection("camera", vignetted), image_level=True
    ),
    _condition(
        "rolling-shutter",
        "rolling shutter in motion",
        "motion over the disc's height",
        "mm",
        24.0,
        light=sheared,
        moves=sheared_points,
        image_level=True,
    ),
)
