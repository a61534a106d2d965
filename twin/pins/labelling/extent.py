"""The part of the frames that shows the sensor, and a test of whether the frames show the outer end of its layout.

The border of a frame, or a mask laid over the frame, may cut off outer rings or rows of pins. The remaining pins look like a smaller layout
that explains the whole frame. Therefore the end of a layout is known only where the places of the next ring, row or column are in view and
empty. A place counts as in view if the frames show something farther out in its direction: the housing, its light, or slow shading of the
skin. A mask shows only one gray level and the camera's noise. A place also counts as empty if something as bright as a cap, for example the
housing, stands beside it, because there is no room for a cap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from scenes.layouts.base import LatticeLayout
from scenes.pins import PinsSpec
from twin.geometry.pins import usual_spacing
from twin.pins.finding.bumps import Bumps
from twin.pins.labelling.families import family, locate_places

FLAT_SIDE_PX = 5
"""Side of a square around a pixel, px. If all its gray levels are equal, the frame is filled or masked there: camera noise would differ."""
FLAT_IN_THE_MIDDLE = 0.03
"""Share of flat pixels in the middle of a frame from which on the skin itself is flat (drawn or thresholded). A mask is then not
recognisable."""
WHITE_LEVEL, WHITE_IN_THE_MIDDLE = 247, 0.05
"""Gray level from which on a pixel is white, and share of white pixels in the middle of a frame from which on the frame is thresholded.
The skin of a thresholded frame is flat, too."""
MIDDLE = 0.35
"""Distance of the middle part of a frame from its border, as a share of the frame's width and height."""
FILLED_SIGMAS = 4.0
"""Radius of the smallest disc that fits in a filled area, in standard deviations of a spot. It is nearly one spacing, so that the disc does
not fit between pins."""
IN_VIEW = 1.0
"""Least distance of a pin in view from the frame's border, in standard deviations of its spot."""
CAP_EDGE = 0.3
"""Distance of a cap's edge from its middle, in spacings. The parts of the next caps that a mask leaves visible are nearer than this."""
IN_FRAME, FEWEST_IN_FRAME = 0.15, 4
"""Least share and least number of the places of the next ring, row or column that must be in the frame. With fewer of them the frames do
not show the end of the layout."""
SEEN_PAST, FEWEST_SEEN_PAST = 0.25, 3
"""Least share and least number of these places in the frame that the frames must show to be empty. With fewer of them the frames do not
show the end of the layout."""
SEEN_LEVELS, SEEN_NOISES = 1.0, 6.0
"""Thresholds of a visible difference: the mean of the frames differs from the usual level around the pins by more than ``SEEN_LEVELS``
gray levels, and by more than ``SEEN_NOISES`` standard errors of the mean."""
SEEN_SIGMAS = 0.5
"""Standard deviation of the Gaussian that smooths the frames before this comparison, in standard deviations of a spot. It averages the
noise and keeps a thin ring of light."""
SKIN_AND_CAPS = (20, 90)
"""Percentiles of the gray levels among the pins that are taken as the level of the skin and of the caps. Caps cover about a quarter of
the area."""
BESIDE = 0.5
"""Half width of the strip beyond a place in which the frames are searched, and distance from the outermost pins at which the search
begins, in spacings."""


def filled_area(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """Pixels (H, W) bool of gray frames (H, W) uint8 that no frame uses: the fill of a turned frame, or a mask.

    The result is None if there are no such pixels, or if they cannot be recognised. If the caps are white or the skin has one gray level,
    the skin looks like a mask.
    """
    flat = _flat(np.maximum.reduce(list(images)), np.minimum.reduce(list(images)))
    height, width = flat.shape
    top, left = int(MIDDLE * height), int(MIDDLE * width)
    middle = np.s_[top : max(height - top, top + 1), left : max(width - left, left + 1)]
    flat_there = float(np.median([_flat(image, image)[middle].mean() for image in images]))
    white_there = float(np.median([(image[middle] >= WHITE_LEVEL).mean() for image in images]))
    return flat if flat.any() and flat_there < FLAT_IN_THE_MIDDLE and white_there < WHITE_IN_THE_MIDDLE else None


def _flat(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Pixels (H, W) in whose neighbourhood all frames have one level; ``high`` and ``low`` are the frames' largest and smallest levels."""
    square = np.ones((FLAT_SIDE_PX, FLAT_SIDE_PX), np.uint8)
    return cv2.dilate(high, square) == cv2.erode(low, square)


def with_view(spots: Bumps, filled: np.ndarray | None) -> Bumps:
    """The spots with the area in which pins of their size are hidden (``Bumps.hidden``), from the result of ``filled_area``."""
    if filled is None:
        return spots
    reach = max(round(FILLED_SIGMAS * spots.sigma_px), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    wide = cv2.copyMakeBorder(filled.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=1)
    hidden = cv2.morphologyEx(wide, cv2.MORPH_OPEN, disc)[reach:-reach, reach:-reach]
    return replace(spots, hidden=hidden > 0)


def in_view(places: np.ndarray, spots: Bumps) -> np.ndarray:
    """(n,) bool: whether the frame shows the whole pin at each place (n, 2). A place of NaN is unknown, and not in view."""
    margin = IN_VIEW * spots.sigma_px
    with np.errstate(invalid="ignore"):
        inside: np.ndarray = np.all((places >= margin) & (places <= np.array(spots.size_px) - 1 - margin), axis=1)
    if spots.hidden is not None:
        columns, rows = places[inside].round().astype(int).T
        inside[inside] = ~spots.hidden[rows, columns]
    return inside


@dataclass(frozen=True)
class Beyond:
    """Visible things around a layout: pixels whose level differs from the usual level there.

    Attributes
    ----------
    px : (k, 2) float
        Pixels.
    bright : (k,) bool
        Whether each pixel is as bright as a cap, so that it does not show skin.
    """

    px: np.ndarray
    bright: np.ndarray


def find_beyond(images: Sequence[np.ndarray], rest_px: np.ndarray, sigma_px: float) -> Beyond:
    """Visible things in gray frames (H, W) uint8 around a layout with pins at rest (N, 2), px, above the noise of the frames' mean."""
    height, width = images[0].shape
    reach = max(round(BESIDE * usual_spacing(rest_px)), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    pins = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(pins, cv2.convexHull(np.round(rest_px).astype(np.int32)), 1)
    around = cv2.dilate(pins, disc) == 0
    if not around.any() or not pins.any():
        return Beyond(np.zeros((0, 2)), np.zeros(0, bool))
    smooth = np.stack([cv2.GaussianBlur(image.astype(np.float32), (0, 0), SEEN_SIGMAS * sigma_px) for image in images])
    level = smooth.mean(axis=0)
    noise = float(np.median(smooth[:, around].std(axis=0))) / np.sqrt(max(len(images) - 1, 1))
    told = np.round(level[around]).astype(int)
    usual = float(np.median(level[around][told == np.bincount(told).argmax()]))
    skin, caps = np.percentile(level[pins > 0], SKIN_AND_CAPS)
    rows, columns = np.nonzero(around & (np.abs(level - usual) > max(SEEN_LEVELS, SEEN_NOISES * noise)))
    bright = level[rows, columns] > max(skin, usual) + (caps - skin) / 2
    return Beyond(np.column_stack([columns, rows]).astype(float), bright)


def open_sides(pins: PinsSpec, rest_px: np.ndarray, spots: Bumps, beyond: Beyond) -> int:
    """Number of sides on which the frames do not show the end of a layout with pins at rest (N, 2), px.

    On such a side the frame may cut off more pins. ``beyond`` is the result of ``find_beyond``.
    """
    shape = pins.shape
    if not isinstance(shape, LatticeLayout) or not shape.sides():
        return 0
    by, around = family(type(shape)), shape.sides()
    spot = np.full(len(by.lattice), -1)
    spot[np.delete(shape.own_places(), list(pins.missing))] = np.arange(pins.count)
    places = locate_places(by.lattice, by.around, rest_px, spot, spots.size_px)
    framed = in_view(places, replace(spots, hidden=None))
    middle = rest_px.mean(axis=0)
    ends = 0
    for side in around:
        looked = places[side[framed[side]]]
        past = sum(_find_end(place, rest_px, middle, beyond) for place in looked)
        in_frame = len(looked) >= max(FEWEST_IN_FRAME, IN_FRAME * len(side))
        ends += in_frame and past >= max(FEWEST_SEEN_PAST, SEEN_PAST * len(looked))
    return len(around) - ends


def _find_end(place: np.ndarray, rest_px: np.ndarray, middle: np.ndarray, beyond: Beyond) -> bool:
    """Whether the frames show that no cap is at a place (2,): something is visible beyond it, or bright beside it."""
    away = place - middle
    far, spacing = float(np.linalg.norm(away)), float(np.linalg.norm(rest_px - place, axis=1).min())
    along = (beyond.px - middle) @ away / far
    across = np.abs((beyond.px - middle) @ np.array([-away[1], away[0]]) / far)
    near = across < BESIDE * spacing
    past = along > far + CAP_EDGE * spacing
    beside = beyond.bright & (across > CAP_EDGE * spacing) & (along > far - BESIDE * spacing)
    return bool((near & (past | beside)).any())
