"""Plain path tracing of the sensor: the baseline of the renderer's speed."""

import numpy as np

from twin.camera.projection import project
from twin.geometry.pins import rest_pins
from twin.optics.render import BOUNCES, Renderer
from twin.optics.scene import ScalarView
from twin.optics.variant import use_variant


class PlainPath:
    """Mitsuba's `path` integrator, independent samples, every pixel of a square film: apparent LEDs in the gel, no window.

    Parameters
    ----------
    renderer : Renderer
        Whose sensor, surfaces and variant are taken.
    size_px : int
        Of the film; caps are as large on it as on the renderer's.
    """

    def __init__(self, renderer: Renderer, size_px: int):
        self._mi, self._renderer, self.size_px = use_variant(renderer.choice), renderer, size_px
        self._rest = rest_pins(renderer.spec.geometry)
        self._view = ScalarView(self._mi, renderer.spec, renderer.window_px, renderer.surfaces(self._rest), BOUNCES)
        self._eye_mm = self._view._eye_mm
        tangents = self._tangents(self._rest.caps_mm)
        film_px = np.ptp(project(renderer.spec.view, self._rest.caps_mm), axis=0).max()
        self._half_field = float(np.ptp(tangents, axis=0).max() * size_px / film_px / 2)

    def render(self, state, spp: int, seed: int) -> np.ndarray:
        """Linear light (size, size)."""
        mi, size = self._mi, self.size_px
        self._view.move(self._renderer.surfaces(state))
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
        pose = np.diag([-1.0, -1.0, 1.0, 1.0])
        pose[:3, 3] = self._eye_mm
        camera = mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(self._half_field))),
                "to_world": mi.ScalarTransform4f(pose),
                "film": film,
                "sampler": {"type": "independent", "sample_count": spp},
            }
        )
        return np.array(mi.render(self._view._scene, sensor=camera, spp=spp, seed=seed))[..., 0]

    def project(self, points_mm: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3)."""
        return (self._tangents(points_mm) / self._half_field + 1) * 0.5 * self.size_px - 0.5

    def _tangents(self, points_mm: np.ndarray) -> np.ndarray:
        across = points_mm - self._eye_mm
        return across[:, :2] / across[:, 2:]
