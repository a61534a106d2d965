"""Fit of the details that smooth models miss: a background that contacts do not change, and a tile of light fixed to each cap.

Both are linear in light. They are found by simultaneous iterative reconstruction (SIRT; Gilbert 1972): the missing gray levels of the
captured render, divided by the slope of the response curve, are spread over the values that each pixel sees. The camera's blur makes
fine structure converge last, so that few rounds also keep noise out.

A pixel shows the background and tiles. If most renders miss the same light at the same pixel, that light belongs to the background. Light
that moves with the caps belongs to the tiles (the relief). The edges of caps that hardly move look like a background at first. Therefore
the tiles are fitted to all pixels, also to those that have a background.
"""

import numpy as np

from scenes.sensor import BackgroundSpec, ReliefSpec, SensorSpec
from twin.camera.capture import expose
from twin.evaluation.pictures.aligned import SATURATED, Aligned, levels_slope, with_changes
from twin.optics.relief import POWER, CapLamp, cap_places, tiles_picture
from twin.optics.static_layer import BACKGROUND_POWER, picture_of
from twin.types import FloatArray

CELLS, REACH = 23, 1.8
"""Cells along a tile's side, and half of that side, cap radii. A cell is a little narrower than a pixel, and tiles of neighbours meet."""
PRIOR_LEVELS, PRIOR_SHARE = 9.0, 0.2
"""Prior of a tile: standard deviation of the gray levels that tiles do not explain, and standard deviation of a tile's values."""
BACKGROUND_ROUNDS, TILE_ROUNDS = 4, 8
"""Numbers of iterations of the two reconstructions."""
BACKGROUND_GAIN, TILE_GAIN = 0.7, 1.2
"""Shares of the missing light that each iteration adds."""
EDGE = (0.6, 1.5)
"""Range of distances from a cap's middle, cap radii, whose pixels do not count for the background until tiles are fitted."""
SURE_SDS, SURE_LEVELS = 3.0, 3.0
"""Where caps pass, only the part of a background beyond so many standard errors plus so many gray levels is used."""
DARKEST = 2e-4
"""Least light at which the slope of the response curve is computed, because the slope has no bound at light 0."""
BRIGHTEST = 2.0
"""Largest light of a background. It saturates the pixel, so a larger value would look the same."""
LEAST_FRAMES = 2
"""Least number of frames that determine a tile."""


def fit_details(spec: SensorSpec, frames: list[Aligned], light: list[FloatArray]) -> SensorSpec:
    """The specification with ``housing.background`` and ``appearance.relief``.

    Parameters
    ----------
    spec : SensorSpec
        A specification in which everything else was fitted.
    frames : list of Aligned
    light : list of (H, W, 3) or (H, W) float
        Rendered light of each frame's state without background and relief.
    """
    shine = CapLamp(spec)
    fit = _Fit(spec, [_TileView(spec, shine, frame, lit) for frame, lit in zip(frames, light, strict=True)])
    fit.improve_background(None)
    tiles = fit.tiles()
    fit.improve_background(tiles)
    each, frame = (spec.pins.count, CELLS, CELLS), (spec.camera.height_px, spec.camera.width_px)
    whole = np.broadcast_to(tiles.reshape(*each, -1), (*each, 3))
    background = np.broadcast_to(fit.background.reshape(*frame, -1), (*frame, 3))
    span = float(np.ceil(10 * max(np.percentile(np.abs(whole), 99.98), 0.1)) / 10)
    relief = ReliefSpec(tiles=picture_of(tiles_picture(whole), span, POWER), count=spec.pins.count, span=span, cells=CELLS, reach=REACH)
    found = BackgroundSpec(light=picture_of(background, BRIGHTEST, BACKGROUND_POWER), span=BRIGHTEST)
    return with_changes(spec, housing={"background": found.model_dump()}, appearance={"relief": relief.model_dump()})


def undetermined_tiles(spec: SensorSpec, frames: list[Aligned]) -> int:
    """Number of pins that fewer than ``LEAST_FRAMES`` of the frames show. Their tiles hold the noise of one frame or nothing."""
    return int((sum(np.isfinite(frame.pins_px).all(axis=1).astype(int) for frame in frames) < LEAST_FRAMES).sum())


class _TileView:
    """A frame, its render, and the places of its pixels on the tiles."""

    def __init__(self, spec: SensorSpec, shine: CapLamp, frame: Aligned, light: FloatArray) -> None:
        places = cap_places(spec.view, spec.pins, frame.state, (0, 0, spec.camera.width_px, spec.camera.height_px), REACH)
        lamp = shine(frame.state)[places.cap].astype(np.float32)
        self.image, self.light = np.atleast_3d(frame.image).astype(np.float32), np.atleast_3d(light)
        self.pixels, self.distance = places.pixels, np.linalg.norm(places.place, axis=1)
        self.weights = places.weights(CELLS, REACH, spec.pins.count)
        self.lamp = lamp if light.ndim == 3 else lamp.mean(axis=1, keepdims=True)


class _Fit:
    """The values of the fit; ``background`` (H W, channels) is the added light."""

    def __init__(self, spec: SensorSpec, views: list[_TileView]) -> None:
        self._spec, self._views = spec, views
        height, width, channels = views[0].image.shape
        self._mean: FloatArray = np.mean(np.stack([v.light for v in views]), axis=0).reshape(-1, channels)
        self.background = np.zeros_like(self._mean)
        self._passed = np.isin(np.arange(height * width), np.concatenate([view.pixels for view in views]))

    def _light_tiles(self, view: _TileView, tiles: FloatArray | None) -> FloatArray:
        """Light (H W, channels) of a frame's render with background and tiles (N cells^2, channels)."""
        light = view.light.reshape(self.background.shape) + self.background
        if tiles is not None:
            light[view.pixels] += (view.weights @ tiles) * view.lamp
        return np.maximum(light, 0)

    def _missing(self, view: _TileView, light: FloatArray) -> FloatArray:
        """Gray levels (H W, channels) of the frame minus those of light; 0 where both are saturated."""
        film = light.reshape(view.image.shape)
        shown = np.atleast_3d(expose(film if light.shape[-1] == 3 else film[..., 0], self._spec.capture)).astype(np.float32)
        lacking = np.where((view.image >= SATURATED) & (shown >= SATURATED), 0.0, view.image - shown)
        return lacking.reshape(light.shape).astype(np.float32)

    def _slope(self, light: FloatArray) -> FloatArray:
        return levels_slope(np.maximum(light, DARKEST), self._spec.response).astype(np.float32)

    def improve_background(self, tiles: FloatArray | None) -> None:
        """Add the light that a pixel lacks in most frames. Without tiles, the pixels near a cap's edge are not used."""
        for _ in range(BACKGROUND_ROUNDS):
            stack = np.stack([self._missing(view, self._light_tiles(view, tiles)) for view in self._views])
            known = np.ones(stack.shape[:2], bool)
            if tiles is None:
                for row, view in zip(known, self._views, strict=True):
                    row[view.pixels[(view.distance > EDGE[0]) & (view.distance < EDGE[1])]] = False
            some = known.sum(axis=0) >= min(LEAST_FRAMES, len(self._views))
            masked = np.ma.masked_array(stack, np.broadcast_to(~known[..., None], stack.shape))
            typical = np.where(some[:, None], np.ma.median(masked, axis=0).filled(0), 0.0)
            spread = masked.std(axis=0).filled(0) / np.sqrt(np.maximum(known.sum(axis=0), 1))[:, None]
            doubt = np.where(self._passed[:, None], SURE_SDS * spread + SURE_LEVELS, 0.0)
            sure = np.sign(typical) * np.maximum(np.abs(typical) - doubt, 0)
            more = BACKGROUND_GAIN * sure / self._slope(self._mean + self.background)
            self.background = np.clip(self.background + more, -self._mean, BRIGHTEST).astype(np.float32)

    def tiles(self) -> FloatArray:
        """The tiles (N cells^2, channels) that explain the remaining differences."""
        tiles = np.zeros((self._views[0].weights.shape[1], self.background.shape[1]), np.float32)
        prior = (PRIOR_LEVELS / PRIOR_SHARE) ** 2
        for _ in range(TILE_ROUNDS):
            found, weight = np.zeros_like(tiles), np.full_like(tiles, prior)
            for view in self._views:
                light = self._light_tiles(view, tiles)
                slope = self._slope(light[view.pixels]) * view.lamp
                found += view.weights.T @ (slope * self._missing(view, light)[view.pixels])
                weight += view.weights.T @ slope**2
            tiles += TILE_GAIN * found / weight
        return tiles
