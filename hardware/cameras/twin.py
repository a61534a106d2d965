"""A camera in the twin: the sensor's view, drawn for the contact that the arm's pose makes."""

import threading
import time
from collections.abc import Callable

import numpy as np

from hardware.arms.arm import ArmState
from hardware.cameras.reader import LiveSource, Picture, ReadFailed
from hardware.errors import DeviceError
from hardware.rig_geometry import PlacedObject
from scenes.sensor import SensorSpec
from twin.camera.capture import expose, record
from twin.errors import ContactError
from twin.frames.forms import frame_size
from twin.mechanics.follow import Follower
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Preview
from twin.rig.contact import contact_law
from twin.types import ContactState, Form, Frame

PoseSource = Callable[[], ArmState]
RETRY_S, ASKED_S = 0.05, 0.1
FIRST_FRAME_S = 120.0  # kernels may have to be compiled
STEADY_SD = 1.0  # gray levels of noise where the specification has none: a real sensor's measured temporal noise


class TwinCamera(LiveSource):
    """Draws what the sensor sees while an arm moves it about an object.

    Each frame shows the arm's pose at its ``time_s``. Contacts are solved step after step with all they remember, so what a
    frame shows depends on the way there.

    Parameters
    ----------
    spec : SensorSpec
    placed : PlacedObject
    arm : callable
        The arm's newest state.
    form : Form
    fps : float
        No more frames a second than this.
    seed : int
        Of the noise.
    preview : Preview, optional
        Of the window that the form needs; the direct light's by default.
    on_demand : bool
        Draw only while a frame is waited for: for loops that stop for each frame, and have no use for those in between.
    """

    notices_still = False  # the twin has a memory, not a cable
    first_frame_s = FIRST_FRAME_S

    def __init__(
        self,
        spec: SensorSpec,
        placed: PlacedObject,
        arm: PoseSource,
        form: Form = Form.RAW,
        *,
        fps: float = 30.0,
        seed: int = 0,
        preview: Preview | None = None,
        on_demand: bool = False,
    ) -> None:
        super().__init__(f"twin of {spec.name}", form)
        frame_size(spec, self.form)
        self._spec, self._placed, self._arm, self._period_s = spec, placed, arm, 1.0 / fps
        self._seed, self._preview = seed, preview
        self._asked = threading.Event() if on_demand else None
        self._follower: Follower | None = None
        self._drawn, self._due_s = 0, 0.0
        self.state: ContactState | None = None  # of the newest frame

    def _open(self) -> None:
        if self._preview is None:
            self._preview = preview_of(self._spec, self.form)
        if self._follower is None:
            law = contact_law(self._spec.rig, self._placed.mounting, self._placed.spec)
            self._follower = Follower(SkinSolver(self._spec), self._placed.spec, law)
            self._follower.warm_up()

    def _close(self) -> None:
        pass

    def _take(self, wanted, timeout_s: float, missing: str) -> Frame:
        if self._asked is not None:
            self._asked.set()
        return super()._take(wanted, timeout_s, missing)

    def _grab(self) -> Picture:
        if self._asked is not None:
            self._await_reader()
        self._end.wait(max(0.0, self._due_s - time.monotonic()))
        self._due_s = time.monotonic() + self._period_s
        try:
            told = self._arm()
            self.state = self._follower.move(self._placed.seen_from(told.pose), told.time_s)
        except (ContactError, DeviceError) as error:
            self._end.wait(RETRY_S)
            if self._asked is not None:
                self._asked.set()
            raise ReadFailed(str(error)) from error
        light = self._preview.render(self.state)
        self._drawn += 1
        rng = np.random.default_rng((self._seed, self._drawn))
        return Picture(steady(expose(light, self._spec.capture, rng, origin_px=self._preview.window_px[:2]), self._spec, rng), told.time_s)

    def _await_reader(self) -> None:
        """Until a frame is asked for; who asks from now on gets one that is drawn later."""
        while not (self._asked.wait(ASKED_S) or self._end.is_set()):
            pass
        self._asked.clear()

    def _finish(self, image: np.ndarray) -> np.ndarray:
        if self.form is Form.RECORDING:
            return record(image, self._spec.recording, origin_px=self._preview.window_px[:2])
        return image


def preview_of(spec: SensorSpec, form: Form) -> Preview:
    """The preview of the part of the raw frame that a form needs."""
    return Preview(spec, window_px=spec.recording.crop_px if form is Form.RECORDING else None)


def steady(image: np.ndarray, spec: SensorSpec, rng: np.random.Generator) -> np.ndarray:
    """A frame with the least noise that a real sensor has, where the specification has none."""
    if spec.response.read_noise or spec.response.shot_noise:
        return image
    return np.clip(np.rint(image + STEADY_SD * rng.standard_normal(image.shape, np.float32)), 0, 255).astype(np.uint8)
