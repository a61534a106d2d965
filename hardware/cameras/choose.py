"""Makes a frame source from the text that a user gives for ``camera``."""

import os

from hardware.cameras.mjpeg import MjpegCamera, without_secrets
from hardware.cameras.recorded import RecordedSource, SessionSource
from hardware.cameras.ros2 import Ros2Camera
from hardware.cameras.source import FrameSource
from hardware.cameras.uvc import FFMPEG, UvcCamera, VideoCamera
from hardware.errors import DeviceError
from scenes.files import LONGEST_PATH, quote
from scenes.plugins import others
from scenes.sensor import SensorSpec
from twin.frames.forms import frame_size
from twin.records.session import is_session
from twin.types import Form


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
    return SessionSource(text) if is_session(text) else RecordedSource(text, spec, form)
