"""Light that measured reliefs add to the smooth model of caps and skin (`ReliefSpec`).

A pixel's place in the plane of the nearest cap gives its cell in this cap's tile. Because the light is linear in the tiles' values, it is
a sparse matrix times the values; the fit of the values uses the same matrix.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from scenes.sensor import PinsSpec, ReliefSpec, SensorSpec, ViewSpec
from twin.camera.projection import project
from twin.compiled import compiled
from twin.errors import FrameError, RenderError
from twin.geometry.pins import across_axis
from twin.optics.direct_light import DirectLight
from twin.optics.static_layer import values_of
from twin.optics.surfaces import cap_albedo
from twin.types import FloatArray, IntArray, PinState

POWER = 1.5
"""Power of a tile's levels (see ``ReliefSpec.tiles``)."""
SKIN_FROM = 1.3
"""Distance from a cap's centre, in cap radii, beyond which a point counts as skin. The blurred edge of a cap extends up to this
distance."""


DETAILS = ("relief", "grain", "background")
"""Measured details of a render, each of which `without` switches off."""


def without(spec: SensorSpec, details: Iterable[str]) -> SensorSpec:
    """A specification without measured details: only the smooth model is rendered there.

    Parameters
    ----------
    spec : SensorSpec
    details : iterable of str
        ``relief``: that of caps and their edges; ``grain``: that of the skin around; ``background``: light of everything that contacts
        do not change. Without relief and grain a cap is evenly bright, so that its centroid is that of its outline.

    Raises
    ------
    RenderError
        A detail is unknown.
    """
    given = set(details)
    if wrong := sorted(given - set(DETAILS)):
        raise RenderError(f"'{wrong[0]}' is no detail of a render: use {', '.join(DETAILS)}")
    look, housing = spec.appearance, spec.housing
    relief = look.relief
    if relief is not None:
        kept = {"caps": relief.caps and "relief" not in given, "skin": relief.skin and "grain" not in given}
        relief = relief.alter(**kept) if any(kept.values()) else None
    if "background" in given:
        housing = housing.alter(background=None)
    return spec.alter(appearance={"relief": relief}, housing=housing)


@dataclass(frozen=True)
class CapPlaces:
    """Pixels that lie on the tile of a cap.

    Attributes
    ----------
    pixels : (n,) int
        Numbers of the pixels in the window, counted row by row.
    cap : (n,) int
        The nearest cap.
    place : (n, 2) float
        Place in the cap's plane, cap radii.
    """

    pixels: IntArray
    cap: IntArray
    place: FloatArray

    def weights(self, cells: int, reach: float, count: int) -> sparse.csr_array:
        """(n, count cells^2): bilinear weights of the tiles' cells at each pixel."""
        at = (self.place + reach) / (2 * reach) * (cells - 1)
        low = np.clip(np.floor(at).astype(int), 0, cells - 2)
        (x, y), first = (at - low).T, (self.cap * cells + low[:, 1]) * cells + low[:, 0]
        weight = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1).astype(np.float32)
        columns = first[:, None] + [0, 1, cells, cells + 1]
        rows = np.arange(0, 4 * len(first) + 1, 4)
        return sparse.csr_array((weight.ravel(), columns.ravel(), rows), shape=(len(first), count * cells**2))


class Relief:
    """The relief of one sensor in a window of its frame.

    Parameters
    ----------
    spec : SensorSpec
        With ``appearance.relief``.
    window_px : (x0, y0, x1, y1)

    Raises
    ------
    FrameError
        The picture of the tiles can't be read, or is too small.
    """

    def __init__(self, spec: SensorSpec, window_px: tuple[int, int, int, int]) -> None:
        assert spec.appearance.relief is not None
        self._spec, self._window_px, self._relief = spec, window_px, spec.appearance.relief
        self._values = tiles_of(self._relief, spec.pins.count).reshape(-1, 3).astype(np.float32)
        self._lamp = CapLamp(spec)

    def light(self, state: PinState) -> tuple[IntArray, FloatArray]:
        """Numbers (n,) of pixels of the window, and the linear light (n, 3) that is added there."""
        relief = self._relief
        places = cap_places(self._spec.view, self._spec.pins, state, self._window_px, relief.reach)
        used = np.where(np.linalg.norm(places.place, axis=-1) > SKIN_FROM, relief.skin, relief.caps)
        places = CapPlaces(places.pixels[used], places.cap[used], places.place[used])
        weights = places.weights(relief.cells, relief.reach, self._spec.pins.count)
        return places.pixels, (weights @ self._values) * self._lamp(state)[places.cap].astype(np.float32)


class CapLamp:
    """Radiance (N, 3) that each smooth cap sends to the camera, in the renderer's unit, without shadows: tiles are relative to it."""

    def __init__(self, spec: SensorSpec) -> None:
        self._lamp, self._bump = DirectLight(spec), spec.appearance.cap_bump
        self._albedo = cap_albedo(spec.appearance, spec.pins.count)

    def __call__(self, state: PinState) -> FloatArray:
        return self._lamp(state.caps_mm, state.axis, self._bump) * self._albedo / np.pi


def tiles_of(relief: ReliefSpec, count: int) -> FloatArray:
    """Values (count, cells, cells, 3) of the pins' tiles: the measured ones, or drawn ones if ``pattern`` is above 0.

    A drawn tile is the mean tile plus a random combination of all tiles' differences from it, whose covariance is that of the tiles.

    Raises
    ------
    FrameError
        The picture can't be read, or is too small.
    """
    picture = values_of(relief.tiles, relief.span, POWER, "appearance.relief.tiles")
    rows, columns = (size // relief.cells for size in picture.shape[:2])
    if rows * columns < relief.count:
        holds = f"the picture holds {rows * columns} tiles of {relief.cells} cells"
        raise FrameError(f"appearance.relief.tiles: {holds}, the specification says {relief.count}; give the picture that belongs to it")
    whole = picture[: rows * relief.cells, : columns * relief.cells].reshape(rows, relief.cells, columns, relief.cells, 3)
    tiles = whole.swapaxes(1, 2).reshape(-1, relief.cells, relief.cells, 3)[: relief.count]
    if not relief.pattern:
        return tiles
    mean = tiles.mean(axis=0)
    shares = np.random.default_rng(relief.pattern).standard_normal((count, relief.count)) / np.sqrt(relief.count)
    return np.asarray(mean + np.tensordot(shares, tiles - mean, axes=1), np.float32)


def tiles_picture(tiles: FloatArray) -> FloatArray:
    """Put tiles (count, cells, cells, 3) in one nearly square picture (H, W, 3), row by row, as ``ReliefSpec.tiles`` orders them."""
    count, cells = tiles.shape[:2]
    columns = int(np.ceil(np.sqrt(count)))
    rows = -(-count // columns)
    whole = tiles[np.minimum(np.arange(rows * columns), count - 1)]  # the last one is repeated
    return whole.reshape(rows, columns, cells, cells, 3).swapaxes(1, 2).reshape(rows * cells, columns * cells, 3)


def cap_planes(view: ViewSpec, pins: PinsSpec, state: PinState) -> tuple[FloatArray, FloatArray]:
    """Middles (N, 2) of the caps' faces in the raw frame, and matrices (N, 2, 2) from cap radii in their planes to px.

    The first direction of a plane is the projection of the sensor's x, the second turns towards y.
    """
    face, radius = state.caps_mm + 0.5 * pins.cap_height_mm * state.axis, 0.5 * pins.cap_diameter_mm
    middle = project(view, face)
    return middle, np.stack([project(view, face + radius * way) - middle for way in across_axis(state.axis)], axis=-1)


def cap_places(view: ViewSpec, pins: PinsSpec, state: PinState, window_px: tuple[int, int, int, int], reach: float) -> CapPlaces:
    """The pixels of a window that lie on a tile: that of the nearest cap among those whose tiles' bounding boxes hold the pixel."""
    x0, y0, x1, y1 = window_px
    middle, plane = cap_planes(view, pins, state)
    across = np.ceil(reach * np.abs(plane).sum(axis=2)).astype(np.int64)
    cap, place = _nearest(middle - [x0, y0], np.linalg.inv(plane), across, x1 - x0, y1 - y0)
    pixels = np.flatnonzero((cap >= 0) & (np.abs(place[:, 0]) < reach) & (np.abs(place[:, 1]) < reach))
    return CapPlaces(pixels, cap[pixels], place[pixels])


@compiled()
def _nearest(middle: FloatArray, inverse: FloatArray, across: IntArray, width: int, height: int) -> tuple[IntArray, FloatArray]:
    """The nearest cap (H W,) of each pixel among those at most ``across`` (N, 2) px away, else -1, and the place (H W, 2) in its plane."""
    cap, place = np.full(width * height, -1), np.zeros((width * height, 2))
    least = np.full(width * height, np.inf)
    for k in range(len(middle)):
        x, y = middle[k]
        left, right = max(int(np.ceil(x - across[k, 0])), 0), min(int(np.floor(x + across[k, 0])), width - 1)
        top, bottom = max(int(np.ceil(y - across[k, 1])), 0), min(int(np.floor(y + across[k, 1])), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                dx, dy = column - x, row - y
                at = row * width + column
                if dx * dx + dy * dy < least[at]:
                    least[at], cap[at] = dx * dx + dy * dy, k
                    place[at, 0] = inverse[k, 0, 0] * dx + inverse[k, 0, 1] * dy
                    place[at, 1] = inverse[k, 1, 0] * dx + inverse[k, 1, 1] * dy
    return cap, place
