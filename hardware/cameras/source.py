"""Sources of frames: their protocol (``FrameSource``), frames from disk, and the source that a user's text for ``camera`` names.

Times are ``time.monotonic()`` seconds.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import Protocol

from hardware.cameras.devices import FFMPEG, Ros2Camera, UvcCamera, VideoCamera
from hardware.cameras.mjpeg import MjpegCamera, without_secrets
from hardware.errors import Connection, DeviceError
from scenes.files import LONGEST_PATH, quote
from scenes.plugins import others
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs
from twin.frames import Recording, open_recording
from twin.frames.forms import frame_size
from twin.records.session import Session, is_session
from twin.types import Form, Frame


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
