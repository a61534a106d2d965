"""The twin of one sensor: simulation of contacts, and frames of its camera with ground truth."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import get_args

import numpy as np

from scenes.base import SpecError
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.camera.capture import expose, in_form
from twin.camera.projection import CapTruth, cap_truth, segment_distance
from twin.compiled import begin_compiling
from twin.errors import ContactError, FrameError, OptionError
from twin.frames.forms import form_named, frame_size
from twin.frames.images import write_image
from twin.mechanics.law import Friction
from twin.mechanics.newton import GAP_BOUND_MM, RESIDUAL_TOLERANCE
from twin.mechanics.path import ContactPath, ContactPose
from twin.mechanics.solver import ContactJob, SkinSolver, press_many
from twin.optics.preview import Shading
from twin.optics.render import Renderer
from twin.progress import Progress, silent, stage
from twin.store import write_npz
from twin.types import ContactState, FloatArray, Form, Frame, Quality, present_value

_SAME_MM = 1e-6
"""Largest distance between the same place of two states of one sensor, where nothing moves, mm: rounding."""


@dataclass(frozen=True)
class RenderedFrame:
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

    def __repr__(self) -> str:
        visible = self.truth.visible
        return f"<RenderedFrame: {self.frame!r}, {visible.sum()} of {len(visible)} caps visible, {self.seconds:.2f} s>"

    def to_table(self) -> dict[str, np.ndarray]:
        """Columns with a row for each pin, in the specification's order: ``pandas.DataFrame(rendered.to_table())``."""
        at, rest = self.truth.caps_px, self.truth.rest_px
        places = {"x_px": at[:, 0], "y_px": at[:, 1], "rest_x_px": rest[:, 0], "rest_y_px": rest[:, 1]}
        return {"pin": np.arange(len(at)), **places, "visible": self.truth.visible}

    def save(self, folder: str | Path) -> list[Path]:
        """Write ``frame.png`` and ``truth.npz`` (the attributes of ``CapTruth``) into a folder, made if missing. Returns the files."""
        written = [Path(folder) / "frame.png", Path(folder) / "truth.npz"]
        written[0].parent.mkdir(parents=True, exist_ok=True)
        write_image(written[0], self.frame.image)
        write_npz(written[1], asdict(self.truth), compressed=True)
        return written


class Simulator:
    """Solver and renderer of one sensor, built once and used for many contacts.

    Parameters
    ----------
    spec : SensorSpec
    quality : {"rasterised", "preview", "standard", "high"}
        Quality of the renderer.
    solver : SkinSolver, optional
        A solver of the same sensor. Default: a new one with the usual resolution.
    shading : Shading, optional
        Shading of rasterised pictures (see `Renderer`).

    Raises
    ------
    SpecError
        ``spec`` is no specification.
    OptionError
        There is no such quality.
    """

    def __init__(
        self, spec: SensorSpec, *, quality: Quality = "standard", solver: SkinSolver | None = None, shading: Shading | None = None
    ) -> None:
        if not isinstance(spec, SensorSpec):
            raise SpecError(f"a SensorSpec is expected, got {spec!r}; give load_sensor({str(spec)!r})")
        quality = present_value(quality)
        if quality not in get_args(Quality):
            raise OptionError(f"`quality`: expected {', '.join(get_args(Quality))}, got {quality!r}")
        self.spec = spec
        self.solver = solver or SkinSolver(spec)
        self.rest = self.solver.rest()
        self._quality, self._shading = quality, shading
        self._renderer: Renderer | None = None
        self._rest_frames: dict[Form, RenderedFrame] = {}

    def __repr__(self) -> str:
        return f"<Simulator of {self.spec.name}, quality {self._quality}>"

    @property
    def renderer(self) -> Renderer:
        """The renderer. It is built when it is first needed, because a simulation without rendering needs no Mitsuba."""
        if self._renderer is None:
            self._renderer = Renderer(self.spec, quality=self._quality, mesh=self.solver.mesh, shading=self._shading)
        return self._renderer

    def press(
        self,
        obj: ObjectSpec,
        pose: ContactPose | ContactPath,
        *,
        friction: float | Friction | None = None,
        compliance_mm_per_n: float | None = None,
        progress: Callable[[float], object] | None = None,
    ) -> ContactState:
        """Press an object against the sensor and shear it, as ``pose`` states.

        Parameters
        ----------
        obj : ObjectSpec
        pose : ContactPose or ContactPath
        friction : float or Friction, optional
            Coefficient of friction, static and kinetic. Default: the object's own.
        compliance_mm_per_n : float, optional
            Displacement of the object along z per N of contact force. Default: the object's own.
        progress : callable, optional
            Called with the completed fraction, 0 to 1.

        Raises
        ------
        SpecError
            ``obj`` is no specification.
        ContactError
            If the indentation is negative or the pose is out of reach, or if the solver does not converge.
        """
        _require_contact(obj, pose)
        begin_compiling("twin.prepare", segment_distance)  # a picture may follow
        told = None if progress is None else lambda fraction, _: progress(fraction)
        return self.solver.press(obj, pose, friction=friction, compliance_mm_per_n=compliance_mm_per_n, progress=told)

    def press_many(
        self,
        contacts: Iterable[tuple[ObjectSpec, ContactPose | ContactPath]],
        *,
        friction: float | Friction | None = None,
        workers: int = 1,
        progress: Progress = silent,
    ) -> list[ContactState]:
        """The states of many contacts, in their order; as ``press``. They do not depend on the number of ``workers``, which are processes.

        Raises
        ------
        SpecError, ContactError
            As ``press``; the message contains the number of the contact, from 0.
        """
        jobs = [ContactJob(obj, pose, friction) for obj, pose in contacts]
        for job in jobs:
            _require_contact(job.obj, job.pose)
        found: dict[int, ContactState] = {}
        with stage(progress, "contacts") as step:
            for outcome in press_many(self.spec, jobs, processes=workers, resolution=self.solver.resolution):
                if outcome.error:
                    raise ContactError(f"contact {outcome.number}: {outcome.error}")
                found[outcome.number] = outcome.states[-1]
                step(len(found), len(jobs))
        return [found[number] for number in range(len(jobs))]

    def render(self, state: ContactState, *, form: Form = Form.RAW, seed: int = 0, name: str = "frame.png") -> RenderedFrame:
        """Render the camera's frame in the given form; the same state and seed give the same picture.

        Raises
        ------
        FrameError
            The sensor has no processed form, or there is no such form.
        ContactError
            The state is one of another sensor.
        RenderError
            The renderer does not work on this machine.
        """
        self.check_form(form)
        self._require_own(state)
        start = perf_counter()
        linear = self.renderer.render(state, seed=seed)
        image = expose(linear, self.spec.capture, np.random.default_rng(seed))
        seconds = perf_counter() - start
        raw = RenderedFrame(Frame(image, Form.RAW, name), linear, cap_truth(self.spec, self.rest, state, Form.RAW), seconds)
        return raw if form == Form.RAW else self.as_processed(raw, state)

    def render_rest(self, form: Form = Form.RAW) -> RenderedFrame:
        """The frame without contact in the given form. It is rendered once and then stored."""
        form = form_named(form)
        if form not in self._rest_frames:
            self._rest_frames[form] = self.render(self.rest, form=form)
        return self._rest_frames[form]

    def as_processed(self, raw: RenderedFrame, state: ContactState) -> RenderedFrame:
        """A raw frame, cropped and thresholded as the sensor's recordings are.

        Raises
        ------
        FrameError
            The sensor has no such form.
        """
        if self.spec.recording is None:
            raise FrameError(f"{self.spec.name} has no processed form; give its specification the section 'recording', or use raw frames")
        frame = in_form(raw.frame, Form.PROCESSED, self.spec.recording)
        return replace(raw, frame=frame, truth=cap_truth(self.spec, self.rest, state, Form.PROCESSED))

    def _require_own(self, state: ContactState) -> None:
        """A state of this sensor has its pins, as long as they are, and its window, which no contact moves."""
        rest, window = self.rest, slice(-self.solver.mesh.outer_count, None)
        same = len(state.caps_mm) == len(rest.caps_mm) and state.nodes_mm.shape == rest.nodes_mm.shape
        if same:
            lengths = [np.linalg.norm(each.caps_mm - each.base_mm, axis=1) for each in (state, rest)]
            still = [each.nodes_mm[window] for each in (state, rest)]
            same = all(np.allclose(one, other, atol=_SAME_MM) for one, other in (lengths, still))
        if not same:
            raise ContactError(f"the state is not one of {self.spec.name}, but of another sensor; press the object against this one")

    def describe(self) -> dict[str, dict[str, object]]:
        """All other parameters of a result besides sensor and object: variant, samples (0 for a rasterised picture), mesh and
        tolerances."""
        across = self.solver.resolution.across
        return {
            "renderer": {"variant": self.renderer.choice.variant, "samples_per_pixel": self.renderer.spp},
            "solver": {"elements_across": across, "gap_bound_mm": GAP_BOUND_MM, "residual_tolerance": RESIDUAL_TOLERANCE},
        }

    def check_form(self, form: Form) -> None:
        """Raise FrameError if the sensor does not have this form."""
        frame_size(self.spec, form)


def _require_contact(obj: ObjectSpec, pose: ContactPose | ContactPath) -> None:
    """Refuse what is no contact, before any work."""
    if not isinstance(obj, ObjectSpec):
        raise SpecError(f"an ObjectSpec is expected, got {obj!r}; give load_object({str(obj)!r})")
    if not isinstance(pose, ContactPose | ContactPath):
        raise ContactError(f"a ContactPose is expected, got {pose!r}; give ContactPose(indent_mm=3.0)")
    if isinstance(pose, ContactPose) and pose.indent_mm < 0:
        raise ContactError(f"`indent_mm` {pose.indent_mm:g}: the object would not touch; give 0 for no contact, or more")
