"""A camera in the twin: it draws the sensor's view of the contact at the arm's pose."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np

from hardware.arms.arm import ArmState
from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed
from hardware.errors import DeviceError, DeviceNotConnectedError
from hardware.rig.geometry import PlacedObject
from scenes.sensor import ResponseSpec, SensorSpec
from twin.camera.capture import expose, record
from twin.errors import ContactError
from twin.frames.forms import frame_size
from twin.mechanics.follow import Follower
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Preview
from twin.rig.contact import contact_law
from twin.types import Form, Frame, PinState

LOG = logging.getLogger(__name__)
PoseSource = Callable[[], ArmState]
# Pause after a pose that could not be drawn, in s.
RETRY_S = 0.05
# Interval in s at which a camera that waits for a reader checks whether it was closed.
ASKED_S = 0.1
# Longest time from connecting to the first frame, in s. Kernels may have to be compiled in this time.
FIRST_FRAME_S = 120.0
# Standard deviation of the noise in gray levels, for a sensor whose specification has no noise. It was measured over time on a real sensor.
STEADY_SD = 1.0


class World(Protocol):
    """What a sensor touches while an arm moves it."""

    def warm_up(self) -> None:
        """Compile what ``move`` needs."""

    def move(self, pose: np.ndarray, time_s: float) -> PinState:
        """The pins with the arm at a pose (6,), where it is at ``time_s``; ``ContactError`` if the contact can't be computed."""
        ...


class _AtPlacedObject:
    """A placed object, which stands still, with finite elements."""

    def __init__(self, spec: SensorSpec, placed: PlacedObject | None) -> None:
        assert placed is not None
        self._placed = placed
        self._follower = Follower(SkinSolver(spec), placed.spec, contact_law(spec.rig, placed.mounting, placed.spec))

    def warm_up(self) -> None:
        self._follower.warm_up()

    def move(self, pose: np.ndarray, time_s: float) -> PinState:
        return self._follower.move(self._placed.object_from(pose), time_s)


class TwinCamera(LiveSource):
    """Draws the sensor's view while an arm moves it about an object.

    Each frame shows the arm's pose at its ``time_s``. Contacts are solved step by step with their history, so a frame depends on the path
    to the present pose.

    Parameters
    ----------
    spec : SensorSpec
    placed : PlacedObject or None
        Not needed with ``world``.
    arm : callable
        The arm's newest state.
    form : Form
    fps : float
        Largest number of frames per second.
    seed : int
        Seed of the noise.
    preview : Preview, optional
        A preview of the window that the form needs. By default it draws only the direct light.
    on_demand : bool
        Draw only while a reader waits for a frame. This is for loops that stop for each frame: they do not use the frames in between.
    waits_for_arm : bool
        Deliver nothing while the arm's pose is not known, for any time. Otherwise the camera ends after some failed reads.
    world : World, optional
        What the sensor touches; by default the placed object, which stands still, with finite elements.
    """

    notices_still = False  # the twin's pictures may repeat without a fault
    notices_late = False  # a contact takes as long to compute as the machine needs
    first_frame_s = FIRST_FRAME_S
    _spec: SensorSpec

    def __init__(
        self,
        spec: SensorSpec,
        placed: PlacedObject | None,
        arm: PoseSource,
        form: Form = Form.RAW,
        *,
        fps: float = 30.0,
        seed: int = 0,
        preview: Preview | None = None,
        on_demand: bool = False,
        waits_for_arm: bool = False,
        world: World | None = None,
    ) -> None:
        super().__init__(f"twin of {spec.name}", form)
        frame_size(spec, self.form)
        self._spec, self._placed, self._arm, self._period_s = spec, placed, arm, 1.0 / fps
        self._seed, self._preview = seed, preview
        self._recording = spec.recording if self.form is Form.PROCESSED else None
        self.streams = not on_demand
        self._on_demand, self._asked = on_demand, threading.Event()
        self._waits_for_arm = waits_for_arm
        self._given = world
        self._world: World | None = None
        self._drawn, self._due_s = 0, 0.0
        self.state: PinState | None = None  # of the newest frame

    def _open(self) -> None:
        self._preview = self._preview or preview_of(self._spec, self.form)
        if self._world is None:
            world = self._given or _AtPlacedObject(self._spec, self._placed)
            world.warm_up()
            self._world = world

    def _close(self) -> None:
        pass

    def _take(self, wanted: Callable[[Frame], bool], timeout_s: float, missing: str) -> Frame:
        def is_wanted(frame: Frame) -> bool:
            good = wanted(frame)
            if not good:
                self._asked.set()  # its state of the arm is older than the request
            return good

        self._asked.set()
        return super()._take(is_wanted, timeout_s, missing)

    def _grab(self) -> DevicePicture:
        world, preview = self._require_open()
        if self._on_demand:
            self._await_reader()
        self._end.wait(max(0.0, self._due_s - time.monotonic()))
        self._due_s = time.monotonic() + self._period_s
        try:
            state = self._pose()
            self.state = world.move(state.pose, state.time_s)
        except (ContactError, DeviceError) as error:
            self._end.wait(RETRY_S)
            self._asked.set()
            raise ReadFailed(str(error)) from error
        light = preview.render(self.state)
        self._drawn += 1
        rng = np.random.default_rng((self._seed, self._drawn))
        image = expose(light, self._spec.capture, rng, origin_px=preview.window_px[:2])
        return DevicePicture(steady(image, self._spec.response, rng), state.time_s)

    def _pose(self) -> ArmState:
        """The arm's newest state. A camera that waits for its arm reports when the arm is lost and when it is back."""
        lost = False
        while True:
            try:
                state = self._arm()
            except DeviceError as error:
                if not self._waits_for_arm or self._end.is_set():
                    raise
                if not lost:
                    LOG.warning("%s: waits for its arm: %s", self.name, error)
                lost = True
                self._end.wait(RETRY_S)
            else:
                if lost:
                    LOG.warning("%s: its arm is back", self.name)
                return state

    def _require_open(self) -> tuple[World, Preview]:
        """The objects that ``_open`` made; raises ``DeviceNotConnectedError`` before it."""
        if self._world is None or self._preview is None:
            raise DeviceNotConnectedError(f"{self.name}: not connected; call connect() first")
        return self._world, self._preview

    def _await_reader(self) -> None:
        """Wait until a reader asks for a frame. A later reader gets a frame that is drawn later."""
        while not (self._asked.wait(ASKED_S) or self._end.is_set()):
            pass
        self._asked.clear()

    def _finish(self, image: np.ndarray) -> np.ndarray:
        if self._recording is None:
            return image
        return record(image, self._recording, origin_px=self._require_open()[1].window_px[:2])


def preview_of(spec: SensorSpec, form: Form) -> Preview:
    """The preview of the part of the raw frame that a form needs."""
    return Preview(spec, window_px=spec.recording.crop_px if form == Form.PROCESSED and spec.recording is not None else None)


def steady(image: np.ndarray, response: ResponseSpec, rng: np.random.Generator) -> np.ndarray:
    """A frame with at least the noise of a real sensor, for a specified response without noise."""
    if response.read_noise or response.shot_noise:
        return image
    return np.clip(np.rint(image + STEADY_SD * rng.standard_normal(image.shape, np.float32)), 0, 255).astype(np.uint8)
