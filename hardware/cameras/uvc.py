"""A USB camera through OpenCV and Video4Linux."""

import time
from dataclasses import dataclass

import cv2

from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed
from hardware.errors import DeviceError
from scenes.sensor import SensorSpec
from twin.frames.images import quiet
from twin.types import Form

# Value of Video4Linux's exposure mode for manual exposure (3 is automatic).
MANUAL_EXPOSURE = 1
# A buffer time that differs from the present time by more than this (s) does not come from the monotonic clock and is not used.
CLOCK_SLACK_S = 5.0
# Number of pictures that the driver may queue. With 1, the next picture is always the newest.
BUFFERS = 1


@dataclass(frozen=True)
class UvcSettings:
    """Requested settings of the camera; None leaves a setting unchanged.

    Attributes
    ----------
    exposure : float
        In 100 us units.
    white_balance_k : float
        Colour temperature.
    """

    width_px: int = 640
    height_px: int = 480
    fps: float = 30.0
    exposure: float | None = 78.0
    gain: float | None = None
    white_balance_k: float | None = None


class UvcCamera(LiveSource):
    """A USB camera of this machine.

    Parameters
    ----------
    node : int or str
        Number or device node of the camera.
    spec : SensorSpec, optional
    form : Form
    settings : UvcSettings
    """

    def __init__(self, node: int | str, spec: SensorSpec | None = None, form: Form = Form.RAW, settings: UvcSettings | None = None) -> None:
        super().__init__(f"camera {node}", form)
        self._node, self._spec = node, spec
        size = {"width_px": spec.camera.width_px, "height_px": spec.camera.height_px} if spec else {}
        self.settings = settings or UvcSettings(**size)
        self.fps = self.settings.fps
        self.report: list[tuple[str, float, float]] = []  # name, requested value and value read back of each setting
        self._device: cv2.VideoCapture | None = None

    def _open(self) -> None:
        with quiet():
            device = cv2.VideoCapture(self._node, cv2.CAP_V4L2)
        if not device.isOpened():
            raise DeviceError(f"{self.name}: can't be opened; 'twin doctor' lists the cameras; check whether another program uses it")
        self.report = apply_settings(device, self.settings)
        reported = next(reported for name, _, reported in self.report if name == "fps")
        self.fps = reported if reported > 0 else self.settings.fps  # a camera may be slower than requested
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


def apply_settings(device: cv2.VideoCapture, settings: UvcSettings) -> list[tuple[str, float, float]]:
    """Apply the settings in the order that cameras need. Returns the name, the requested value and the value read back of each."""
    wanted = [
        ("fourcc", cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")),
        ("width", cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
        ("height", cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
        ("fps", cv2.CAP_PROP_FPS, settings.fps),
        ("buffers", cv2.CAP_PROP_BUFFERSIZE, BUFFERS),
    ]
    if settings.exposure is not None:
        wanted += [("auto exposure", cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE), ("exposure", cv2.CAP_PROP_EXPOSURE, settings.exposure)]
    if settings.gain is not None:
        wanted.append(("gain", cv2.CAP_PROP_GAIN, settings.gain))
    wanted.append(("auto white balance", cv2.CAP_PROP_AUTO_WB, 0))
    if settings.white_balance_k is not None:
        wanted.append(("white balance", cv2.CAP_PROP_WB_TEMPERATURE, settings.white_balance_k))
    wanted.append(("autofocus", cv2.CAP_PROP_AUTOFOCUS, 0))
    for _, key, value in wanted:  # set() does not report failures
        device.set(key, value)
    return [(name, float(value), float(device.get(key))) for name, key, value in wanted]
