"""Where frames show a sensor at all, and whether they show where its layout ends.

A frame's edge, or a mask laid over it, may cut outer rings or rows off. What is left looks like a smaller layout that explains everything.
So a layout's end is only known where the places of the next ring, row and column would be in view, and are empty. Such a place is in view
if the frames show anything farther out in its direction: the housing, its light, the skin's slow shading. A mask shows nothing but one
level and the camera's noise. There is no room for such a place where something as bright as a cap stands beside it: the housing too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from scenes.pins import PinsSpec
from twin.geometry.pins import usual_spacing
from twin.pins.bumps import Bumps
from twin.pins.families import HALF_GRID, MOST_RINGS, family
from twin.pins.growth import seen_places

FLAT_SIDE_PX = 5
"""Side of the square around a pixel, px, in which no level differs where a frame is filled or masked: a camera's noise differs."""
FLAT_IN_THE_MIDDLE = 0.03
"""From this share of flat pixels in the middle of a frame on, the skin itself is flat (drawn or thresholded), and nothing tells a mask."""
WHITE_LEVEL, WHITE_IN_THE_MIDDLE = 247, 0.05
"""With a larger share of pixels of at least this gray level there, the caps are white: thresholded frames, whose skin is flat too."""
MIDDLE = 0.35
"""The middle of a frame begins at this share of its sides."""
FILLED_SIGMAS = 4.0
"""Radius of the smallest disc that fits in a filled area, in sds of a spot: nearly a spacing, so it does not fit between pins."""
IN_VIEW = 1.0
"""A pin is in view if it is at least this many sds of its spot inside the frame."""
CAP_EDGE = 0.3
"""A cap's edge is this far from its middle, in spacings. What a mask leaves of the next caps reaches less far."""
IN_FRAME, FEWEST_IN_FRAME = 0.15, 4
"""A layout can be seen to end only where at least this share of the next places is in the frame, and at least this many of them,"""
SEEN_PAST, FEWEST_SEEN_PAST = 0.25, 3
"""and where something is seen past at least this share of these places, and at least this many of them."""
SEEN_LEVELS, SEEN_NOISES = 1.0, 6.0
"""Frames show something where their mean differs from the usual level around the pins by more gray levels than the first, and by more
standard errors of the mean than the second."""
SEEN_SIGMAS = 0.5
"""Sd of the Gaussian with which frames are smoothed for that, in sds of a spot: noise is averaged, a thin ring of light stays."""
SKIN_AND_CAPS = (20, 90)
"""Percentiles of the levels among the pins that are those of the skin and of the caps: caps cover a quarter or so."""
BESIDE = 0.5
"""The direction of a place is this wide to each side, in spacings; and from this far beyond the outermost pins on, frames are looked at."""


def filled_area(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """Pixels (H, W) bool of gray frames (H, W) uint8 in which no frame shows anything: the fill of a turned frame, or a mask.

    None where there are no such pixels, or nothing tells: where caps are white or the skin has one level, the skin cannot be told from a
    mask.
    """
    flat = _flat(np.maximum.reduce(list(images)), np.minimum.reduce(list(images)))
    height, width = flat.shape
    top, left = int(MIDDLE * height), int(MIDDLE * width)
    middle = np.s_[top : max(height - top, top + 1), left : max(width - left, left + 1)]
    flat_there = float(np.median([_flat(image, image)[middle].mean() for image in images]))
    white_there = float(np.median([(image[middle] >= WHITE_LEVEL).mean() for image in images]))
    return flat if flat.any() and flat_there < FLAT_IN_THE_MIDDLE and white_there < WHITE_IN_THE_MIDDLE else None


def _flat(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Pixels (H, W) around which the highest and lowest levels of frames are the same."""
    square = np.ones((FLAT_SIDE_PX, FLAT_SIDE_PX), np.uint8)
    same: np.ndarray = cv2.dilate(high, square) == cv2.erode(low, square)
    return same


def with_view(spots: Bumps, filled: np.ndarray | None) -> Bumps:
    """Spots that also know where pins of their size are in view, from what ``filled_area`` tells."""
    if filled is None:
        return spots
    reach = max(round(FILLED_SIGMAS * spots.sigma_px), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    wide = cv2.copyMakeBorder(filled.astype(np.uint8), *(reach,) * 4, cv2.BORDER_CONSTANT, value=1)
    hidden = cv2.morphologyEx(wide, cv2.MORPH_OPEN, disc)[reach:-reach, reach:-reach]
    return replace(spots, hidden=hidden > 0)


def in_view(places: np.ndarray, spots: Bumps) -> np.ndarray:
    """Which places (n, 2), NaN where unknown, a frame shows as a whole."""
    margin = IN_VIEW * spots.sigma_px
    with np.errstate(invalid="ignore"):
        inside: np.ndarray = np.all((places >= margin) & (places <= np.array(spots.size_px) - 1 - margin), axis=1)
    if spots.hidden is not None:
        columns, rows = places[inside].round().astype(int).T
        inside[inside] = ~spots.hidden[rows, columns]
    return inside


def sides(pins: PinsSpec) -> list[np.ndarray]:
    """Places of a family's lattice at which a layout would go on: the next ring, or the next row or column on each side of a grid.

    Returns
    -------
    list of (k,) int
        Empty for a layout of given positions, and for the largest one that is looked for.
    """
    if pins.layout in ("rings", "hexagon"):
        if (pins.rings or 0) >= MOST_RINGS:
            return []
        return [np.arange(pins.complete_count, PinsSpec(layout=pins.layout, rings=(pins.rings or 0) + 1).complete_count)]
    if pins.layout == "grid":
        columns, rows = pins.columns or 0, pins.rows or 0
        if max(columns, rows) > 2 * HALF_GRID - 1:
            return []
        x, y = np.arange(1, columns + 1), np.arange(1, rows + 1)
        nodes = [(x, np.zeros_like(x)), (x, np.full_like(x, rows + 1)), (np.zeros_like(y), y), (np.full_like(y, columns + 1), y)]
        return [row * (2 * HALF_GRID + 1) + column for column, row in nodes]
    return []


def own_places(pins: PinsSpec) -> np.ndarray:
    """Places (N,) of a family's lattice that a layout's pins have, so that those of ``sides`` lie around them."""
    places = np.arange(pins.complete_count)
    if pins.layout == "grid":
        columns = pins.columns or 1
        places = (places // columns + 1) * (2 * HALF_GRID + 1) + places % columns + 1
    return np.delete(places, list(pins.missing))


@dataclass(frozen=True)
class Beyond:
    """What gray frames show around a layout: what differs there from the level that most of the picture has.

    Attributes
    ----------
    px : (k, 2) float
        Pixels.
    bright : (k,) bool
        Which of them are as bright as caps: no skin.
    """

    px: np.ndarray
    bright: np.ndarray


def seen_beyond(images: Sequence[np.ndarray], rest_px: np.ndarray, sigma_px: float) -> Beyond:
    """What gray frames (H, W) uint8 show around a layout with its pins at rest (N, 2), px, beyond the noise of their mean."""
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
    """Number of sides on which frames do not show that a layout with its pins at rest (N, 2), px, ends: more pins may be cut off there.

    ``beyond`` is what the frames show around the pins (``seen_beyond``).
    """
    around = sides(pins)
    if not around:
        return 0
    by = family(pins.layout)
    spot = np.full(len(by.lattice), -1)
    spot[own_places(pins)] = np.arange(pins.count)
    places = seen_places(by.lattice, by.around, rest_px, spot, spots.size_px)
    framed = in_view(places, replace(spots, hidden=None))
    middle = rest_px.mean(axis=0)
    ends = 0
    for side in around:
        looked = places[side[framed[side]]]
        past = sum(_ended(place, rest_px, middle, beyond) for place in looked)
        in_frame = len(looked) >= max(FEWEST_IN_FRAME, IN_FRAME * len(side))
        ends += in_frame and past >= max(FEWEST_SEEN_PAST, SEEN_PAST * len(looked))
    return len(around) - ends


def _ended(place: np.ndarray, rest_px: np.ndarray, middle: np.ndarray, beyond: Beyond) -> bool:
    """Whether frames show that no cap stands at a place (2,): something is seen past it, or something bright that is no cap beside it."""
    away = place - middle
    far, spacing = float(np.linalg.norm(away)), float(np.linalg.norm(rest_px - place, axis=1).min())
    along = (beyond.px - middle) @ away / far
    across = np.abs((beyond.px - middle) @ np.array([-away[1], away[0]]) / far)
    near = across < BESIDE * spacing
    past = along > far + CAP_EDGE * spacing
    beside = beyond.bright & (across > CAP_EDGE * spacing) & (along > far - BESIDE * spacing)
    return bool((near & (past | beside)).any())
