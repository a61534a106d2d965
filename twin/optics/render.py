"""Renderer: it computes the linear light on the camera's film for a state of the sensor."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from types import ModuleType

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import RenderError
from twin.geometry.mesh import SensorMesh
from twin.geometry.pins import rest_pins
from twin.optics.glass import CameraRays, Window
from twin.optics.preview import Film, Preview, Shading
from twin.optics.sampling import SKIN_SAVING, PixelSamples, near_pins
from twin.optics.scene import ScalarView, build_scene, move_meshes
from twin.optics.surfaces import PaintedSurface, SkinSurface, caps, stems
from twin.optics.tracer import GelTracer, luminance
from twin.optics.variant import DrJit, VariantChoice, choose_variant, use_variant, with_room
from twin.store import cached_arrays, write_bytes
from twin.types import FloatArray, IntArray, PinState, Quality

SAMPLES = {"rasterised": 0, "preview": 4, "standard": 16, "high": 64}
"""Number of samples per pixel, by quality."""
SCALAR_SAVING = 4
"""Ratio of these to the samples of the scalar variant, which is several times slower."""
SHADING_QUALITY: Quality = "standard"
"""Quality of the path-traced frame to which a stored shading is fitted."""
BOUNCES = 2
"""Number of scatterings of a light path after the first. Because the skin is dark, a third one changes no gray level."""
BRIGHT_SKIN_BOUNCES = 6
"""The same for a sensor with dark caps on a bright skin, which scatters most of the light again."""
PASS_SEED = 0x10000
"""Increment of the seed from one pass of a picture to the next. It is larger than the seeds that callers give to different pictures."""
MOST_SAMPLES_AT_ONCE = 6_000_000
"""Largest number of samples in one pass. It limits the memory of a pass."""


class Renderer:
    """Renders one sensor. The scene is built once; for each state only vertices are moved.

    Parameters
    ----------
    spec : SensorSpec
    variant : str or VariantChoice, optional
        Variant for `twin.optics.variant.choose_variant`. Default: the fastest variant that works.
    quality : {"rasterised", "preview", "standard", "high"}
        A rasterised picture costs a small part of a traced one. Its light is the lamps' direct light, with the shading of a traced frame.
    mesh : SensorMesh, optional
        The mechanics' mesh (``nodes_mm``, ``inner_quads``). With a mesh the skin follows the nodes on its inside, without one it follows
        the feet of the pins.
    window_px : (x0, y0, x1, y1), optional
        Part of the raw frame to render, end exclusive; the whole frame by default.
    spp : int, optional
        Number of samples of a pixel that shows a pin. It replaces the quality's number. Pixels of bare skin get a quarter of it
        (`twin.optics.sampling`).
    bounces : int, optional
        Number of scatterings of a light path after the first. Default: 2, or 6 if the skin is brighter than the caps.
    shading : Shading, optional
        Shading of rasterised pictures. Default: the shading of the frame at rest (`traced_shading`).

    Raises
    ------
    RenderError
        There is no such quality, the window is not within the frame, or ``spp`` is given for a rasterised picture.
    """

    def __init__(
        self,
        spec: SensorSpec,
        variant: str | VariantChoice | None = None,
        quality: Quality = "standard",
        *,
        mesh: SensorMesh | None = None,
        window_px: tuple[int, int, int, int] | None = None,
        spp: int | None = None,
        bounces: int | None = None,
        shading: Shading | None = None,
    ) -> None:
        if quality not in SAMPLES:
            raise RenderError(f"quality={quality!r} is unknown: use {', '.join(SAMPLES)}")
        camera = spec.camera
        window = window_px or (0, 0, camera.width_px, camera.height_px)
        x0, y0, x1, y1 = window
        if not (0 <= x0 < x1 <= camera.width_px and 0 <= y0 < y1 <= camera.height_px):
            raise RenderError(f"window_px={window} must lie within the {camera.width_px} x {camera.height_px} px frame, end exclusive")
        self.spec = spec
        self.window_px = x0, y0, x1, y1
        self.drawn = quality == "rasterised"
        if self.drawn and spp:
            raise RenderError(f"spp={spp}: a rasterised picture has no samples; use another quality, or leave spp out")
        self._variant, self._shading = variant, shading
        self.spp = 0 if self.drawn else spp or SAMPLES[quality] // (SCALAR_SAVING if self.choice.backend == "scalar" else 1)
        self._rest = rest_pins(spec.geometry)
        self._mesh, self._inner = mesh, None if mesh is None else np.unique(mesh.inner_quads)
        usual = BRIGHT_SKIN_BOUNCES if spec.appearance.dark_caps else BOUNCES
        self._bounces = usual if bounces is None else bounces
        self._view: GelView | ScalarView | None = None

    @cached_property
    def choice(self) -> VariantChoice:
        """The variant that traces paths."""
        given = self._variant
        return given if isinstance(given, VariantChoice) else choose_variant(self.spec.camera.channels, given)

    @cached_property
    def preview(self) -> Preview:
        """The `Preview` that draws pictures of the quality ``rasterised``."""
        preview = Preview(self.spec, window_px=self.window_px)
        preview.shading = traced_shading(preview) if self._shading is None else self._shading
        return preview

    @cached_property
    def _skin(self) -> SkinSurface:
        return SkinSurface(self.spec.skin, self._rest.base_mm if self._mesh is None else self._mesh.nodes_mm[self._inner])

    @cached_property
    def film(self) -> Film:
        """What the film gets besides the light of the smooth gel."""
        return Film(self.spec, self.window_px)

    @property
    def static(self) -> tuple[FloatArray, FloatArray]:
        """Light (H, W, C) of the static layer, and its transmittance (H, W) for the gel's light."""
        return self.film.shine, self.film.through[..., 0]

    def render(self, state: PinState | None = None, seed: int = 0) -> FloatArray:
        """Linear light on the film.

        Parameters
        ----------
        state : ContactState or PinRest, optional
            Any object with ``base_mm``, ``axis`` and ``caps_mm``, (N, 3) each, and ``nodes_mm`` if the renderer has a mesh. At rest by
            default.
        seed : int
            The same seed gives the same image.

        Returns
        -------
        (H, W, 3) or (H, W) float32
            RGB for a color camera, luminance for a mono one; H and W of the window.
        """
        (image,) = self.refine(state, seed, samples=(self.spp,))
        return image

    def refine(self, state: PinState | None = None, seed: int = 0, *, samples: Sequence[int]) -> Iterator[FloatArray]:
        """Linear light on the film, with less noise after each pass: yields the mean of all samples so far.

        Parameters
        ----------
        state, seed
            As in ``render``.
        samples : sequence of int
            Number of samples in each pass, for a pixel that shows a pin. Samples are most uniform if it is a power of two.

        Notes
        -----
        No other state may be rendered before the last pass.

        Yields
        ------
        (H, W, 3) or (H, W) float32
            As ``render`` gives it.
        """
        state = self._rest if state is None else state
        if self.drawn:
            yield from [self.preview.render(state)] * len(samples)
            return
        mi = use_variant(self.choice)
        surfaces = self.surfaces(state)
        if self._view is None:
            kind: type[GelView] | type[ScalarView] = ScalarView if self.choice.backend == "scalar" else GelView
            self._view = kind(mi, self.spec, self.window_px, surfaces, self._bounces)
        else:
            move_meshes(self._view.params, surfaces)
        known, through = self.film.light(state), self.film.through.reshape(-1, 1)
        pixels = np.flatnonzero(through)
        total, count = np.zeros((1, 1)), 0
        for k, spp in enumerate(samples):
            gel = self._view.gel_light(pixels, spp, seed + k * PASS_SEED, state)
            total, count = total + spp * (gel if gel.shape[1] == known.shape[2] else luminance(gel)[:, None]), count + spp
            image = known.copy()
            image.reshape(len(through), -1)[pixels] += (through[pixels] * (total / count)).astype(np.float32)
            yield self.film.picture(image)

    def surfaces(self, state: PinState) -> dict[str, PaintedSurface]:
        """Skin, stems and caps of a state, by the names of the scene's meshes.

        Raises
        ------
        RenderError
            The state has another number of pins than the sensor.
        """
        if state.base_mm.shape != self._rest.base_mm.shape:
            raise RenderError(f"the state has {len(state.base_mm)} pins, {self.spec.name} has {len(self._rest.base_mm)}")
        nodes = getattr(state, "nodes_mm", None)
        control = state.base_mm if self._inner is None else (self._skin.control_mm if nodes is None else nodes[self._inner])
        return {
            "skin": PaintedSurface(self._skin.vertices(control), self._skin.faces),
            "stems": stems(self.spec.pins, state.base_mm, state.axis),
            "caps": caps(self.spec.pins, self.spec.appearance, state.caps_mm, state.axis),
        }


def traced_shading(preview: Preview) -> Shading:
    """The shading that ``Preview.calibrate`` fits to a path-traced frame at rest. It is stored between runs.

    Raises
    ------
    RenderError
        If path tracing does not work on this machine.
    """

    def trace() -> dict[str, np.ndarray]:
        return vars(preview.calibrate(Renderer(preview.spec, quality=SHADING_QUALITY, window_px=preview.window_px)))

    key = {"sensor": preview.spec.model_dump(mode="json"), "window_px": list(preview.window_px), "quality": SHADING_QUALITY}
    return Shading(**cached_arrays("shading", key, trace, code=(Preview, Renderer)))


class GelView:
    """The gel as seen through lens and window, rendered by the vectorised variants.

    Parameters
    ----------
    mi : module
        Mitsuba, its variant set.
    spec : SensorSpec
    window_px : (x0, y0, x1, y1)
    surfaces : dict of Surface
        As ``Renderer.surfaces`` gives them.
    bounces : int
    """

    def __init__(
        self, mi: ModuleType, spec: SensorSpec, window_px: tuple[int, int, int, int], surfaces: dict[str, PaintedSurface], bounces: int
    ) -> None:
        import drjit as dr

        self._mi, self._dr, self._spec, self._window_px = mi, dr, spec, window_px
        scene = build_scene(mi, spec.appearance, spec.gel.refractive_index, surfaces)
        self.params = mi.traverse(scene)
        self.tracer = GelTracer(mi, spec, scene, bounces)
        self.rays = CameraRays(mi, dr, spec.camera, Window(spec.view), window_px)

    def gel_light(self, pixels: IntArray, spp: int, seed: int, state: PinState) -> FloatArray:
        """Mean light (n, 3) or (n, 1) of pixels (n,) of the window, numbered row by row. Bare skin gets fewer samples."""
        mi = self._mi
        pins = near_pins(self._spec.view, self._spec.pins, self._spec.appearance, state, self._window_px).ravel()[pixels]
        passes, each, few = 1, spp, -(-spp // (1 if self._spec.appearance.dark_caps else SKIN_SAVING))
        while each > 1 and each * len(pixels) > MOST_SAMPLES_AT_ONCE:
            passes, each, few = 2 * passes, -(-each // 2), -(-few // 2)  # half as many samples: a net with a power of two is most uniform
        first = np.argsort(~pins, kind="stable")  # those near pins come first: each part has one number of samples, and sums by blocks
        near = int(pins.sum())
        parts = [(each, near), (few, len(pixels) - near)]
        counts = np.repeat([each, few], [near, len(pixels) - near])
        index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        pixel, number = mi.UInt32(with_room(np.repeat(pixels[first], counts), np.uint32)), mi.UInt32(with_room(index, np.uint32))
        total: FloatArray = np.zeros((1, 1))
        for k in range(passes):
            total = total + self._sums(self._light(pixel, number, each, (seed * 1009 + k) % 2**32), parts)
        light = np.empty(total.shape)
        light[first] = total / (passes * counts[:, None])
        return light

    def _sums(self, light: DrJit, parts: list[tuple[int, int]]) -> FloatArray:
        """Sums (n, 3) or (n, 1) of light over blocks of samples, given the samples of a block and the number of blocks of each part.

        The sums do not depend on the threads, as those of atomic additions do.
        """
        mi, dr = self._mi, self._dr
        sums, begin = [], 0
        dr.eval(light)
        for samples, blocks in parts:
            if blocks:
                at = dr.arange(mi.UInt32, samples * blocks) + dr.opaque(mi.UInt32, begin)
                sums.append(np.array([dr.block_sum(channel, samples) for channel in dr.gather(mi.Spectrum, light, at)]).T)
            begin += samples * blocks
        return np.concatenate(sums)

    def trace(self, pixels: DrJit, spp: int, seed: int) -> DrJit:
        """Mean light of pixels as a spectrum of Dr.Jit. It can be differentiated by the values in the tracer and the scene."""
        mi, dr = self._mi, self._dr
        number = dr.arange(mi.UInt32, len(pixels) * spp)
        light = self._light(dr.gather(mi.UInt32, pixels, number // spp), number % spp, spp, seed)
        return mi.Spectrum(*(dr.block_sum(channel, spp) / spp for channel in light))

    def _light(self, pixel: DrJit, number: DrJit, spp: int, seed: int) -> DrJit:
        """Light of samples, given the pixel of each sample and its number in this pixel, which is below ``spp``."""
        mi, dr = self._mi, self._dr
        random = PixelSamples(mi, dr, pixel, number, spp, seed)
        place, direction, transmittance = self.rays.sample(mi, dr, pixel, random)
        return self.tracer.radiance(mi, dr, place, direction, random) * transmittance


def write_exr(path: Path, linear: FloatArray, choice: VariantChoice) -> None:
    """Write linear light as a half-float OpenEXR file.

    Parameters
    ----------
    path : Path
    linear : (H, W, 3) or (H, W) float32
    choice : VariantChoice
        The variant that rendered it.
    """
    mi = use_variant(choice)
    pixels = np.ascontiguousarray(linear if linear.ndim == 3 else linear[..., None])
    content = mi.MemoryStream()
    mi.Bitmap(pixels).convert(component_format=mi.Struct.Type.Float16).write(content, mi.Bitmap.FileFormat.OpenEXR)
    write_bytes(path, content.raw_buffer())
