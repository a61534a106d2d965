"""The studio's mode 'Live': a camera with its estimates and, if there is one, an arm that is only read until it is armed."""

import os
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from hardware.arms.open_arm import kind_of, open_arm
from hardware.cameras.source import FrameSource, open_camera
from hardware.errors import DeviceError, on_error
from hardware.live.live import LiveSession, estimate_line
from hardware.safety.decide import load_limits
from hardware.safety.eyes import FreshFrames
from hardware.safety.safe_arm import SafeArm, try_each
from hardware.workcell.build import check_standing
from scenes.sensor import SensorSpec
from twin.errors import FrameError, TwinError, format_count
from twin.estimate import Estimate, PinsAlone, SensorModel, pins_in
from twin.pins import Pipeline
from twin.pins.check import Grade, examine
from twin.records.session import SessionWriter
from twin.studio.modes.mode import PageMode
from twin.studio.modes.twin_mode import MODEL_LOADING, TwinMode
from twin.studio.page import LineChart, LiveFrame, StudioPage, chart_values, frame_numbers, frame_pictures, put
from twin.studio.pictures import badge, numbers_html, paragraph
from twin.studio.studio import LIVE, StudioPlan
from twin.types import Frame

# Speed, mm/s and deg/s, of an arm that the page moves. It is slow, so that a person can watch it.
SLOW_MM_S, SLOW_DEG_S = 10.0, 10.0
# Longest wait, s, for the last frame at the end of a feed.
END_S = 10.0
NUDGES = ("x -1", "x +1", "y -1", "y +1", "z -1", "z +1")
"""Moves that an armed arm can be given, mm in its base frame."""


class WatchedArm:
    """An arm that is shown. It moves only while it is armed, within its limits, slowly, and while the camera gives fresh frames.

    Without frames it makes its last steps again, backwards.

    Parameters
    ----------
    text : str
        Text for ``open_arm``.
    source : FrameSource, optional
        The camera. Without one the arm does not move.
    pipeline : Pipeline, optional
        Finds the pins of the sensor in the camera's frames.

    Attributes
    ----------
    armed : bool
        Whether the page may move the arm.

    Raises
    ------
    DeviceError
        There is no such arm, or no limits are known for its kind.
    """

    def __init__(self, text: str, source: FrameSource | None = None, pipeline: Pipeline | None = None) -> None:
        self._arm = SafeArm(open_arm(text), load_limits(kind_of(text)))
        self.name, self.armed = self._arm.name, False
        self._moves = threading.Lock()
        self._source, self._pipeline = source, pipeline
        self._eyes = FreshFrames(self._arm, source) if source is not None else None
        self._steps: list[tuple[int, float]] = []  # axis and length of the steps from the pose at which it was armed

    def connect(self) -> None:
        """Open the connection. Nothing moves."""
        self._arm.connect()

    def words(self) -> str:
        """The arm's pose and state, as text."""
        try:
            state = self._arm.state()
        except DeviceError as error:
            return str(error)
        pose = " ".join(f"{value:+.1f}" for value in state.pose)
        kind = state.error or ("moving" if state.moving else "enabled" if state.enabled else "disabled")
        return f"{self.name}: {kind}, at {pose} (mm, deg)"

    def limits(self) -> str:
        """The arm's limits once it is armed, as text."""
        limits = self._arm.limits
        box = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", limits.box_mm, strict=True))
        slow = min(SLOW_MM_S, limits.linear_mm_s)
        return f"tool within {box} mm, {slow:g} mm/s, one step at a time; it is disabled when the studio ends"

    def arm(self) -> list[str]:
        """Check the camera and the arm's place, enable the arm, and set a low speed. Returns what was checked, one line for each part.

        Raises
        ------
        DeviceError
            There is no camera, it does not show the sensor's pins, or the arm stands outside its limits. The arm stays disabled.
        """
        if self._source is None or self._pipeline is None:
            raise DeviceError(f"{self.name}: moves only with a camera; connect one")
        checked = check_standing(self._source, self._arm, self._pipeline)
        self._steps.clear()
        self._arm.enable()
        self._arm.set_speed(SLOW_MM_S, SLOW_DEG_S)
        self.armed = True
        return checked

    def disarm(self) -> None:
        """Stop and disable the arm. Both are tried."""
        self.armed = False
        if failed := try_each(stop=self._arm.stop, disable=self._arm.disable):
            raise DeviceError(f"{self.name}: {'; '.join(failed)}; use its own stop button")

    def nudge(self, axis: int, by_mm: float) -> None:
        """Move the tool along an axis of the base frame.

        Raises
        ------
        DeviceError
            The arm is not armed, is already moving, its limits forbid the move, or the camera gives no fresh frame.
        """
        if not self.armed or self._eyes is None:
            raise DeviceError(f"{self.name}: read only; arm it first")
        if not self._moves.acquire(blocking=False):
            raise DeviceError(f"{self.name}: is already moving; wait until it stops")
        try:
            target = np.array(self._arm.state().pose, float)
            target[axis] += by_mm
            move = partial(self._arm.move_linear, target)
            if self._steps and self._steps[-1] == (axis, -by_mm):  # the way it came needs no frame
                move()
                self._steps.pop()
            else:
                with self._eyes.watching():
                    self._eyes.stand()
                    self._eyes.move(move)
                self._steps.append((axis, by_mm))
        finally:
            self._moves.release()

    def emergency_stop(self) -> None:
        """Stop the arm and cut its power."""
        self.armed = False
        self._arm.emergency_stop()

    def close(self) -> None:
        """Disarm the arm if it is armed, and close the connection."""
        try:
            if self.armed:
                self.disarm()
        finally:
            self._arm.disconnect()


def require_feed(camera: str, arm: str, recording: str, sensor: SensorSpec) -> None:
    """Refuse texts for camera, arm or recording that can't be valid; "" stands for none. Nothing is connected.

    Raises
    ------
    DeviceError, FrameError
        There is no such device or recording, or its frames are not the sensor's.
    """
    if camera:
        open_camera(camera, sensor)
    if arm:
        WatchedArm(arm)
    if recording and not os.path.exists(recording):  # its content is checked when it is opened
        raise FrameError(f"`recording` {recording}: no such folder; give a recording")


class CameraFeed:
    """A camera, its estimates, and an arm.

    Parameters
    ----------
    camera : str
        Text for ``open_camera``.
    arm : str
        Text for ``open_arm``; "" for none.
    sensor : SensorSpec
    model : SensorModel or None
        Without one only the pins are found.
    lacking : str
        Why there is no model.

    Raises
    ------
    TwinError
        There is no such camera or arm, or the frames are not the model's.
    """

    def __init__(self, camera: str, arm: str, sensor: SensorSpec, model: SensorModel | None, lacking: str = "") -> None:
        self._source = open_camera(camera, sensor, None if model is None else model.form)
        model = PinsAlone(sensor, self._source.form, lacking) if model is None else model.seeking_rest()
        model.check(sensor, self._source.form)
        self.model = model
        self.pipeline = Pipeline(model.sensor, model.form, model.pipeline.reference)  # a separate one for the page's thread
        self.robot = WatchedArm(arm, self._source, model.pipeline) if arm else None
        self.name = self._source.name + (f" and {self.robot.name}" if self.robot else "")
        self._session = LiveSession(self._source, model)
        self.ended = ""  # why no more frames come
        self._writer: SessionWriter | None = None
        self._writing, self._end = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, on_frame: Callable[[LiveFrame], None], on_end: Callable[[str], None]) -> None:
        """Connect camera and arm, and deliver frames from a thread.

        Raises
        ------
        TwinError
            The camera or the arm can't be connected; then neither stays connected.
        """
        if self.robot is not None:
            self.robot.connect()
        with on_error(self._close_arm):
            self._source.connect()

        def deliver(frame: Frame, estimate: Estimate) -> None:
            with self._writing:
                if self._writer is not None:
                    self._writer.append(frame, estimate_line(estimate) | {"time_s": time.monotonic()})
            on_frame(LiveFrame(frame, estimate, tuple(self._session.lines(estimate)[1:])))

        def run() -> None:
            try:
                self._session.on_estimate = deliver
                self._session.run(going=lambda: not self._end.is_set())
                if self._end.is_set():
                    return
                self.ended = f"{self.name}: has ended"
            except Exception as error:  # any error must be reported, because otherwise the picture would just stand still
                self.ended = str(error) if isinstance(error, TwinError) else f"{self.name}: ended by a fault of this program ({error!r})"
            on_end(self.ended)

        self._thread = threading.Thread(target=run, name="studio-camera", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End. The arm is released first. All parts are released, even if one fails.

        Raises
        ------
        DeviceError
            A part failed.
        """
        self._end.set()
        failed = try_each(arm=self._close_arm, frames=self._join, recording=self.end_record, camera=self._source.disconnect)
        if failed:
            raise DeviceError(f"{self.name}: {'; '.join(failed)}")

    def record(self, folder: Path) -> None:
        """Store every frame and estimate from now on, as ``twin live --record`` does.

        Raises
        ------
        DeviceError
            The folder is not empty.
        """
        about = {"sensor": self.model.sensor.name, "form": str(self._source.form), "camera": self._source.name, "model": "studio"}
        with self._writing:
            self._writer = SessionWriter(folder, about)

    def end_record(self) -> str:
        """End the recording; returns what was written, in words."""
        with self._writing:
            writer, self._writer = self._writer, None
        if writer is None:
            return "nothing was recorded"
        writer.__exit__(None, None, None)
        return f"wrote {writer.folder} ({format_count(writer.count, 'frames')})"

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(END_S)

    def _close_arm(self) -> None:
        if self.robot is not None:
            self.robot.close()


class LiveMode(PageMode):
    """The mode 'Live'.

    Parameters
    ----------
    page : Page
    twin : TwinMode
        The mode whose model is used.
    plan : StudioPlan
        It has the folder for sessions, and the texts for camera and arm that are offered at first.
    """

    title = LIVE

    def __init__(self, page: StudioPage, twin: TwinMode, plan: StudioPlan) -> None:
        super().__init__(page)
        self._twin, self._out = twin, plan.out
        self._feed: CameraFeed | None = None
        self._connecting = threading.RLock()  # the page calls from many threads, and a feed that is forgotten would keep its arm
        self._health: list[str] = []
        self._last: LiveFrame | None = None
        self._shots = self.newest(self._show, "live")
        gui = page.gui
        with self.folder:
            self._camera = gui.add_text("camera", plan.camera, hint="a number, /dev/videoN, http://..., a folder or a video")
            self._arm = gui.add_text("arm", plan.arm, hint="simulated, mg400:ADDRESS, magician:PORT, or empty")
            page.button("Connect", self.connect)
            page.button("Disconnect", self.disconnect)
            self._record = gui.add_checkbox("record", False)
            page.button("Check the sensor's health", self.check_health)
            page.button("EMERGENCY STOP", self.emergency_stop, color="red", hint="stops the arm and cuts its power, armed or not")
            self._armed = gui.add_checkbox("armed: the page may move the arm", False)
            self._limits = gui.add_html("")
            self._nudges = nudges = gui.add_button_group("move, mm", NUDGES, visible=False)
        self._record.on_update(page.guard(self._toggle_record))
        self._armed.on_update(page.guard(self._toggle_armed))
        nudges.on_click(page.guard(lambda: self._nudge(nudges.value)))
        gui.add_command("Emergency stop of the arm", hotkey="space", modifier="shift").on_trigger(page.guard(self.emergency_stop))
        self._chart = LineChart(page, "live estimates")
        self.charts = (self._chart,)

    def stop(self) -> None:
        """End, and release camera and arm."""
        self.disconnect()
        super().stop()

    def show(self) -> None:
        """Show the camera. If the command named a camera, it is connected now."""
        self._page.show_nothing("Give a camera (a number, /dev/videoN, http://..., a folder or a video) and press 'Connect'.")
        with self._connecting:
            absent = self._feed is None and bool(self._camera.value)
            if absent:
                self._page.guard(self.connect)(self)
        if not absent and self._last is not None:  # this frame came before the mode was entered, or after it was left
            self._shots.give(self._last)

    def connect(self) -> None:
        """Connect the camera and the arm that the user named.

        Raises
        ------
        TwinError
            There is no model, camera or arm of that name.
        """
        with self._connecting:
            self.disconnect()
            if not self._camera.value.strip():
                raise TwinError("give a camera first: a number, /dev/videoN, http://..., a folder or a video")
            contact, lacking = self._twin.contact, self._twin.model_note
            if contact.model is None and lacking == MODEL_LOADING:
                raise TwinError(f"{MODEL_LOADING}; press 'Connect' again in a moment")
            feed = CameraFeed(self._camera.value.strip(), self._arm.value.strip(), contact.setup.sensor, contact.model, lacking)
            self._feed = feed
            feed.start(self._shots.give, self._report_end)
            arm = "" if feed.robot is None else f"{feed.robot.name}: {feed.robot.limits()}"
            self._limits.content = numbers_html(paragraph(arm, "note"))

    def disconnect(self) -> None:
        """Release camera and arm."""
        with self._connecting:
            feed, self._feed, self._last = self._feed, None, None
            try:
                if feed is not None and self._record.value:
                    self._page.say(feed.end_record())
            finally:  # even if the recording can't be ended, the arm does not stay armed
                for control in (self._record, self._armed):
                    put(control, False)
                self._nudges.visible = False
                if feed is not None:
                    feed.stop()

    def _report_end(self, why: str) -> None:
        self.complain(why)
        if self._last is not None:
            self._shots.give(self._last)

    def emergency_stop(self) -> None:
        """Stop the arm. This is never refused."""
        self._robot().emergency_stop()
        put(self._armed, False)
        self._nudges.visible = False
        self._page.say("The arm was stopped and its power cut. Look at it, then arm it again.", bad=True)

    def check_health(self) -> None:
        """Show the sensor's condition, evaluated from the newest frame."""
        if self._last is None or self._feed is None:
            raise TwinError("there is no frame yet; connect a camera first")
        findings = examine([self._last.frame], self._feed.model.sensor)
        ill = [f"{finding.text} {finding.remedy}".strip() for finding in findings if finding.verdict is not Grade.HEALTHY]
        self._health = ill or [f"All {len(findings)} checks are good."]
        self._shots.give(self._last)  # a source that has ended gives no other frame

    def _toggle_record(self) -> None:
        if self._feed is None:
            put(self._record, False)
            raise TwinError("connect a camera first")
        if self._record.value:
            self._feed.record(self._out / time.strftime("session-%Y%m%d-%H%M%S"))
        else:
            self._page.say(self._feed.end_record())

    def _robot(self) -> WatchedArm:
        if self._feed is None or self._feed.robot is None:
            put(self._armed, False)
            raise TwinError("no arm is connected")
        return self._feed.robot

    def _toggle_armed(self) -> None:
        robot = self._robot()
        try:
            if self._armed.value:
                self._page.say("; ".join(robot.arm()))
            else:
                robot.disarm()
        finally:
            put(self._armed, robot.armed)
            self._nudges.visible = robot.armed

    def _nudge(self, text: str) -> None:
        axis, _, by = text.partition(" ")
        self._robot().nudge("xyz".index(axis), float(by))

    def _show(self, shot: LiveFrame) -> None:
        feed, self._last = self._feed, shot
        if feed is None or not self._active:
            return
        seen = pins_in(shot.frame, shot.estimate, feed.pipeline)
        pictures = frame_pictures(feed.model.sensor, feed.pipeline.reference, shot.frame, seen)
        robot = feed.robot
        numbers = [
            badge("ended" if feed.ended else "live", "moving") + (badge("recording", "moving") if self._record.value else ""),
            paragraph(feed.ended, "stop") or paragraph(feed.name, "note"),
            *frame_numbers(shot, seen),
            "" if robot is None else badge("ARMED" if robot.armed else "arm: read only", "moving" if robot.armed else ""),
            "" if robot is None else paragraph(robot.words(), "note"),
            *(paragraph(line, "said") for line in self._health),
        ]
        label = f"live {shot.frame.form} frame {shot.frame.sequence}"
        self.put_up(pictures, label, numbers, also=lambda: self._chart.add(chart_values(shot.estimate)))
