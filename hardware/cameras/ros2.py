"""A camera whose pictures are a ROS 2 topic, raw (``sensor_msgs/Image``) or compressed (``sensor_msgs/CompressedImage``)."""

import time

import numpy as np

from hardware.cameras.mjpeg import SILENT_S, decode_picture, on_own_clock
from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed, TornPicture
from hardware.errors import DeviceError
from hardware.ros2.dds import Participant, Reader, domain_id
from scenes.files import quote
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs
from twin.records.ros2 import NS_PER_S, decode
from twin.types import Form

PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
"""Messages with a picture."""
CHANNELS = {"mono8": (1, 1), "8UC1": (1, 1), "rgb8": (3, 1), "bgr8": (3, -1), "8UC3": (3, -1), "rgba8": (4, 1), "bgra8": (4, -1)}
"""Encodings of raw pictures: their channels, and 1 for RGB or -1 for BGR."""


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
