"""Fit of everything that contact does not change: disc edge, ring and LEDs' glow, LEDs' reflections in the window, specks.

All are fitted to the per-pixel median of the frames, whose gray levels are converted to light by the known response curve. LED power, gel
haze and everything on the gel's side of the window are not changed.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from scenes.sensor import CameraSpec, SensorSpec
from twin.calibration.light.leds import fit_reflections, turn_leds
from twin.calibration.light.ring import fit_disc_edge, fit_ring
from twin.calibration.light.specks import fit_specks
from twin.calibration.light.still import Still, median_still
from twin.errors import FrameError
from twin.progress import Step, report_each, unheard

# Share of pixels at exactly 0 or 255 above which frames count as thresholded. Raw frames are saturated only on the ring.
MOST_BINARY = 0.6
# Most frames that are used, spread evenly. More frames do not improve the median.
MOST_FRAMES = 40


def fit_surroundings(spec: SensorSpec, images: np.ndarray, pins_px: np.ndarray, progress: Step = unheard) -> SensorSpec:
    """The specification with housing, LED places and reflections, and specks fitted to frames of one sensor.

    Parameters
    ----------
    spec : SensorSpec
        Camera, response, ``leds.power``, ``leds.balance`` and ``gel.haze`` are known and not changed.
    images : (M, H, W, 3) or (M, H, W) uint8
        Raw frames with different contacts, RGB or gray.
    pins_px : (M, N, 2) float
        Pins in raw-frame px; NaN if not found.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    FrameError
        The frames are thresholded, do not have the camera's size or show no disc, or pins are outside the picture.
    """
    images, pins_px = np.asarray(images), np.asarray(pins_px, float)
    _require_raw_frames(images, spec.camera, spec.name)
    _require_pins_inside(pins_px, spec.camera)
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), MOST_FRAMES)).astype(int))
    images, pins_px = images[chosen], pins_px[chosen]
    images = np.repeat(images[..., None], 3, axis=3) if images.ndim == 3 else images
    still = median_still(spec, images)
    specks = partial(fit_specks, images=images, pins_px=pins_px)
    fits: tuple[Callable[[SensorSpec, Still], SensorSpec], ...] = (fit_disc_edge, turn_leds, fit_reflections, fit_ring, specks)
    for fit in report_each(fits, progress):
        spec = fit(spec, still)
    return spec


def _require_raw_frames(images: np.ndarray, camera: CameraSpec, name: str) -> None:
    """Raise ``FrameError`` if frames (M, H, W[, 3]) do not have the camera's size, or are thresholded."""
    height, width = images.shape[1:3]
    if (height, width) != (camera.height_px, camera.width_px):
        raise FrameError(f"frames are {width} x {height} px, the camera of {name} has {camera.width_px} x {camera.height_px}")
    if np.mean((images == 0) | (images == 255)) > MOST_BINARY:
        raise FrameError(
            f"the frames of {name} are thresholded: they have no gray levels, from which the light of the surroundings could be fitted; "
            "give raw camera frames, or keep the specification's housing and leds"
        )


def _require_pins_inside(pins_px: np.ndarray, camera: CameraSpec) -> None:
    """Raise ``FrameError`` if a found pin of (M, N, 2) is outside the picture; lost pins are NaN."""
    last = np.array([camera.width_px, camera.height_px]) - 1
    outside = ((np.rint(pins_px) < 0) | (np.rint(pins_px) > last)).any(axis=2)  # comparisons with NaN are false
    if outside.any():
        frame, pin = np.argwhere(outside)[0].tolist()
        x, y = pins_px[frame, pin]
        raise FrameError(
            f"frame {frame}, pin {pin}: lies at ({x:.1f}, {y:.1f}) px, outside the {camera.width_px} x {camera.height_px} px picture; "
            "give the pins that the pipeline finds in these frames (raw form), and NaN where it finds none"
        )
