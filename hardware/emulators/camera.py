"""A camera emulated on this machine: it serves JPEG pictures over HTTP (multipart/x-mixed-replace), with faults on request."""

import threading
import time

import numpy as np

from hardware.cameras.mjpeg import STREAM, WAIT_S, JpegServer, StreamPart, jpeg_of
from hardware.cameras.source import FrameSource, await_frame
from hardware.emulators.faults import EVERY_NTH, SECONDS, Emulator, Fault, Faults
from hardware.errors import DeviceError
from twin.errors import TwinError

FAULTS = {
    "frozen": Fault("the same picture again and again"),
    "black": Fault("the lamps are off"),
    "resized": Fault("the pictures have half the height"),
    "dropped": Fault("every n-th picture is lost", 2.0, EVERY_NTH),
    "late": Fault("pictures arrive this many seconds after their exposure", 0.3, SECONDS),
    "torn": Fault("every n-th JPEG ends too early", 3.0, EVERY_NTH),
    "unplugged": Fault("the connection is cut and none taken for this many seconds, once", 1.0, SECONDS),
    "silent": Fault("connections stay open, nothing comes"),
}


class _Server(JpegServer):
    """The camera's server, and the fault that cuts its connections."""

    def __init__(self, faults: Faults, host: str, port: int) -> None:
        super().__init__("camera emulator", host, port)
        self._faults, self._pulled_s = faults, 0.0

    def refuses(self) -> bool:
        """See ``JpegServer``: the camera is unplugged by a fault at present."""
        span_s = self._faults.value("unplugged")
        self._pulled_s = 0.0 if span_s is None else self._pulled_s or time.monotonic()
        return span_s is not None and time.monotonic() - self._pulled_s < span_s


class CameraEmulator(Emulator):
    """Serves a source's frames as a stream. A context manager, which listens between ``start`` and ``stop``.

    Parameters
    ----------
    source : FrameSource
        A live source. It is connected and disconnected with the emulator.
    host : str
    port : int
        Port; 0 for a free one, see ``url``.
    faults : iterable of str
        ``NAME`` or ``NAME=VALUE`` of ``FAULTS``; ``faults`` can be changed while it runs.

    Attributes
    ----------
    made : int
        Number of pictures so far, including lost ones.
    """

    def __init__(self, source: FrameSource, *, host: str = "127.0.0.1", port: int = 0, faults: tuple[str, ...] = ()) -> None:
        self.faults = Faults(FAULTS, faults)
        self._source, self._address = source, (host, port)
        self._running: tuple[_Server, threading.Thread] | None = None
        self.made = 0

    @property
    def url(self) -> str:
        """Address of the stream."""
        if self._running is None:
            raise DeviceError("camera emulator: not started; call start() first")
        return f"{self._running[0].url}{STREAM[1:]}"

    def start(self) -> None:
        server = _Server(self.faults, *self._address)
        self._source.connect()
        try:
            await_frame(self._source)  # the first frame compiles kernels, so it is made before a client can connect
        except BaseException:
            server.stop()
            self._source.disconnect()
            raise
        self._running = server, threading.Thread(target=self._make, args=(server,), name="camera emulator", daemon=True)
        server.start()
        self._running[1].start()
        self.place = f"camera {self.url}"

    def stop(self) -> None:
        if self._running is not None:
            self._running[0].stop()
            self._running[1].join(timeout=15.0)
        self._source.disconnect()

    def _make(self, server: _Server) -> None:
        last: np.ndarray | None = None
        while not server.ended.is_set():
            try:
                frame = self._source.read(timeout_s=WAIT_S)
            except TimeoutError:
                continue
            except (TwinError, EOFError) as error:
                self.error = error
                return
            image = frame.image
            if "frozen" in self.faults and last is not None:
                image = last
            last = image
            if "black" in self.faults:
                image = np.zeros_like(image)
            if "resized" in self.faults:
                image = image[::2]
            self.made += 1
            if "silent" in self.faults or self.faults.every("dropped", self.made):
                continue
            jpeg = jpeg_of(image)
            if self.faults.every("torn", self.made):
                jpeg = jpeg[: len(jpeg) // 2]
            age_s = time.monotonic() - frame.time_s
            headers = {"X-Timestamp": f"{time.time() - age_s:.6f}", "X-Sequence": self.made}
            server.give(StreamPart(self.made, jpeg, headers, time.monotonic() + (self.faults.value("late") or 0.0)))
