"""Sources of frames: their protocol (``FrameSource``), frames from disk, cameras, and the source that a user's text for ``camera`` names.

OpenCV reads USB cameras (on Linux through Video4Linux) and video streams (RTSP and whatever else FFmpeg opens). Cyclone DDS reads ROS 2
topics, raw (``sensor_msgs/Image``) or compressed (``sensor_msgs/CompressedImage``). Times are ``time.monotonic()`` seconds.
"""

import logging
import os
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Protocol
from urllib.parse import parse_qsl

import cv2
import numpy as np

from hardware.cameras.mjpeg import SILENT_S, MjpegCamera, decode_picture, on_own_clock, without_secrets
from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed, TornPicture
from hardware.errors import Connection, DeviceError
from hardware.ros2.dds import Participant, Reader, domain_id
from scenes.files import LONGEST_PATH, quote
from scenes.plugins import others
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs
from twin.frames import Recording, open_recording
from twin.frames.forms import frame_size
from twin.frames.images import overheard
from twin.records.ros2 import NS_PER_S, decode
from twin.records.session import Session, is_session
from twin.types import Form, Frame

LOG = logging.getLogger(__name__)
# Folder in which the Linux kernel lists its cameras.
SYSFS_CAMERAS = Path("/sys/class/video4linux")
# Value of Video4Linux's exposure mode for manual exposure (3 is automatic).
MANUAL_EXPOSURE = 1
# A buffer time that differs from the present time by more than this (s) does not come from the monotonic clock and is not used.
CLOCK_SLACK_S = 5.0
# Number of pictures that the driver may queue. With 1, the next picture is always the newest.
BUFFERS = 1
# Requested settings: size and rate of the pictures if no sensor tells the size, and the exposure in 100 us units.
WIDTH_PX, HEIGHT_PX, FPS, EXPOSURE = 640, 480, 30.0, 78.0
# Settings that a user may request, with OpenCV's keys, and the driver's units in one of the user's (exposure: ms; others: the same).
SETTINGS = {"exposure": (cv2.CAP_PROP_EXPOSURE, 10.0), "gain": (cv2.CAP_PROP_GAIN, 1.0), "focus": (cv2.CAP_PROP_FOCUS, 1.0)}
# Pictures that a camera gets to apply a setting, and pictures that are then measured.
SETTLE_N, MEASURED_N = 6, 4
# A setting acts if half of it changes the pictures by this many standard deviations from picture to picture, and by this share.
ACTS_SD, ACTS_SHARE = 4.0, 0.02
# Begin of a text for a video stream over http, which is otherwise read as a stream of pictures.
FFMPEG = "ffmpeg:"
# Longest time, ms, to open a video stream, which begins with a complete picture.
OPEN_MS = 8000
PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
"""Messages with a picture."""
CHANNELS = {"mono8": (1, 1), "8UC1": (1, 1), "rgb8": (3, 1), "bgr8": (3, -1), "8UC3": (3, -1), "rgba8": (4, 1), "bgra8": (4, -1)}
"""Encodings of raw pictures: their channels, and 1 for RGB or -1 for BGR."""


class FrameSource(Protocol):
    """A live camera, a stream, a recording or the twin.

    A background reader keeps the newest frame. ``Frame.time_s`` is the time of the exposure as far as it is known: the kernel's buffer
    time, or the time of arrival. ``Frame.sequence`` counts the device's frames; it includes lost frames if the device reports them. Every
    read raises ``DeviceError`` if the pictures of a live source are frozen, black or late, or if its reader has ended after too many
    failed reads.
    """

    name: str
    form: Form
    is_live: bool  # a recording waits for its reader, a live source does not
    streams: bool  # whether frames come unasked: not from a recording, nor from a twin that draws on demand

    @property
    def first_frame_s(self) -> float:
        """Longest time from ``connect`` to the first frame."""

    @property
    def is_connected(self) -> bool:
        """Whether frames can be read."""

    @property
    def dropped(self) -> int:
        """Number of frames that nobody read, including those that the device lost."""

    @property
    def fault(self) -> str:
        """What is wrong with the pictures ("" if nothing)."""

    @property
    def same_s(self) -> tuple[float, float] | None:
        """Exposures (s) of the first and the newest of several equal pictures; None if the picture changes, or could not stay equal."""

    def blind(self) -> str:
        """Reason why there is no fresh frame; "" if there is one. A fresh frame is new, usable, and at most 3 periods or 0.2 s old."""

    def notes(self) -> list[str]:
        """What was irregular in the frames so far, one line each: pauses, damaged, repeated and unreadable frames."""

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def __enter__(self) -> "FrameSource": ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None: ...

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        """The newest frame that was not read yet. Waits for one if necessary; ``TimeoutError`` if none comes.

        Raises
        ------
        EOFError
            A recording is at its end.
        """

    def read_latest(self, *, max_age_s: float = 0.5) -> Frame:
        """The newest frame, even if it was read before; ``StaleDataError`` if it is older than ``max_age_s``."""

    def read_after(self, time_s: float, *, timeout_s: float = 2.0) -> Frame:
        """The first frame that was exposed after ``time_s``; ``TimeoutError`` if none comes."""


def no_frame() -> AbstractContextManager[None]:
    """Context that converts the errors of a camera that gives no frame to a ``DeviceError`` with the remedy."""
    return ErrorsAs((TimeoutError, EOFError), lambda error: DeviceError(f"{error}; check the camera"))


def await_frame(source: FrameSource, *, timeout_s: float | None = None, after_s: float | None = None) -> Frame:
    """The next frame, or the first one that was exposed after ``after_s``. By default the wait lasts at most ``first_frame_s``.

    Raises
    ------
    DeviceError
        No frame comes.
    """
    timeout_s = source.first_frame_s if timeout_s is None else timeout_s
    with no_frame():
        return source.read(timeout_s=timeout_s) if after_s is None else source.read_after(after_s, timeout_s=timeout_s)


class RecordedSource(Connection):
    """Frames of a folder, a recording, a video or a session. They wait for their reader, and have an end.

    Parameters
    ----------
    name : str
    frames : Recording or Session
    notes : callable
        Irregularities in the frames read so far, one line each.
    """

    is_live = False
    first_frame_s = 0.0
    dropped = 0
    fault = ""
    streams = False  # frames come when they are read
    same_s = None

    def __init__(self, name: str, frames: Recording | Session, notes: Callable[[], list[str]]) -> None:
        self.name, self.form, self.notes, self._frames = name, frames.form, notes, frames
        self._left: Iterator[Frame] | None = None
        self._newest: Frame | None = None

    def blind(self) -> str:
        return ""

    @property
    def is_connected(self) -> bool:
        return self._left is not None

    def connect(self) -> None:
        self._require_disconnected()
        self._left, self._newest = iter(self._frames), None

    def disconnect(self) -> None:
        self._left = None

    def read(self, *, timeout_s: float = 1.0) -> Frame:
        self._require_connected()
        frame = next(self._left or iter(()), None)
        if frame is None:
            raise EOFError(f"{self.name}: the recording is at its end")
        self._newest = frame
        return frame

    def read_latest(self, *, max_age_s: float = 0.5) -> Frame:
        """The frame that was read last, or the first one. A recording has no age."""
        return self.read() if self._newest is None or self._left is None else self._newest

    def read_after(self, time_s: float, *, timeout_s: float = 2.0) -> Frame:
        """The next frame, whatever its time is, because a recording waits for its reader."""
        return self.read()


class SessionSource(RecordedSource):
    """A session's frames in the order of its steps. A frame that several steps used is given once for each.

    Parameters
    ----------
    folder : path

    Raises
    ------
    FrameError
        As for ``twin.records.session.Session``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.session = Session(folder)
        super().__init__(str(folder), self.session, lambda: self.session.notes)


class Ros2Camera(LiveSource):
    """A ROS 2 topic with pictures.

    The time of exposure is the header's stamp, or the arrival if the stamp is 0 or of another clock.

    Parameters
    ----------
    topic : str
    spec : SensorSpec, optional
    form : Form
    """

    def __init__(self, topic: str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        self._topic, self._spec = f"/{topic.strip('/')}", spec
        super().__init__(f"ros2:{self._topic}", form)
        self._participant: Participant | None = None
        self._reader: Reader | None = None
        self._kind = ""

    def _open(self) -> None:
        participant = Participant()
        found = participant.topics()
        self._kind = found.get(self._topic, "")
        if self._kind not in PICTURES:
            there = ", ".join(topic for topic, kind in found.items() if kind in PICTURES) or "none"
            why = f"its messages are {quote(self._kind)}, no pictures" if self._kind else f"nobody publishes it in domain {domain_id()}"
            raise DeviceError(f"{self.name}: {why}; topics with pictures: {there}; ROS_DOMAIN_ID sets the domain")
        self._participant, self._reader = participant, participant.reader(self._topic, self._kind)

    def _close(self) -> None:
        self._participant = self._reader = None

    def _grab(self) -> DevicePicture:
        reader, begun_s = self._reader, time.monotonic()
        while reader is not None and not self._end.is_set() and time.monotonic() - begun_s < SILENT_S:
            if taken := reader.take():
                return self._picture(taken[-1], len(taken) - 1)
        gone = "nobody publishes it any more" if reader is not None and not reader.served else f"nothing came for {SILENT_S:g} s"
        raise ReadFailed(gone)

    def _picture(self, data: bytes, lost: int) -> DevicePicture:
        with ErrorsAs(ValueError, lambda error: TornPicture(str(error))):
            message = decode(self._kind, data)
        stamp = message["header"]["stamp"]
        image, note = decode_picture(message["data"].tobytes()) if "format" in message else (_raw(message), "")
        return DevicePicture(image, on_own_clock(stamp["sec"] + stamp["nanosec"] / NS_PER_S), lost, note)


def _raw(message: dict) -> np.ndarray:
    """The picture, gray (H, W) or RGB (H, W, 3), of a message ``sensor_msgs/Image``.

    Raises
    ------
    DeviceError
        Its encoding is not known.
    TornPicture
        It has fewer bytes than its size needs.
    """
    encoding, height, width, step = (message[key] for key in ("encoding", "height", "width", "step"))
    if encoding not in CHANNELS:
        raise DeviceError(f"pictures in the encoding {quote(encoding)}; publish {', '.join(CHANNELS)}, or the compressed topic")
    channels, order = CHANNELS[encoding]
    data = message["data"]
    if not height or step < width * channels or data.size < height * step or not width:
        raise TornPicture(f"an incomplete picture ({data.size} bytes for {width} x {height}, {encoding})")
    rows = data[: height * step].reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    return rows[..., 0].copy() if channels == 1 else rows[..., :3][..., ::order].copy()


class OpencvCamera(LiveSource):
    """Base class of cameras that OpenCV reads."""

    _remedy: str
    _device: cv2.VideoCapture | None = None

    @abstractmethod
    def _capture(self) -> cv2.VideoCapture:
        """The opened device, or one that could not be opened."""

    def _open(self) -> None:
        with overheard():
            device = self._capture()
        if not device.isOpened():
            raise DeviceError(f"{self.name}: can't be opened; {self._remedy}")
        self._device = device

    def _close(self) -> None:
        if self._device is not None:
            self._device.release()
            self._device = None

    def _grab(self) -> DevicePicture:
        if self._device is None:
            self._again(self._open)
        device = self._device
        if device is None:  # another thread closed it
            raise ReadFailed("the camera was closed")
        good, image = device.read()
        if not good or image is None or not image.size:
            self._close()  # the camera may be unplugged: it must be opened again
            raise ReadFailed("no picture")
        return DevicePicture(image if image.ndim == 2 else image[..., ::-1].copy(), self._exposed_s(device))

    def _exposed_s(self, device: cv2.VideoCapture) -> float:
        return time.monotonic()


class UvcCamera(OpencvCamera):
    """A USB camera of this machine.

    Parameters
    ----------
    node : int or str
        Number, device node or port (``usb:1-1.2``) of the camera, then ``?exposure=7.8&gain=4&focus=120`` for settings. The exposure is in
        ms, the others are in the camera's units. Whether the pictures change by a setting is measured when the camera is opened.
    spec : SensorSpec, optional
    form : Form

    Raises
    ------
    DeviceError
        A setting is not known, or no number.
    """

    _remedy = "'twin doctor' lists the cameras and their ports; check whether another program uses it"

    def __init__(self, node: int | str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        self._node, _, settings = str(node).partition("?")
        super().__init__(f"camera {self._node}", form)
        self._spec = spec
        self.fps = FPS
        expected = f"expected {', '.join(SETTINGS)} and numbers of 0 or more, as in ?exposure=7.8&gain=4"
        with ErrorsAs(ValueError, lambda _: DeviceError(f"{self.name}: settings {quote(settings)}: {expected}")):
            self._settings = {name: float(value) for name, value in parse_qsl(settings, strict_parsing=True)} if settings else {}
            if not self._settings.keys() <= SETTINGS.keys() or not all(0 <= value < np.inf for value in self._settings.values()):
                raise ValueError

    def _capture(self) -> cv2.VideoCapture:
        node = node_at(self._node) if self._node.startswith("usb:") else self._node
        device = cv2.VideoCapture(int(node) if node.isdecimal() else node, cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY)
        if device.isOpened():
            size = (self._spec.camera.width_px, self._spec.camera.height_px) if self._spec else (WIDTH_PX, HEIGHT_PX)
            self.fps = apply_settings(device, *size)
            self.ignored = measure_settings(device, self._settings)
            for line in self.ignored:
                LOG.warning("%s: %s", self.name, line)
        return device

    def notes(self) -> list[str]:
        return [*getattr(self, "ignored", ()), *super().notes()]

    def _exposed_s(self, device: cv2.VideoCapture) -> float:
        return exposed_s(device.get(cv2.CAP_PROP_POS_MSEC))


class VideoCamera(OpencvCamera):
    """A video stream that OpenCV's FFmpeg opens: ``rtsp://``, ``udp://``, ``tcp://``, ..., or ``ffmpeg:`` and any address.

    The time of a picture is that of its arrival. A login in the address is never printed.

    Parameters
    ----------
    url : str
    spec : SensorSpec, optional
    form : Form
    """

    _remedy = "check the address, the login (rtsp://NAME:PASSWORD@HOST/...) and whether the camera streams"

    def __init__(self, url: str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        super().__init__(without_secrets(url), form)
        self._url, self._spec = url.removeprefix(FFMPEG), spec

    def _capture(self) -> cv2.VideoCapture:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1e3 * SILENT_S)]
        return cv2.VideoCapture(self._url, cv2.CAP_FFMPEG, limits)


def port_of(node: Path) -> str:
    """The USB port (``usb:1-1.2``) of a camera in the kernel's list; "" if it has none. Equal cameras differ by it."""
    interface = (node / "device").resolve().name
    return f"usb:{interface.partition(':')[0]}" if interface.partition(":")[2] else ""


def node_at(port: str, sysfs: Path = SYSFS_CAMERAS) -> str:
    """The device node of the camera at a USB port (``usb:1-1.2``); its first one, as others do not give pictures.

    Raises
    ------
    DeviceError
        There is no camera at the port.
    """
    ports: dict[str, str] = {}
    for entry in sorted(sysfs.glob("video*"), key=lambda entry: int(entry.name[5:])):
        ports.setdefault(port_of(entry), f"/dev/{entry.name}")
    if port not in ports:
        there = ", ".join(filter(None, ports)) or "none"
        raise DeviceError(f"{quote(port)}: no camera at this port; ports with cameras: {there}; plug it in there, or give another")
    return ports[port]


def exposed_s(position_ms: float) -> float:
    """Time of exposure in ``time.monotonic()`` seconds: the kernel's buffer time (ms) if it is on that clock, or the present time."""
    now_s = time.monotonic()
    return position_ms / 1e3 if 0 <= now_s - position_ms / 1e3 < CLOCK_SLACK_S else now_s


def apply_settings(device: cv2.VideoCapture, width_px: int, height_px: int) -> float:
    """Apply the settings in the order that cameras need. Returns the rate of the pictures, which may be lower than requested."""
    wanted = {
        cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*"MJPG"),
        cv2.CAP_PROP_FRAME_WIDTH: width_px,
        cv2.CAP_PROP_FRAME_HEIGHT: height_px,
        cv2.CAP_PROP_FPS: FPS,
        cv2.CAP_PROP_BUFFERSIZE: BUFFERS,
        cv2.CAP_PROP_AUTO_EXPOSURE: MANUAL_EXPOSURE,
        cv2.CAP_PROP_EXPOSURE: EXPOSURE,
        cv2.CAP_PROP_AUTO_WB: 0,
        cv2.CAP_PROP_AUTOFOCUS: 0,
    }
    if sys.platform != "linux":  # these numbers have other meanings there
        del wanted[cv2.CAP_PROP_AUTO_EXPOSURE], wanted[cv2.CAP_PROP_EXPOSURE]
    for key, value in wanted.items():  # set() does not report failures
        device.set(key, value)
    fps = device.get(cv2.CAP_PROP_FPS)
    return fps if fps > 0 else FPS


def measure_settings(device: cv2.VideoCapture, settings: Mapping[str, float]) -> list[str]:
    """Apply requested settings, and compare pictures with half of each with pictures with all of it.

    Returns a line for each setting that does nothing, because drivers may accept a setting that the camera does not have.
    """

    def measure(name: str, value: float) -> np.ndarray:
        device.set(key, value)
        levels = []
        for number in range(SETTLE_N + MEASURED_N):
            good, image = device.read()
            if good and number >= SETTLE_N:
                gray = image if image.ndim == 2 else image.mean(axis=2)
                levels.append(np.abs(cv2.Laplacian(gray.astype(np.float32), cv2.CV_32F)).mean() if name == "focus" else gray.mean())
        return np.array(levels or [np.nan])

    ignored = []
    for name, value in settings.items():
        key, unit = SETTINGS[name]
        half, whole = (measure(name, share * value * unit) for share in (0.5, 1.0))
        least = max(ACTS_SD * max(half.std(), whole.std()), ACTS_SHARE * whole.mean())
        if not abs(whole.mean() - half.mean()) > least and value:
            ignored.append(f"the setting {name}={value:g} does nothing: pictures with half of it are the same; set it at the camera")
    return ignored


def open_camera(text: str, spec: SensorSpec | None = None, form: Form | None = None, *, twin: FrameSource | None = None) -> FrameSource:
    """Make a frame source. It is not connected yet.

    Parameters
    ----------
    text : str
        ``0``, ``/dev/video2`` or ``usb:1-1.2`` (a USB camera; ``?exposure=7.8&gain=4`` sets and measures it), ``rtsp://`` or
        ``ffmpeg:http://`` (a video stream), an ``http://`` address (a stream of pictures, or a single
        picture), ``ros2:/topic``, ``twin``, a folder of pictures, a
        recording, a recorded session or a video.
    spec : SensorSpec, optional
    form : Form, optional
        Form of the frames. By default a live source has the form of the sensor's recordings if the sensor has one, otherwise raw. The form
        of recorded frames is determined from the frames.
    twin : FrameSource, optional
        The source that the text ``twin`` selects.

    Raises
    ------
    DeviceError, FrameError
        There is no such camera, recording or file.
    """
    live_form = form or (Form.PROCESSED if spec is not None and spec.recording is not None else Form.RAW)
    if spec is not None:
        frame_size(spec, live_form)
    if text == "twin":
        if twin is None:
            raise DeviceError("the twin as a camera needs an arm and an object; use 'twin servo', 'twin collect' or 'twin emulate camera'")
        return twin
    if text.partition("?")[0].isdecimal() or text.startswith(("/dev/", "usb:")):
        return UvcCamera(text, spec, live_form)
    kind, _, rest = text.partition(":")
    if kind == "ros2":
        return Ros2Camera(rest, spec, live_form)
    if (there := others("cameras", ("twin", "http", "https", "ros2", "usb", FFMPEG[:-1]))) and kind in there:
        source: FrameSource = there[kind](rest, spec, live_form)
        return source
    if "://" in text:
        return (MjpegCamera if kind in ("http", "https") else VideoCamera)(text, spec, live_form)
    if not os.path.exists(text):
        expected = "a number, /dev/videoN, usb:PORT, http://..., rtsp://..., ros2:/topic, twin, a folder or a video"
        raise DeviceError(f"{quote(without_secrets(text), LONGEST_PATH)}: no such camera, file or folder; expected {expected}")
    if is_session(text):
        return SessionSource(text)
    recording = open_recording(text, spec, form)
    return RecordedSource(text, recording, recording.notes)
