"""From a sensor's state to the linear light on its camera's film."""

from typing import Literal

import cv2
import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import RenderError
from twin.geometry.pins import rest_pins
from twin.optics import scene as scene_module
from twin.optics.lens import ray_table
from twin.optics.surfaces import SkinSurface, Surface, caps, stems
from twin.optics.variant import VariantChoice, choose_variant, use_variant

Quality = Literal["preview", "standard", "high"]
SAMPLES = {"preview": 4, "standard": 16, "high": 64}  # per pixel
SCALAR_SAMPLES = {"preview": 1, "standard": 4, "high": 16}  # the scalar variant is several times slower
MAX_DEPTH = 4  # dark skin: a fourth bounce changes no gray level
MOST_SAMPLES_AT_ONCE = 6_000_000  # bounds the memory of one pass
PINHOLE_OVERSAMPLING = 1.3  # pixels of the ideal image per pixel of the frame, where it is remapped


class Renderer:
    """Renders one sensor; builds its scene once and then only moves vertices.

    Parameters
    ----------
    spec : SensorSpec
    variant : str or VariantChoice, optional
        As for `twin.optics.variant.choose_variant`; the best that works by default.
    quality : {"preview", "standard", "high"}
    mesh : SensorMesh, optional
        The mechanics' mesh (``nodes_mm``, ``inner_quads``). With it the skin follows the nodes on its
        inside, without it the feet of the pins.
    window_px : (x0, y0, x1, y1), optional
        Part of the raw frame to render, end exclusive; the whole frame by default.
    spp : int, optional
        Samples per pixel instead of the quality's.
    max_depth : int
        Longest light path, in segments.
    """

    def __init__(
        self,
        spec: SensorSpec,
        variant: str | VariantChoice | None = None,
        quality: Quality = "standard",
        *,
        mesh=None,
        window_px: tuple[int, int, int, int] | None = None,
        spp: int | None = None,
        max_depth: int = MAX_DEPTH,
    ):
        if quality not in SAMPLES:
            raise RenderError(f"quality={quality!r} is unknown: use {', '.join(SAMPLES)}")
        camera = spec.camera
        window = window_px or (0, 0, camera.width_px, camera.height_px)
        x0, y0, x1, y1 = window
        if not (0 <= x0 < x1 <= camera.width_px and 0 <= y0 < y1 <= camera.height_px):
            raise RenderError(f"window_px={window} must lie within the {camera.width_px} x {camera.height_px} px frame, end exclusive")
        self.spec = spec
        self.window_px = window
        self.choice = variant if isinstance(variant, VariantChoice) else choose_variant(camera.channels, variant)
        self._scalar = self.choice.backend == "scalar"
        self.spp = spp or (SCALAR_SAMPLES if self._scalar else SAMPLES)[quality]
        self._rest = rest_pins(spec)
        self._inner = None if mesh is None else np.unique(mesh.inner_quads)
        self._skin = SkinSurface(spec, self._rest.base_mm if mesh is None else mesh.nodes_mm[self._inner])
        self._max_depth = max_depth
        self._scene = None

    def render(self, state=None, seed: int = 0) -> np.ndarray:
        """Linear light on the film.

        Parameters
        ----------
        state : ContactState or PinRest, optional
            Anything with ``base_mm``, ``axis`` and ``caps_mm`` (or ``cap_mm``), (N, 3) each, and, where the renderer
            has a mesh, ``nodes_mm``. At rest by default.
        seed : int
            The same seed gives the same image.

        Returns
        -------
        (H, W, 3) or (H, W) float32
            RGB for a color camera, luminance for a mono one; H and W of the window.
        """
        mi = use_variant(self.choice)
        surfaces = self._surfaces(self._rest if state is None else state)
        if self._scene is None:
            self._build(mi, surfaces)
        else:
            self._move(surfaces)
        image = self._render_passes(mi, seed)
        if self._remap is not None:
            image = cv2.remap(image, *self._remap, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        image = np.maximum(image, 0)
        if self.spec.camera.channels == "color":
            return image
        return np.ascontiguousarray(image[..., 0] if self.choice.mono else scene_module.luminance(image).astype(np.float32))

    def _surfaces(self, state) -> dict[str, Surface]:
        cap_mm = state.caps_mm if hasattr(state, "caps_mm") else state.cap_mm
        if state.base_mm.shape != self._rest.base_mm.shape:
            raise RenderError(f"the state has {len(state.base_mm)} pins, {self.spec.name} has {len(self._rest.base_mm)}")
        nodes = getattr(state, "nodes_mm", None)
        control = state.base_mm if self._inner is None else (self._skin.control_mm if nodes is None else nodes[self._inner])
        return {
            "skin": Surface(self._skin.vertices(control), self._skin.faces),
            "stems": stems(self.spec, state.base_mm, state.axis),
            "caps": caps(self.spec, cap_mm, state.axis),
        }

    def _build(self, mi, surfaces: dict[str, Surface]) -> None:
        self._scene = scene_module.build_scene(mi, self.spec, **surfaces, max_depth=self._max_depth)
        self._params = mi.traverse(self._scene)
        table = ray_table(self.spec.camera, self.window_px)
        if self._scalar:
            centres = 0.25 * (table[:-1, :-1] + table[1:, :-1] + table[:-1, 1:] + table[1:, 1:])
            half_field = float(np.abs(table).max())
            pixels_per_unit = max(self.spec.camera.fx_px, self.spec.camera.fy_px)
            size = int(np.ceil(2 * half_field * pixels_per_unit * PINHOLE_OVERSAMPLING))
            self._camera = scene_module.build_pinhole_camera(mi, self.spec, half_field, size, spp=self.spp)
            places = ((centres / half_field + 1) * 0.5 * size - 0.5).astype(np.float32)
            self._remap = places[..., 0], places[..., 1]
        else:
            self._camera = scene_module.build_table_camera(mi, self.spec, table, spp=self.spp)
            self._remap = None

    def _move(self, surfaces: dict[str, Surface]) -> None:
        for name, surface in surfaces.items():
            self._params[f"{name}.vertex_positions"] = np.ascontiguousarray(surface.vertices_mm, np.float32).ravel()
        self._params.update()

    def _render_passes(self, mi, seed: int) -> np.ndarray:
        width, height = self._camera.film().size()
        passes, each = 1, self.spp
        while not self._scalar and each > 1 and each * width * height > MOST_SAMPLES_AT_ONCE:
            passes, each = 2 * passes, -(-each // 2)  # halves: the sampler stratifies powers of two well
        total = 0.0
        for k in range(passes):
            image = mi.render(self._scene, sensor=self._camera, spp=each, seed=(seed * 1009 + k) % 2**32)
            total = total + np.array(image, dtype=np.float32)
        return total / passes
