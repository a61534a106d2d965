"""The twin of one sensor: simulation of contacts, and frames of its camera with ground truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from scenes.base import SpecError
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.camera.capture import expose, record
from twin.camera.truth import CapTruth, cap_truth
from twin.errors import FrameError
from twin.frames.forms import frame_size
from twin.mechanics.newton import GAP_BOUND_MM, RESIDUAL_TOLERANCE
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Shading
from twin.optics.render import Quality, Renderer
from twin.types import ContactState, FloatArray, Form, Frame


@dataclass(frozen=True)
class Shot:
    """A rendered frame with its ground truth.

    Attributes
    ----------
    frame : Frame
    linear : (H, W) or (H, W, 3) float32
        Radiance before the camera's response, of the whole raw frame.
    truth : CapTruth
        Positions of the caps in px of ``frame``.
    seconds : float
        Time of rendering, s.
    """

    frame: Frame
    linear: FloatArray
    truth: CapTruth
    seconds: float


class Simulator:
    """Solver and renderer of one sensor, built once and used for many contacts.

    Parameters
    ----------
    spec : SensorSpec
    quality : {"drawn", "preview", "standard", "high"}
        Quality of the renderer.
    solver : SkinSolver, optional
        A solver of the same sensor. Default: a new one with the usual resolution.
    shading : Shading, optional
        Shading of drawn pictures (see `Renderer`).

    Raises
    ------
    SpecError
        ``spec`` is no specification.
    """

    def __init__(
        self, spec: SensorSpec, *, quality: Quality = "standard", solver: SkinSolver | None = None, shading: Shading | None = None
    ) -> None:
        if not isinstance(spec, SensorSpec):
            raise SpecError(f"a SensorSpec is expected, got {spec!r}; give load_sensor({str(spec)!r})")
        self.spec = spec
        self.solver = solver or SkinSolver(spec)
        self.rest = self.solver.rest()
        self._quality, self._shading = quality, shading
        self._renderer: Renderer | None = None
        self._rest_shots: dict[Form, Shot] = {}

    @property
    def renderer(self) -> Renderer:
        """The renderer. It is built when it is first needed, because a simulation without rendering needs no Mitsuba."""
        if self._renderer is None:
            self._renderer = Renderer(self.spec, quality=self._quality, mesh=self.solver.mesh, shading=self._shading)
        return self._renderer

    def press(self, touched: ObjectSpec, pose: ContactPose, *, progress: Callable[[float], object] | None = None) -> ContactState:
        """Press an object against the sensor and shear it, as ``pose`` states.

        Raises
        ------
        SpecError
            ``touched`` is no specification.
        ContactError
            If the pose is out of reach, or if the solver does not converge.
        """
        if not isinstance(touched, ObjectSpec):
            raise SpecError(f"an ObjectSpec is expected, got {touched!r}; give load_object({str(touched)!r})")
        return self.solver.press(touched, pose, progress=None if progress is None else lambda fraction, _: progress(fraction))

    def shoot(self, state: ContactState, *, form: Form = Form.RAW, seed: int = 0, name: str = "frame.png") -> Shot:
        """Render the camera's frame in the given form.

        Raises
        ------
        FrameError
            The sensor has no recording form, or there is no such form.
        RenderError
            The renderer does not work on this machine.
        """
        self.check_form(form)
        start = perf_counter()
        linear = self.renderer.render(state, seed=seed)
        image = expose(linear, self.spec.capture, np.random.default_rng(seed))
        seconds = perf_counter() - start
        raw = Shot(Frame(image, Form.RAW, name), linear, cap_truth(self.spec, self.rest, state, Form.RAW), seconds)
        return raw if form == Form.RAW else self.as_recorded(raw, state)

    def shoot_rest(self, form: Form) -> Shot:
        """The frame without contact in the given form. It is rendered once and then stored."""
        if form not in self._rest_shots:
            self._rest_shots[form] = self.shoot(self.rest, form=form)
        return self._rest_shots[form]

    def as_recorded(self, raw: Shot, state: ContactState) -> Shot:
        """The shot of a raw frame in the form of the sensor's recordings.

        Raises
        ------
        FrameError
            The sensor has no such form.
        """
        if self.spec.recording is None:
            raise FrameError(f"{self.spec.name} has no recording form; give its specification the section 'recording', or use raw frames")
        image = record(raw.frame.image, self.spec.recording)
        frame = replace(raw.frame, image=image, form=Form.RECORDING)
        return replace(raw, frame=frame, truth=cap_truth(self.spec, self.rest, state, Form.RECORDING))

    def describe(self) -> dict[str, dict[str, object]]:
        """All other parameters of a result besides sensor and object: variant, samples (0 for a drawn picture), mesh and tolerances."""
        return {
            "renderer": {"variant": self.renderer.choice.variant, "samples_per_pixel": self.renderer.spp},
            "solver": {
                "elements_across": self.solver.resolution.across,
                "gap_bound_mm": GAP_BOUND_MM,
                "residual_tolerance": RESIDUAL_TOLERANCE,
            },
        }

    def check_form(self, form: Form) -> None:
        """Raise FrameError if the sensor does not have this form."""
        frame_size(self.spec, form)
