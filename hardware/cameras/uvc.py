"""A USB camera through OpenCV: on Linux through Video4Linux, elsewhere through what the system has."""

import sys
import time

import cv2

from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed
from hardware.errors import DeviceError
from scenes.sensor import SensorSpec
from twin.frames.images import overheard
from twin.types import Form

# Value of Video4Linux's exposure mode for manual exposure (3 is automatic).
MANUAL_EXPOSURE = 1
# A buffer time that differs from the present time by more than this (s) does not come from the monotonic clock and is not used.
CLOCK_SLACK_S = 5.0
# Number of pictures that the driver may queue. With 1, the next picture is always the newest.
BUFFERS = 1
# Requested settings: size and rate of the pictures if no sensor tells the size, and the exposure in 100 us units.
WIDTH_PX, HEIGHT_PX, FPS, EXPOSURE = 640, 480, 30.0, 78.0


class UvcCamera(LiveSource):
    """A USB camera of this machine.

    Parameters
    ----------
    node : int or str
        Number or device node of the camera.
    spec : SensorSpec, optional
    form : Form
    """

    def __init__(self, node: int | str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        super().__init__(f"camera {node}", form)
        self._node, self._spec = node, spec
        self.fps = FPS
        self._device: cv2.VideoCapture | None = None

    def _open(self) -> None:
        with overheard():
            device = cv2.VideoCapture(self._node, cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY)
        if not device.isOpened():
            raise DeviceError(f"{self.name}: can't be opened; 'twin doctor' lists the cameras; check whether another program uses it")
        size = (self._spec.camera.width_px, self._spec.camera.height_px) if self._spec else (WIDTH_PX, HEIGHT_PX)
        self.fps = apply_settings(device, *size)
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
        return DevicePicture(image if image.ndim == 2 else image[..., ::-1].copy(), exposed_s(device.get(cv2.CAP_PROP_POS_MSEC)))


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
