"""Which pixels need many samples: those of pins, whose edges are noisy. Dark bare skin is even after a few samples."""

import cv2
import numpy as np

from scenes.sensor import AppearanceSpec, PinsSpec, ViewSpec
from twin.projection import project
from twin.types import BoolArray, PinState

SKIN_SAVING = 4
"""Samples of a pixel that may show a pin for every sample of one that shows bare skin only."""
MARGIN_PX = 2.0
"""Added to the radius of each pin: the estimate of where its edge is may be wrong by this."""
SUBPIXEL_BITS = 4
"""OpenCV draws lines with places in units of 1 / 16 px."""


def near_pins(
    view: ViewSpec, pins: PinsSpec, appearance: AppearanceSpec, state: PinState, window_px: tuple[int, int, int, int]
) -> BoolArray:
    """Pixels (H, W) bool of a window of the raw frame that may show a part of a pin, from its foot to its cap."""
    x0, y0, x1, y1 = window_px
    across = np.array([1.0, 0.0, 0.0]) - state.axis[:, :1] * state.axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    middle = project(view, state.caps_mm)
    reach_mm = 0.5 * pins.cap_diameter_mm * _largest_outline(appearance)
    sides = [project(view, state.caps_mm + reach_mm * way) for way in (across, np.cross(state.axis, across))]
    radius = np.max([np.linalg.norm(side - middle, axis=1) for side in sides], axis=0) + MARGIN_PX
    feet = project(view, state.base_mm)
    mask, ends = np.zeros((y1 - y0, x1 - x0), np.uint8), np.stack([feet, middle], axis=1) - [x0, y0]
    fine = np.rint(ends * (1 << SUBPIXEL_BITS)).astype(np.int32)
    width = np.ceil(2 * radius).astype(int)
    for wide in np.unique(width):
        cv2.polylines(mask, list(fine[width == wide]), False, 1, int(wide), cv2.LINE_8, SUBPIXEL_BITS)  # their ends are round
    return mask.astype(bool)


def _largest_outline(appearance: AppearanceSpec) -> float:
    """Of the caps' outlines, relative to a circle."""
    shapes = np.array(appearance.cap_shapes or [[0.0]])
    return float(1 + np.abs(shapes).sum(axis=1).max())
