"""Draws or traces the picture of the dome alone, and inserts it into a frame whose other pixels no contact changes."""

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.capture import expose, in_form
from twin.errors import FrameError
from twin.geometry.mesh import build_mesh
from twin.optics.preview import Preview, Shading
from twin.optics.render import Renderer, traced_shading
from twin.optics.static_layer import static_layer
from twin.optics.tracer import luminance
from twin.store import cached_arrays
from twin.types import FloatArray, Form, Frame, ImageArray, PinState

MARGIN_PX = 8
"""Width, px, of the border around the pipeline's mask that is also drawn, because blur and thresholds use pixels at this distance."""
PARTS = (4, 2, 2)
"""Divisors of the renderer's samples, one for each pass of a path-traced picture. The first pass is shown at once, then the mean of all."""


def dome_window(spec: SensorSpec) -> tuple[int, int, int, int]:
    """The part (x0, y0, x1, y1) of the raw frame, end exclusive, in which a contact changes pixels that the pipeline uses."""
    mask = spec.pipeline.raw
    x, y, reach = *mask.mask_center_px, mask.mask_radius_px + MARGIN_PX
    box = [x - reach, y - reach, x + reach, y + reach]
    if spec.recording is not None:
        crop = spec.recording.crop_px
        box = [min(box[0], crop[0]), min(box[1], crop[1]), max(box[2], crop[2]), max(box[3], crop[3])]
    width, height = spec.camera.width_px, spec.camera.height_px
    return max(0, int(box[0])), max(0, int(box[1])), min(width, int(np.ceil(box[2]))), min(height, int(np.ceil(box[3])))


def dome_part(spec: SensorSpec, image: ImageArray, form: Form) -> ImageArray:
    """The dome's part of a raw frame. A recording's frame is returned whole, because it shows nothing else."""
    if form == Form.PROCESSED:
        return image
    x0, y0, x1, y1 = dome_window(spec)
    return image[y0:y1, x0:x1]


def static_light(spec: SensorSpec) -> tuple[FloatArray, FloatArray]:
    """Light and cover of the whole raw frame that no contact changes (``static_layer``). The result is stored for later runs."""

    def compute() -> dict[str, np.ndarray]:
        return dict(zip(("light", "cover"), static_layer(spec, (0, 0, spec.camera.width_px, spec.camera.height_px)), strict=True))

    kept = cached_arrays("static-light", {"sensor": spec.model_dump(mode="json")}, compute, code=(static_layer,))
    return kept["light"], kept["cover"]


def dome_shading(spec: SensorSpec) -> Shading:
    """The preview's shading, from a path-traced frame at rest. The result is stored for later runs.

    Raises
    ------
    RenderError
        This machine cannot path-trace.
    """
    return traced_shading(Preview(spec, window_px=dome_window(spec), static=in_window(static_light(spec), dome_window(spec))))


def dome_renderer(spec: SensorSpec) -> Renderer:
    """A path tracer of the dome's part of the frame, for contacts on the usual mesh or on a finer one."""
    return Renderer(spec, mesh=build_mesh(spec.geometry), window_px=dome_window(spec))


def in_window(planes: tuple[FloatArray, FloatArray], window_px: tuple[int, int, int, int]) -> tuple[FloatArray, FloatArray]:
    """The window's part of planes of the whole frame."""
    x0, y0, x1, y1 = window_px
    return planes[0][y0:y1, x0:x1], planes[1][y0:y1, x0:x1]


class StudioCamera:
    """Draws the dome, and makes frames from rasterised or path-traced light.

    Parameters
    ----------
    spec : SensorSpec
    """

    def __init__(self, spec: SensorSpec) -> None:
        self.spec, self.window_px = spec, dome_window(spec)
        static = static_light(spec)
        self.preview = Preview(spec, window_px=self.window_px, static=in_window(static, self.window_px))
        around = static[0].copy() if spec.camera.channels == "color" else luminance(static[0]).astype(np.float32)
        x0, y0, x1, y1 = self.window_px
        around[y0:y1, x0:x1] = self.preview.render()
        self._around = expose(around, spec.capture)

    def draw(self, state: PinState) -> FloatArray:
        """Linear light of the window for a state, rasterised."""
        return self.preview.render(state)

    def raw(self, light: FloatArray, *, seed: int) -> Frame:
        """The whole raw frame of the window's light (h, w) or (h, w, 3), with the camera's noise."""
        x0, y0, x1, y1 = self.window_px
        image = self._around.copy()
        image[y0:y1, x0:x1] = expose(light, self.spec.capture, np.random.default_rng(seed), origin_px=(x0, y0))
        return Frame(image, Form.RAW)

    def as_recorded(self, raw: Frame) -> Frame:
        """A raw frame in the form of the sensor's recordings.

        Raises
        ------
        FrameError
            The sensor has no processed form.
        """
        if self.spec.recording is None:
            raise FrameError(f"{self.spec.name} has no processed frames; show raw frames")
        return in_form(raw, Form.PROCESSED, self.spec.recording)
