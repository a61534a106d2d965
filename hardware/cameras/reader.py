"""Common part of all live sources: a background reader that keeps the newest frame and reports faults.

``capture`` converts a camera's picture to a sensor's frame: it checks the size, makes the picture gray for a mono camera, and thresholds
it for the recordings' form.
"""

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hardware.arms.awake import awake_s
from hardware.errors import Connection, DeviceError, StaleDataError, on_error
from scenes.sensor import SensorSpec
from twin.camera.capture import record
from twin.errors import ErrorsAs, format_count
from twin.frames.forms import form_named, frame_size, gray_levels
from twin.types import Form, Frame

# Most failed reads in a row. After more of them the reader ends.
MOST_FAILED_READS = 10
# Pause in s before the next attempt.
FAILED_PAUSE_S = 0.2
# A stream counts as frozen if a picture stays the same for this time (s) and this number of times. Pictures of a live sensor differ by
# noise.
FROZEN_S, FROZEN_N = 0.5, 5
# The source is blind if no new picture came for BLIND_S (s) and for BLIND_PERIODS usual times between pictures.
BLIND_S, BLIND_PERIODS = 0.15, 2.5
# Number of times between pictures from which the usual one is known.
RATE_N = 3
# Least difference, s, between the stamps of two pictures.
STAMP_S = 1e-4
# Number of same pictures from which on a picture without noise counts as unchanged.
SAME_N = 3
# Largest stated age, s, of a picture at its arrival. An older picture has a time of another clock, or is useless.
LATE_S = 5.0
# Gray level (0 to 255) that at least one pixel of a picture must reach. Otherwise the picture is black, because the lamps are off.
BLACK_LEVEL = 16
# Longest time, s, to the first picture of a real camera after opening. In addition it may take FIRST_PERIODS periods of its frames.
START_S = 4.0
FIRST_PERIODS = 5
# An outage is longer than this many usual times between pictures, and than this time in s.
OUTAGE_PERIODS, OUTAGE_S = 5.0, 0.25
# Number of newest times between pictures, of which the median is the usual one.
KEPT_PERIODS = 30


@dataclass(frozen=True)
class DevicePicture:
    """A picture from a device.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) uint8
        Gray or RGB.
    time_s : float
        Time of the exposure in ``time.monotonic()`` seconds, as precisely as it is known.
    lost : int
        Number of pictures before this one that the device reports as lost.
    note : str
        What was irregular in its file ("" if nothing).
    again : bool
        Whether the device reports that it sent this picture before.
    """

    image: np.ndarray
    time_s: float
    lost: int = 0
    note: str = ""
    again: bool = False


class ReadFailed(Exception):  # noqa: N818  (no error until it happens too often)
    """A picture could not be read; the reader tries again."""


class TornPicture(ReadFailed):
    """A picture came incomplete or damaged."""


class LiveSource(Connection):
    """Base class of the live sources; see ``hardware.cameras.source.FrameSource`` for the methods.

    Parameters
    ----------
    name : str
    form : Form
        Form of its frames.

    Attributes
    ----------
    arrived : int
        Number of frames from the device so far, including lost ones.
    delivered, dropped : int
        Number of frames that were read, and that nobody read, including those that the device lost.
    fault : str
        The fault of the pictures, in words: frozen, black or late; "" if there is none.
    """

    is_live = True
    notices_still = True  # whether a picture that does not change is a fault
    notices_late = True  # whether a picture that is older than ``LATE_S`` at its arrival is a fault
    streams = True  # whether pictures come unasked
    _spec: SensorSpec | None = None
    _read_last: int  # sequence number of the frame that was read last
    fps = 5.0  # frame rate; if the device does not report one, the slowest useful rate

    def __init__(self, name: str, form: Form) -> None:
        self.name, self.form = name, form_named(form)
        self.failed = 0  # total number of failed reads
        self.on_frame: Callable[[Frame], None] | None = None  # called with each new frame, from the reader's thread
        self._new = threading.Condition()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._reset()

    @property
    def first_frame_s(self) -> float:
        """Longest time from ``connect`` to the first frame."""
        return START_S + FIRST_PERIODS / self.fps

    @abstractmethod
    def _open(self) -> None:
        """Open the device; ``DeviceError`` if there is none."""

    @abstractmethod
    def _close(self) -> None:
        """Release the device; no effect if it is closed."""

    def _interrupt(self) -> None:
        """End a waiting read, if the device can. It is called from another thread than ``_grab``."""

    @abstractmethod
    def _grab(self) -> DevicePicture:
        """The next picture; raises ``ReadFailed`` if there is none."""

    def _finish(self, image: np.ndarray) -> np.ndarray:
        """The picture in the source's form."""
        return capture(image, self._spec, self.form)

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    def notes(self) -> list[str]:
        """Outages, torn and repeated pictures, and irregular files so far, one line each."""
        with self._new:
            outages_s, torn, found = list(self._outages_s), list(self._torn), list(self._notes)
        spent = f"{sum(outages_s):.1f} s in all, the longest {max(outages_s, default=0.0):.1f} s: no new picture came"
        counted = (
            (len(outages_s), f"{format_count(len(outages_s), 'outages of the camera')}, {spent}"),
            (self.lost, f"pictures lost before they arrived: {self.lost}; the camera's numbers have gaps"),
            (self.reopened, f"the camera was opened again {format_count(self.reopened, 'times')}"),
            (len(torn), f"pictures left out, incomplete or damaged: {len(torn)}; the last: {''.join(torn[-1:])}"),
            (self._repeated, f"{self._repeated} of {self.arrived} pictures repeat the one before them"),
        )
        return [*found, *(text for count, text in counted if count)]

    @property
    def same_s(self) -> tuple[float, float] | None:
        """Exposures of the first and the newest of several same pictures, if pictures of this source may repeat; None otherwise."""
        with self._new:
            if self._still is None or self._still[2] < SAME_N or self._frame is None:
                return None
            return (self._still[1], self._frame.time_s) if self._may_repeat(self._still[0]) else None

    def blind(self) -> str:
        with self._new:
            if self._error is not None or self.fault:
                return str(self._error or self.fault)
            if not self.streams:
                return ""
            quiet_s = awake_s() - self._fresh_s
            if len(self._periods_s) < RATE_N and quiet_s < START_S:
                return "has delivered too few pictures so far"
            return "" if quiet_s <= max(BLIND_S, BLIND_PERIODS * self._usual_s()) else f"no new picture for {quiet_s:.1f} s"

    def connect(self) -> None:
        self._require_disconnected()
        self._open()
        self._reset()
        self._end.clear()
        self._thread = threading.Thread(target=self._run, name=f"reader of {self.name}", daemon=True)
        self._thread.start()

    def disconnect(self) -> None:
        if self._thread is None:
            return
        self._end.set()
        self._interrupt()
        self._thread.join(timeout=15.0)
        self._thread = None
        self._close()

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        return self._take(lambda frame: frame.sequence != self._read_last, timeout_s, "no new frame")

    def read_after(self, time_s: float, *, timeout_s: float = 2.0) -> Frame:
        return self._take(lambda frame: frame.time_s > time_s, timeout_s, "no frame exposed since then")

    def read_latest(self, *, max_age_s: float = 0.5) -> Frame:
        frame = self._take(lambda _: True, self.first_frame_s, "no frame at all")
        age_s = time.monotonic() - frame.time_s
        if age_s > max_age_s:
            raise StaleDataError(f"{self.name}: the newest frame is {age_s:.2f} s old (allowed {max_age_s:g} s); check camera and cable")
        return frame

    def _take(self, wanted: Callable[[Frame], bool], timeout_s: float, missing: str) -> Frame:
        deadline = time.monotonic() + timeout_s
        with self._new:
            while True:
                if self._error is not None:
                    raise DeviceError(f"{self.name}: {self._error}") from self._error
                self._require_connected()
                if self.fault:
                    raise DeviceError(f"{self.name}: {self.fault}")
                if self._frame is not None and wanted(self._frame):
                    if self._frame.sequence != self._read_last:
                        self._read_last = self._frame.sequence
                        self.dropped -= 1
                        self.delivered += 1
                    return self._frame
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise TimeoutError(f"{self.name}: {missing} within {timeout_s:g} s")
                self._new.wait(left_s)

    def _reset(self) -> None:
        self._frame: Frame | None = None
        self._error: Exception | None = None
        self.fault = ""
        self._read_last, self.arrived, self.dropped, self.delivered = -1, 0, 0, 0
        self._still: tuple[np.ndarray, float, int] | None = None  # picture, since when, how often
        self._came_s, self._fresh_s, self._stamp_s = 0.0, awake_s(), -np.inf
        self._periods_s: deque[float] = deque(maxlen=KEPT_PERIODS)
        self._outages_s: list[float] = []
        self._torn: list[str] = []
        self._notes: set[str] = set()
        self._repeated = self.lost = self.reopened = 0

    def _run(self) -> None:
        try:
            self._read_pictures()
        except Exception as error:
            with self._new:
                self._error = error
                self._new.notify_all()

    def _read_pictures(self) -> None:
        in_a_row = 0
        while not self._end.is_set():
            try:
                picture = self._grab()
                image = self._finish(picture.image)
            except ReadFailed as failure:
                self.failed += 1
                in_a_row += 1
                if isinstance(failure, TornPicture):
                    with self._new:
                        self._torn.append(str(failure))
                if in_a_row > MOST_FAILED_READS:
                    remedy = "check camera and cable, then connect again"
                    raise DeviceError(f"{in_a_row} reads in a row failed, the last: {failure}; {remedy}") from failure
                continue
            in_a_row = 0
            with self._new:
                self.fault = self._look_at(picture)
                self._look_back(picture)
                self.lost += picture.lost
                self.arrived += 1 + picture.lost
                self.dropped += 1 + picture.lost
                if new := self._is_new(picture):
                    name = f"frame_{self.arrived:06d}.png"
                    self._frame = Frame(image, self.form, name, picture.time_s, self.arrived)
                    if not self.fault:
                        self._fresh_s = awake_s()
                self._new.notify_all()
            if new and (hear := self.on_frame) is not None and self._frame is not None:
                hear(self._frame)

    def _usual_s(self) -> float:
        """Usual time between two pictures."""
        return float(np.median(self._periods_s)) if self._periods_s else 1.0 / self.fps

    def _again(self, open_device: Callable[[], None]) -> None:
        """Open a device that was lost; ``ReadFailed`` after a pause if it can't be opened."""
        failed = ErrorsAs((DeviceError, OSError), lambda error: ReadFailed(str(error)))
        with on_error(lambda: self._end.wait(FAILED_PAUSE_S)), failed:
            open_device()
        self.reopened += 1

    def _may_repeat(self, image: np.ndarray) -> bool:
        """Whether pictures like this one may repeat without a fault: those of the twin, and those that their sender thresholded."""
        camera = None if self._spec is None or self.form is not Form.PROCESSED else self._spec.camera
        return not self.notices_still or (camera is not None and image.shape[1::-1] != (camera.width_px, camera.height_px))

    def _is_new(self, picture: DevicePicture) -> bool:
        """Whether a picture has a new number, a new stamp, and a new content if it can't repeat."""
        repeats = self._still is not None and self._still[2] > 1 and not self._may_repeat(picture.image)
        before_s, self._stamp_s = self._stamp_s, picture.time_s
        return not (repeats or picture.again or picture.time_s - before_s < STAMP_S)

    def _look_back(self, picture: DevicePicture) -> None:
        """Count an outage before this picture, and note what is irregular in it."""
        # a server may send its last picture again when it is asked again
        if self._still is None or self._still[2] == 1 or self._may_repeat(picture.image):
            period_s, self._came_s = time.monotonic() - self._came_s, time.monotonic()
            outage = period_s > max(OUTAGE_S, OUTAGE_PERIODS * self._usual_s())
            if self.arrived:  # the first picture comes when the device is ready
                (self._outages_s if outage else self._periods_s).append(period_s)
        self._notes |= {picture.note} - {""}

    def _look_at(self, picture: DevicePicture) -> str:
        if picture.image.max(initial=0) < BLACK_LEVEL:
            return "the picture is black; check the sensor's lamps and the camera's exposure"
        if self.notices_late and (age_s := time.monotonic() - picture.time_s) > LATE_S:
            remedy = "set the clock of the camera's computer to that of this one, or look for what delays the pictures"
            return f"the picture's time stamp is {age_s:.0f} s old; {remedy}"
        if self._still is None or not np.array_equal(self._still[0], picture.image):
            self._still = (picture.image, picture.time_s, 1)
            return ""
        self._repeated += not self._may_repeat(picture.image)
        image, since_s, count = self._still
        self._still = (image, since_s, count + 1)
        if count + 1 >= FROZEN_N and not self._may_repeat(image) and picture.time_s - since_s >= FROZEN_S:
            return f"the picture has been frozen for {picture.time_s - since_s:.1f} s; unplug the camera and connect it again"
        return ""


def capture(image: np.ndarray, spec: SensorSpec | None, form: Form) -> np.ndarray:
    """A picture (H, W) or (H, W, 3) uint8 RGB as the sensor's frame of a form. Without a sensor the picture is returned unchanged.

    Raises
    ------
    DeviceError
        The picture's size is not that of the sensor's camera.
    FrameError
        There is no such form.
    """
    form = form_named(form)
    if spec is None:
        return image
    size = (spec.camera.width_px, spec.camera.height_px)
    if image.shape[1::-1] != size:
        if form == Form.PROCESSED and image.shape[1::-1] == frame_size(spec, form):
            return gray_levels(image)  # thresholded by the sender
        raise DeviceError(f"delivers {image.shape[1]}x{image.shape[0]}, {spec.name} has {size[0]}x{size[1]}; give the matching sensor")
    if spec.camera.channels == "mono":
        image = gray_levels(image)
    return record(image, spec.recording) if form == Form.PROCESSED and spec.recording is not None else image
