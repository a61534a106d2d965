"""A fast picture of the sensor for interaction and control loops. It is rasterised instead of path-traced.

Skin, stems and caps are projected through the window, shaded with the lamps' direct light (without shadows), and drawn from far to near.
Pins are drawn with exact coverage of pixels. Shadows, and light that other surfaces reflect, are approximated by a gain and an offset
for each material; `Preview.calibrate` fits these to a path-traced frame. A lens with a finite aperture blurs the picture by circles of
confusion.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import Delaunay

from scenes.sensor import GeometrySpec, SensorSpec, ViewSpec
from twin.camera.projection import distort, project, sensor_to_camera, window_tangent
from twin.errors import RenderError
from twin.geometry.pins import rest_pins
from twin.geometry.shapes import shape_of
from twin.optics.direct_light import DirectLight
from twin.optics.glass import Window, ray_table
from twin.optics.raster import PinOutlines, draw_pins, draw_triangles, side_normals
from twin.optics.relief import Relief
from twin.optics.static_layer import static_layer
from twin.optics.surfaces import cap_albedo, unit
from twin.optics.tracer import luminance
from twin.types import BoolArray, FloatArray, IntArray, PinState

SKIN, STEM, SIDE, FACE = range(4)
"""Indices of the materials: the skin, and a pin's stem, cap side and cap face."""
BELT_STEP_RAD = np.radians(8.0)
"""Largest step of direction (`twin.geometry.shapes`) between circles of corners of the skin, from the outermost pins to the rim."""
BELT_PLACES = 48
"""Number of corners of the skin on each of these circles."""
DARK = 1e-3
"""Linear light below which an error has the same weight in a fit, whatever the light is."""
TRUST = 3e-3
"""Weight of the prior "direct light alone" in a fit, relative to the most visible material. For hardly visible materials it dominates."""
NEAR_PX = 4.0
"""Standard deviation, px, of the Gaussian neighbourhood in which traced and rasterised light of the skin are compared."""
MOST_SKIN_GAIN = 4.0
"""Largest gain of one corner of the skin."""
VARIANCES = 0.03 * np.append(0, 2.0 ** np.arange(24))
"""Variances of the blurred pictures between which is interpolated, px^2. The smallest blur is that of a disc of 0.7 px."""
FINE = 16
"""Number of points along each side of a pixel at which the coverage of the pixel by a disc is evaluated."""
HALVINGS = 12
"""Number of bisection steps in the search of a disc's diameter."""


def circles_px(view: ViewSpec, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Circles of confusion of points (n, 3) in the gel.

    A ray through a point o of the pupil has the tangent ``t(o) + o / focus`` at the film, because points at the focus distance are sharp.
    Away from the axis the rays through the pupil fill an ellipse on the film. Its centre differs from the ray through the pupil's centre.

    Returns
    -------
    diameter : (n,) float
        Root mean square of the ellipse's axes, px.
    shift : (n, 2) float
        Shift from the image through the pupil's centre to the mean image over the pupil, px.
    """
    camera = view.camera
    radius = 0.5 * camera.aperture_mm
    places = radius * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[:, None]
    across = points_mm[:, :2] - places
    rho = np.linalg.norm(across, axis=-1)
    tangent = across * (window_tangent(view, rho, points_mm[:, 2]) / np.maximum(rho, 1e-12))[..., None]
    seen = distort(camera, tangent + places / camera.focus_mm) * [camera.fx_px, camera.fy_px]
    spread = np.stack([seen[1] - seen[2], seen[3] - seen[4]])
    mean_square = 0.5  # of a radius over a disc, relative to its rim: the shift grows with the square
    return np.sqrt(0.5 * np.sum(spread**2, axis=(0, 2))), mean_square * (seen[1:].mean(axis=0) - seen[0])


def defocused(image: FloatArray, circles: FloatArray) -> FloatArray:
    """A picture (H, W, C) float32 in which each pixel is blurred by its own circle of confusion, with diameters (H, W) in px.

    The result is interpolated between a few blurred pictures. The interpolation is linear in the variance of the blur, which is 1 / 16 of
    the squared diameter.
    """
    level = np.interp(circles**2 / 16, VARIANCES, np.arange(len(VARIANCES))).astype(np.float32)
    found = np.zeros_like(image)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        blurred = cv2.filter2D(image, -1, disc(VARIANCES[k])) if k else image
        share = cv2.merge([np.maximum(1 - np.abs(level - k), 0)] * image.shape[2])  # faster than a broadcast along the channels
        found += (share * blurred.reshape(share.shape)).reshape(image.shape)
    return found


@lru_cache(maxsize=32)
def disc(variance: float) -> FloatArray:
    """Kernel (k, k) of a disc with this variance, px^2, along each axis.

    The coverage of pixels by a disc has another variance than the disc, because a pixel is not a point. Therefore a disc of another size is
    used.
    """
    low, high = 0.0, 4 * np.sqrt(variance) + 1
    reach = int(np.ceil(0.5 * high))
    place = np.arange(-reach, reach + 1)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        too_wide = float(_cover(middle, reach).sum(axis=0) @ place**2) > variance
        low, high = (low, middle) if too_wide else (middle, high)
    return _cover(high, reach)


def _cover(diameter_px: float, reach: int) -> FloatArray:
    """Fraction (k, k) of a disc's area in each pixel, up to ``reach`` pixels from the pixel at its centre."""
    pixels = 2 * reach + 1
    place = (np.arange(pixels * FINE) + 0.5) / FINE - 0.5 * pixels
    inside = np.clip(0.5 + FINE * (0.5 * diameter_px - np.hypot(place[:, None], place)), 0, 1)
    cover = inside.reshape(pixels, FINE, pixels, FINE).sum(axis=(1, 3)).astype(np.float32)
    return np.asarray(cover / cover.sum())


class Film:
    """What a window of the film gets besides the light of the smooth gel: the static layer and the relief.

    Parameters
    ----------
    spec : SensorSpec
    window_px : (x0, y0, x1, y1)
    static : (light, cover), optional
        Static layer; by default the result of `static_layer`.

    Attributes
    ----------
    shine : (H, W, C) float32
        Light of the static layer; C is 3 for a color camera, else 1.
    through : (H, W, 1) float32
        Transmittance of the static layer for the gel's light.
    """

    def __init__(self, spec: SensorSpec, window_px: tuple[int, int, int, int], static: tuple[FloatArray, FloatArray] | None = None) -> None:
        shine, cover = static_layer(spec, window_px) if static is None else static
        self._mono = spec.camera.channels == "mono"
        self._relief = None if spec.appearance.relief is None else Relief(spec, window_px)
        size = window_px[3] - window_px[1], window_px[2] - window_px[0]
        self.through = np.broadcast_to(1 - np.asarray(cover, np.float32), size)[..., None]
        self.shine = self.channels(np.broadcast_to(shine, (*size, 3)))

    def light(self, state: PinState) -> FloatArray:
        """Light (H, W, C) of the static layer and the relief."""
        known = self.shine.copy()
        if self._relief is not None:
            raised, more = self._relief.light(state)
            known.reshape(-1, known.shape[2])[raised] += self.through.reshape(-1, 1)[raised] * self.channels(more)
        return known

    def channels(self, rgb: FloatArray) -> FloatArray:
        """RGB (..., 3) as the film's channels (..., C)."""
        return np.asarray(luminance(rgb)[..., None] if self._mono else rgb, np.float32)

    def picture(self, light: FloatArray) -> FloatArray:
        """Light (H, W, C), not below 0, as renderers give it: (H, W, 3) or (H, W)."""
        return np.maximum(light[..., 0] if self._mono else light, 0)


class Renders(Protocol):
    """Something that renders a window of the frame, as a `twin.optics.render.Renderer` does."""

    window_px: tuple[int, int, int, int]

    def render(self) -> FloatArray:
        """Linear light (H, W, 3) or (H, W) at rest."""


@dataclass(frozen=True)
class Shading:
    """Irradiance of skin, stems, cap sides and cap faces as ``gain * direct + offset * mean direct of the caps at rest``.

    Attributes
    ----------
    gain, offset : (4, C) float
        C is 1, or 3 for red, green and blue.
    skin : (v, 1) float
        Further gain of each of the skin's corners (or one gain for all), because pins cast shadows on the skin.
    """

    gain: FloatArray = field(default_factory=lambda: np.ones((4, 1)))
    offset: FloatArray = field(default_factory=lambda: np.zeros((4, 1)))
    skin: FloatArray = field(default_factory=lambda: np.ones((1, 1)))


@dataclass(frozen=True)
class _Drawing:
    """A state of the sensor, projected to the film.

    Attributes
    ----------
    corners_px : (v, 2) float
        Corners of the skin, px of the window.
    outlines_px : (N, 4, K, 2) float
        As `PinOutlines` gives them.
    facing : (N,) bool
        Whether the camera sees the cap's face.
    far_first : (N,) int
        The pins' numbers, from far to near.
    circles : (v, 1) float32, optional
        Diameters of the circles of confusion at the corners of the skin, px; None for a pinhole.
    direct, ambient : list of (v, 3), (N, 3), (N, 2 K, 3) and (N, 3) float
        Irradiance of each material by the lamps, and by unit light from all directions. Both are multiplied by the gel's transmittance
        to the camera. A cap's side has facets; one ambient light (N, 1, 3) is for all of them.
    """

    corners_px: FloatArray
    outlines_px: FloatArray
    facing: BoolArray
    far_first: IntArray
    circles: FloatArray | None
    direct: list[FloatArray]
    ambient: list[FloatArray]


class Preview:
    """Draws one sensor.

    Parameters
    ----------
    spec : SensorSpec
    window_px : (x0, y0, x1, y1), optional
        Part of the raw frame, end exclusive; the whole frame by default.
    shading : Shading, optional
        By default direct light alone.
    static : (light, cover), optional
        Static layer; by default the result of `static_layer`.
    """

    def __init__(
        self,
        spec: SensorSpec,
        *,
        window_px: tuple[int, int, int, int] | None = None,
        shading: Shading | None = None,
        static: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        self.spec, self.shading = spec, shading or Shading()
        self.window_px = window_px or (0, 0, spec.camera.width_px, spec.camera.height_px)
        self._direct = DirectLight(spec)
        self._film = Film(spec, self.window_px, static)
        self._through = (self._film.through * _transmittance(spec.view, self.window_px)[..., None]).astype(np.float32)
        self._rest = rest_pins(spec.geometry)
        self._outlines = PinOutlines(spec.view, spec.pins, spec.appearance)
        self._belt_mm, self._faces = _belt(spec.geometry, self._rest.base_mm)
        self._belt_px = project(spec.view, self._belt_mm)
        self._belt_light = self._direct(self._belt_mm, -shape_of(spec.skin).normals(self._belt_mm))
        look = spec.appearance
        self._mean_light = self._direct(self._rest.caps_mm, self._rest.axis, look.cap_bump).mean()
        cap = cap_albedo(look, spec.pins.count)
        self._albedo = np.array([look.skin_albedo]), np.array([look.pin_albedo]), cap[:, None], cap

    def render(self, state: PinState | None = None) -> FloatArray:
        """Linear light on the film, as a `Renderer` gives it.

        Parameters
        ----------
        state : ContactState or PinRest, optional
            Any object with ``base_mm``, ``axis`` and ``caps_mm``, (N, 3) each. At rest by default.

        Returns
        -------
        (H, W, 3) or (H, W) float32
            RGB for a color camera, luminance for a mono one; H and W of the window.

        Raises
        ------
        RenderError
            The state has another number of pins.
        """
        state = self._rest if state is None else state
        return self._film.picture(self._film.light(state) + self._through * self._gel(self._drawing(state), self.shading))

    def calibrate(self, renderer: Renders) -> Shading:
        """Fit the shading to a path-traced frame at rest, and use it for all following frames.

        It is a least-squares fit over the film. The weights make an error count about as much as in gray levels.

        Parameters
        ----------
        renderer : Renders
            `twin.optics.render.Renderer` of the same sensor and window.

        Raises
        ------
        RenderError
            The renderer has another window.
        """
        if renderer.window_px != self.window_px:
            raise RenderError(f"the renderer's window_px is {renderer.window_px}, the preview's {self.window_px}: build both alike")
        traced = renderer.render().reshape(self._film.shine.shape)
        drawing = self._drawing(self._rest)
        known = self._film.light(self._rest)
        gel = traced - known
        # the weights depend on the rasterised light: with the noisy traced light, samples that are too dark would get too much weight;
        # traced light below 0 was set to 0, so it has no weight
        drawn = known + self._through * self._gel(drawing, Shading())
        weight = np.where(traced > 0, (np.maximum(drawn, 0) + DARK) ** -0.5, 0)
        alone = np.eye(8).reshape(8, 2, 4, 1)  # shadings in which one gain, or one offset, is 1 and all others are 0
        parts = np.stack([weight * self._through * self._gel(drawing, Shading(*only)) for only in alone], axis=-1)
        fitted = [_fit_gains(parts[..., c, :].reshape(-1, 8), (weight * gel)[..., c].ravel()) for c in range(gel.shape[2])]
        fit = Shading(*np.stack(fitted, axis=-1).reshape(2, 4, -1))
        self.shading = replace(fit, skin=self._skin_gain(drawing, fit, np.where(traced > 0, gel, np.nan)))
        return self.shading

    def _skin_gain(self, drawing: _Drawing, fit: Shading, gel: FloatArray) -> FloatArray:
        """Gain (v, 1) of each corner of the skin: ratio of traced light (H, W, C) to the fit's, in its neighbourhood without pins.

        Unknown light is NaN.
        """
        bare = np.array([[1.0], [0.0], [0.0], [0.0]])
        pins = self._gel(drawing, Shading(1 - bare, 1 - bare)).max(axis=2)
        free = (cv2.dilate(pins, np.ones((3, 3))) == 0) & (self._through[..., 0] > 0.5 * self._through.max())
        free &= np.isfinite(gel).all(axis=2)
        skin = self._through * self._gel(drawing, Shading(fit.gain * bare, fit.offset * bare))
        traced, drawn = (cv2.GaussianBlur(np.where(free, light.sum(axis=2), 0), (0, 0), NEAR_PX) for light in (gel, skin))
        ratio = np.divide(traced, drawn, out=np.ones_like(traced), where=drawn > 1e-3 * drawn.max())
        x, y = drawing.corners_px.astype(np.float32).T[..., None]
        at_corners = cv2.remap(ratio.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)
        return np.clip(at_corners, 0, MOST_SKIN_GAIN)

    def _drawing(self, state: PinState) -> _Drawing:
        base, axis, caps = state.base_mm, state.axis, state.caps_mm
        if base.shape != self._rest.base_mm.shape:
            raise RenderError(f"the state has {len(base)} pins, {self.spec.name} has {len(self._rest.base_mm)}")
        pupil = np.array([0.0, 0.0, -self.spec.camera.distance_mm])
        toward, _, _ = self._direct.refracted_rays(caps, pupil)
        half = 0.5 * self.spec.pins.cap_height_mm
        places = [base, 0.5 * (base + caps), caps, caps + half * axis]
        side = toward - np.sum(toward * axis, axis=1, keepdims=True) * axis
        normals, bump = (axis, unit(side), side_normals(axis), axis), self.spec.appearance.cap_bump
        lit = [self._direct(*each) for each in zip(places, normals, (0.0, 0.0, bump, bump), strict=True)]
        skin = np.concatenate([base, self._belt_mm])
        kept = [self._direct.transmittance(place, pupil) for place in (skin, *places[1:])]
        kept[SIDE] = kept[SIDE][:, None]
        direct = [light * share for light, share in zip([np.concatenate([lit[0], self._belt_light]), *lit[1:]], kept, strict=True)]
        feet_px, outlines_px = self._outlines(base, axis, caps)
        corners_px = np.concatenate([feet_px, self._belt_px]) - self.window_px[:2]
        facing, far_first = np.sum(toward * axis, axis=1) > 0, np.argsort(-np.linalg.norm(caps - pupil, axis=1))
        circles = None
        if self.spec.camera.aperture_mm > 0:
            diameter, shift = circles_px(self.spec.view, np.concatenate([caps, self._belt_mm]))
            circles, outlines_px = diameter[:, None].astype(np.float32), outlines_px + shift[: len(caps), None, None]
        return _Drawing(corners_px, np.ascontiguousarray(outlines_px - self.window_px[:2]), facing, far_first, circles, direct, kept)

    def _gel(self, drawing: _Drawing, shading: Shading) -> FloatArray:
        """Light (H, W, C) of skin and pins before it passes the window."""
        image = np.zeros(self._film.shine.shape, np.float32)
        offset = shading.offset * self._mean_light
        parts = zip(self._albedo, shading.gain, drawing.direct, offset, drawing.ambient, strict=True)
        skin, stem, side, face = (
            self._film.channels(albedo / np.pi * (gain * direct + more * ambient)) for albedo, gain, direct, more, ambient in parts
        )
        draw_triangles(image, drawing.corners_px, skin * shading.skin.astype(np.float32), self._faces)
        draw_pins(image, drawing.outlines_px, (stem, side, face), drawing.facing, drawing.far_first)
        if drawing.circles is None:
            return image
        circles = np.zeros((*image.shape[:2], 1), np.float32)
        draw_triangles(circles, drawing.corners_px, drawing.circles, self._faces)
        return defocused(image, circles[..., 0])


def _fit_gains(parts: FloatArray, target: FloatArray) -> FloatArray:
    """Non-negative gains and offsets (8,) with which parts (m, 8) sum best to a target (m,). Those of hardly visible parts are 1 and 0."""
    trust = TRUST * np.linalg.norm(parts, axis=0).max()
    plain = np.repeat([1.0, 0.0], 4)
    return nnls(np.concatenate([parts, trust * np.eye(8)]).astype(float), np.concatenate([target, trust * plain]).astype(float))[0]


def _belt(geometry: GeometrySpec, feet_mm: FloatArray) -> tuple[FloatArray, IntArray]:
    """Points (b, 3) of the skin at rest from the outermost pins to the rim, and triangles (t, 3) over the feet (N, 3) and these points."""
    shape = shape_of(geometry.skin)
    feet = shape.place(feet_mm)
    start = float(shape.rim_share(feet).max())
    circles = max(int(np.ceil((1 - start) * shape.largest_rad / BELT_STEP_RAD)), 1)
    shares = np.linspace(start, 1, circles + 1)[1:]
    belt = (shares[:, None] * shape.rim(BELT_PLACES)).ravel()
    places = np.concatenate([feet, belt])
    return shape.inside(belt), Delaunay(np.column_stack([places.real, places.imag])).simplices


def _transmittance(view: ViewSpec, window_px: tuple[int, int, int, int]) -> FloatArray:
    """Transmittance (H, W) of the window for the radiance of each pixel."""
    corners = (ray_table(view.camera, window_px) @ sensor_to_camera(view.camera)[:3, :3])[..., 2]
    cos_air = np.clip(0.25 * (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]), 1e-6, 1)
    cos_window, cos_gel = (np.sqrt(1 - (1 - cos_air**2) / n**2) for n in (view.lens.refractive_index, view.gel_index))
    return Window(view).transmittance(cos_air, cos_window, cos_gel)
