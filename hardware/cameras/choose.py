"""Makes a frame source from the text that a user gives for ``camera``."""

import os

from hardware.cameras.mjpeg import MjpegCamera
from hardware.cameras.recorded import RecordedSource, SessionSource
from hardware.cameras.source import FrameSource
from hardware.cameras.uvc import UvcCamera
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
        ``0`` or ``/dev/video2`` (a USB camera), an ``http://`` address (a stream of JPEGs), ``twin``, a folder of pictures, a
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
    if text.isdecimal() or text.startswith("/dev/"):
        return UvcCamera(int(text) if text.isdecimal() else text, spec, live_form)
    kind, _, rest = text.partition(":")
    if (there := others("cameras", ("twin", "http", "https"))) and kind in there:
        source: FrameSource = there[kind](rest, spec, live_form)
        return source
    if "://" in text:
        return MjpegCamera(text, spec, live_form)
    if not os.path.exists(text):
        expected = "a number, /dev/videoN, http://..., twin, a folder or a video"
        raise DeviceError(f"{quote(text, LONGEST_PATH)}: no such camera, file or folder; expected {expected}")
    return SessionSource(text) if is_session(text) else RecordedSource(text, spec, form)
