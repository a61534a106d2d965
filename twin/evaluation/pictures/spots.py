"""Bright spots that do not move with the pins: reflections of the LEDs in the window, bubbles."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from twin.camera.projection import Disc

# Side of the median filter that computes the background, px; smallest difference of a spot from the background, gray levels.
GROUND_PX, RISE = 25, 20.0
# Least area of a spot.
MIN_AREA_PX2 = 4
# Distance from the disc's edge within which nothing is searched, px.
RIM_PX = 4.0
# Distance from a pin, as a share of the pins' spacing, within which nothing is searched.
PIN_SHARE = 0.75
# Largest difference of a steady spot's place between frames, px; least share of the frames that show it, because pins hide it in others.
STEADY_PX, STEADY_SHARE = 3.0, 0.5
# Largest distance of a real spot from its rendered counterpart, px.
MOST_APART_PX = 6.0


@dataclass(frozen=True)
class Spots:
    """Bright spots: places (k, 2) px, peaks (k,) in gray levels."""

    px: np.ndarray
    peak: np.ndarray


def find_spots(gray: np.ndarray, disc: Disc, pins_px: np.ndarray, spacing_px: float) -> Spots:
    """Spots of a gray frame (H, W) in the disc and away from the pins (n, 2)."""
    looked = (disc.inside & clear_of_pins(gray.shape, pins_px, PIN_SHARE * spacing_px)).astype(np.uint8)
    looked &= cv2.circle(np.zeros_like(looked), np.rint(disc.center_px).astype(int).tolist(), int(disc.radius_px - RIM_PX), 1, -1)
    rise = gray.astype(np.float32) - cv2.medianBlur(np.ascontiguousarray(gray), GROUND_PX)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(((rise > RISE) & (looked > 0)).astype(np.uint8), connectivity=8)
    places, peaks = [], []
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] >= MIN_AREA_PX2:
            rows, columns = np.nonzero(labels == k)
            places.append(np.average(np.column_stack([columns, rows]), axis=0, weights=rise[rows, columns]))
            peaks.append(float(gray[rows, columns].max()))
    return Spots(np.array(places).reshape(-1, 2), np.array(peaks))


def steady_spots(frames: list[Spots], share: float = STEADY_SHARE) -> Spots:
    """Spots that are visible in at least the fraction ``share`` of the frames, with their mean places and mean peaks."""
    px, peak = np.concatenate([spots.px for spots in frames]), np.concatenate([spots.peak for spots in frames])
    of = np.repeat(np.arange(len(frames)), [len(spots.px) for spots in frames])
    places, peaks, left = [], [], np.ones(len(px), bool)
    for k in np.argsort(-peak, kind="stable"):
        if left[k]:
            near = left & (np.linalg.norm(px - px[k], axis=1) < STEADY_PX)
            left &= ~near
            if len(np.unique(of[near])) >= share * len(frames):
                places.append(px[near].mean(axis=0))
                peaks.append(peak[near].mean())
    return Spots(np.array(places).reshape(-1, 2), np.array(peaks))


def clear_of_pins(shape: tuple[int, ...], pins_px: np.ndarray, radius_px: float) -> np.ndarray:
    """(H, W) bool: pixels farther than ``radius_px`` from every pin."""
    blocked = np.zeros(shape[:2], np.uint8)
    for x, y in pins_px[np.isfinite(pins_px).all(axis=1)]:
        cv2.circle(blocked, (round(float(x)), round(float(y))), int(np.ceil(radius_px)), 1, -1)
    return blocked == 0


def pair_spots(real: Spots, rendered: Spots) -> np.ndarray:
    """Distances (m,) px of real spots and their rendered counterparts, for all pairs within ``MOST_APART_PX``."""
    apart = np.linalg.norm(real.px[:, None] - rendered.px[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(apart, 2 * MOST_APART_PX))
    found = apart[rows, columns]
    return found[found < MOST_APART_PX]
