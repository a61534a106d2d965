"""The mode 'Live': a real camera and, if there is one, an arm.

Camera and arm are handed in (``LiveFeed``, ``LiveArm``); this package does not depend on the devices.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from twin.errors import TwinError
from twin.estimate import SensorModel, pins_in
from twin.pins.check import Grade, examine
from twin.pins.pipeline import Pipeline
from twin.studio.live_page import LiveFrame, chart_values, frame_numbers, frame_pictures
from twin.studio.modes.mode import PageMode
from twin.studio.modes.twin_mode import TwinMode
from twin.studio.page import LineChart, StudioPage, put
from twin.studio.pictures import badge, paragraph

NUDGES = ("x -1", "x +1", "y -1", "y +1", "z -1", "z +1")
"""Moves that an armed arm can be given, mm in its base frame."""


class LiveArm(Protocol):
    """An arm that is shown, and that moves only while it is armed."""

    name: str

    @property
    def armed(self) -> bool:
        """Whether the user has armed it."""

    def words(self) -> str:
        """The arm's pose and state, as text."""

    def limits(self) -> str:
        """The arm's limits once it is armed, as text."""

    def arm(self) -> list[str]:
        """Check camera and arm, and enable it. Returns what was checked, as lines of text. Raises ``TwinError`` if a check fails."""

    def disarm(self) -> None:
        """Stop and disable it."""

    def nudge(self, axis: int, by_mm: float) -> None:
        """Move the tool along an axis of the base frame. Raises ``TwinError`` if it is not armed or the limits forbid it."""

    def emergency_stop(self) -> None:
        """Stop it and cut its power, whatever else happens."""


class LiveFeed(Protocol):
    """A camera that delivers frames, with a model that evaluates them."""

    name: str
    model: SensorModel

    @property
    def robot(self) -> LiveArm | None:
        """The arm; None if there is none."""

    def start(self, on_frame: Callable[[LiveFrame], None], on_end: Callable[[str], None]) -> None:
        """Connect, and deliver frames from a thread. When it ends, ``on_end`` is called with the reason."""

    def stop(self) -> None:
        """End, and release camera and arm."""

    def record(self, folder: Path) -> None:
        """Store every frame and estimate from now on in a new folder."""

    def end_record(self) -> str:
        """End the recording; returns what was written, in words."""


FeedOpener = Callable[[str, str, SensorModel], LiveFeed]
"""Function from the user's texts for camera and arm ("" for none) and a model to a feed that is not started yet."""


class LiveMode(PageMode):
    """The mode 'Live'.

    Parameters
    ----------
    page : Page
    twin : TwinMode
        The mode whose model is used.
    open_feed : callable
    out : Path
        Folder for sessions.
    camera, arm : str
        Texts that are offered at first.
    """

    title = "Live"

    def __init__(self, page: StudioPage, twin: TwinMode, open_feed: FeedOpener, out: Path, *, camera: str = "", arm: str = "") -> None:
        super().__init__(page)
        self._twin, self._open_feed, self._out = twin, open_feed, out
        self._feed: LiveFeed | None = None
        self._connecting = threading.RLock()  # the page calls from many threads, and a feed that is forgotten would keep its arm
        self._pipeline: Pipeline | None = None
        self._health: list[str] = []
        self._last: LiveFrame | None = None
        self._shots = self.newest(self._show, "live")
        gui = page.gui
        with self.folder:
            self._camera = gui.add_text("camera", camera, hint="a number, /dev/videoN, http://..., a folder or a video")
            self._arm = gui.add_text("arm", arm, hint="simulated, mg400:ADDRESS, magician:PORT, or empty")
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

    def stop(self) -> None:
        """End, and release camera and arm."""
        self.disconnect()
        super().stop()

    def show(self) -> None:
        """Show the camera. If the command named a camera, it is connected now."""
        self._page.show_nothing("Give a camera and press 'Connect'.")
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
            model = self._twin.contact.model
            if model is None:
                raise TwinError("there is no model of this sensor yet; wait until it is loaded, or give one with --model")
            if not self._camera.value.strip():
                raise TwinError("give a camera first: a number, /dev/videoN, http://..., a folder or a video")
            feed = self._open_feed(self._camera.value.strip(), self._arm.value.strip(), model)
            self._pipeline = Pipeline(feed.model.sensor, feed.model.form, feed.model.pipeline.reference)
            self._feed = feed
            feed.start(self._shots.give, self.complain)
            self._limits.content = "" if feed.robot is None else paragraph(f"{feed.robot.name}: {feed.robot.limits()}", "note")

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

    def emergency_stop(self) -> None:
        """Stop the arm. This is never refused."""
        if self._feed is None or self._feed.robot is None:
            raise TwinError("no arm is connected")
        self._feed.robot.emergency_stop()
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

    def _toggle_record(self) -> None:
        if self._feed is None:
            put(self._record, False)
            raise TwinError("connect a camera first")
        if self._record.value:
            self._feed.record(self._out / time.strftime("session-%Y%m%d-%H%M%S"))
        else:
            self._page.say(self._feed.end_record())

    def _robot(self) -> LiveArm:
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
        feed, pipeline = self._feed, self._pipeline
        self._last = shot
        if feed is None or pipeline is None or not self._active:
            return
        seen = pins_in(shot.frame, shot.estimate, pipeline)
        pictures = frame_pictures(feed.model.sensor, pipeline.reference, shot.frame, seen)
        robot = feed.robot
        numbers = [
            badge("live", "moving") + (badge("recording", "moving") if self._record.value else ""),
            paragraph(feed.name, "note"),
            *frame_numbers(shot, seen),
            "" if robot is None else badge("ARMED" if robot.armed else "arm: read only", "moving" if robot.armed else ""),
            "" if robot is None else paragraph(robot.words(), "note"),
            *(paragraph(line, "said") for line in self._health),
        ]
        label = f"live {shot.frame.form} frame {shot.frame.sequence}"
        self.put_up(pictures, label, numbers, also=lambda: self._chart.add(chart_values(shot.estimate)))
