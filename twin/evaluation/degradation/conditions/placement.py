"""Degradations by the camera's place and lens, by a stream that lost its place, and by a camera that was mounted otherwise."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from scenes.sensor import CameraSpec, SensorSpec
from twin.camera.projection import lens_disc
from twin.evaluation.degradation.condition import OnSection, PictureView, in_family

# Direction of a shift in the picture: unit vector at 30 deg from x towards y.
AWAY = (np.cos(np.radians(30.0)), np.sin(np.radians(30.0)))
FARTHEST_PX = 64.0
"""Most severe displacement of rows, px."""


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


@dataclass(frozen=True)
class Warp:
    """A picture whose pixels are moved by a map (2, 3) of a value and a view. Beyond the border the last row or column is repeated."""

    matrix: Callable[[float, PictureView], np.ndarray]

    def picture(self, light: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
        """The moved picture (H, W[, 3])."""
        size_px = light.shape[1::-1]
        return cv2.warpAffine(light, self.matrix(value, view), size_px, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    def points(self, px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
        """Positions (n, 2) in it."""
        matrix = self.matrix(value, view)
        return px @ matrix[:, :2].T + matrix[:, 2]


def roll(degrees: float, view: PictureView) -> np.ndarray:
    """Map of pixels for a camera that is rotated about its axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn, about = np.array([[c, -s], [s, c]]), np.array([view.spec.camera.cx_px, view.spec.camera.cy_px])
    return np.column_stack([turn, about - turn @ about])


def skew(value: float, view: PictureView) -> np.ndarray:
    """Map of pixels for rows that are exposed one after the other while the camera moves: a row is shifted by its height in the disc."""
    rise = 0.5 * value * view.px_per_mm / view.radius_px
    return np.array([[1.0, rise, -rise * view.center_px[1]], [0.0, 1.0, 0.0]])


def turn(degrees: float, view: PictureView) -> np.ndarray:
    """Map of pixels for a picture that is turned about its middle."""
    width, height = view.size_px
    return cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, 1.0)


def rolled(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture that begins at the wrong column; what leaves at the right comes back at the left."""
    return np.roll(image, round(value), axis=1)


def rolled_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a rolled picture."""
    return px + [round(value), 0]


def torn(image: np.ndarray, value: float, view: PictureView, rng: np.random.Generator) -> np.ndarray:
    """A picture whose lower half is rolled."""
    middle = len(image) // 2
    return np.concatenate([image[:middle], rolled(image[middle:], value, view, rng)])


def torn_points(px: np.ndarray, value: float, view: PictureView) -> np.ndarray:
    """Positions in a torn picture."""
    return px + np.where(px[:, 1:] >= int(view.size_px[1]) // 2, [round(value), 0.0], 0.0)


def mirror(value: float, view: PictureView) -> np.ndarray:
    """Map of pixels for a picture with left and right exchanged."""
    return np.array([[-1.0, 0.0, view.size_px[0] - 1], [0.0, 1.0, 0.0]])


ROLL, SKEW, TURN, MIRROR = Warp(roll), Warp(skew), Warp(turn), Warp(mirror)
_camera, _on_frames, _picture = in_family("camera"), in_family("camera", image_level=True), in_family("picture", image_level=True)
CONDITIONS = (
    _camera("camera-shifted", "camera shifted", "shift at the caps", "mm", 16.0, spec=shifted),
    _on_frames("camera-rolled", "camera rotated", "angle", "deg", 60.0, light=ROLL.picture, moves=ROLL.points),
    _camera("camera-tilted", "camera tilted", "angle", "deg", 24.0, spec=OnSection("camera", tilted)),
    _camera("camera-zoomed", "camera zoomed in", "growth of the picture", "", 0.4, spec=OnSection("camera", zoomed)),
    _camera("camera-distorted", "another camera's distortion", "rim drawn in, of its radius", "", 0.3, spec=distorted),
    _on_frames("vignetting", "vignetting", "share of light lost at the corners", "", 1.0, spec=OnSection("camera", vignetted)),
    _on_frames(
        "rolling-shutter", "rolling shutter in motion", "motion over the disc's height", "mm", 24.0, light=SKEW.picture, moves=SKEW.points
    ),
    _picture("picture-rolled", "rolled picture", "columns", "px", FARTHEST_PX, frame=rolled, moves=rolled_points),
    _picture("picture-torn", "torn picture", "columns of the lower half", "px", FARTHEST_PX, frame=torn, moves=torn_points),
    _picture("picture-turned", "turned picture", "angle", "deg", 180.0, frame=TURN.picture, moves=TURN.points),
    _picture("picture-mirrored", "mirrored picture", "mirrored", "", 1.0, frame=MIRROR.picture, moves=MIRROR.points),
)
