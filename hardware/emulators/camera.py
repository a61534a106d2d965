"""A camera emulated on this machine: it serves JPEG pictures over HTTP (multipart/x-mixed-replace), with faults on request."""

import threading
import time
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from hardware.cameras.coded import CONTENT_TYPE, jpeg_of, write_part
from hardware.cameras.mjpeg import hold_little
from hardware.cameras.source import FrameSource, await_frame
from hardware.emulators.faults import EVERY_NTH, SECONDS, Emulator, Fault, Faults
from hardware.errors import DeviceError, cannot_listen
from twin.errors import ErrorsAs, TwinError

CLIENT_WAIT_S = 0.5
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


@dataclass(frozen=True)
class _Part:
    """A picture as it is sent: number, exposure (Unix seconds), earliest time of sending (monotonic), bytes."""

    number: int
    exposed_unix_s: float
    due_s: float
    jpeg: bytes


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
    made, sent : int
        Number of pictures so far, including lost ones, and number of parts sent to any client.
    """

    def __init__(self, source: FrameSource, *, host: str = "127.0.0.1", port: int = 0, faults: tuple[str, ...] = ()) -> None:
        self.faults = Faults(FAULTS, faults)
        self._source, self._address = source, (host, port)
        self._new = threading.Condition()
        self._part: _Part | None = None
        self._end = threading.Event()
        self._threads: list[threading.Thread] = []
        self._server: ThreadingHTTPServer | None = None
        self._pulled_s: float | None = None
        self.error: Exception | None = None
        self.made = self.sent = 0

    @property
    def url(self) -> str:
        """Address of the stream."""
        if self._server is None:
            raise DeviceError("camera emulator: not started; call start() first")
        return f"http://{self._address[0]}:{self._server.server_port}/stream.mjpg"

    def start(self) -> None:
        with ErrorsAs(OSError, lambda error: cannot_listen("camera emulator", *self._address, error)):
            self._server = _Server(self._address, _handler_of(self))
        self._end.clear()
        self._source.connect()
        try:
            await_frame(self._source)  # the first frame compiles kernels, so it is made before a client can connect
        except BaseException:
            self._server.server_close()
            self._source.disconnect()
            raise
        for target in (self._make, self._server.serve_forever):
            self._threads.append(threading.Thread(target=target, name="camera emulator", daemon=True))
            self._threads[-1].start()

    def stop(self) -> None:
        self._end.set()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
        for thread in self._threads:
            thread.join(timeout=15.0)
        self._threads.clear()
        self._source.disconnect()

    @property
    def pulled_out(self) -> bool:
        """Whether the camera is unplugged by a fault at present."""
        span_s = self.faults.value("unplugged")
        if span_s is None:
            self._pulled_s = None
            return False
        self._pulled_s = self._pulled_s or time.monotonic()
        return time.monotonic() - self._pulled_s < span_s

    def next_part(self, after: int) -> _Part | None:
        """The newest part with a number larger than ``after``, as soon as it may be sent; None if none comes for a while."""
        with self._new:
            self._new.wait_for(lambda: self._part is not None and self._part.number > after, CLIENT_WAIT_S)
            part = self._part
        if part is None or part.number <= after:
            return None
        self._end.wait(max(0.0, part.due_s - time.monotonic()))
        return part

    def _make(self) -> None:
        last: np.ndarray | None = None
        while not self._end.is_set():
            try:
                frame = self._source.read(timeout_s=CLIENT_WAIT_S)
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
            part = _Part(self.made, time.time() - age_s, time.monotonic() + (self.faults.value("late") or 0.0), jpeg)
            with self._new:
                self._part = part
                self._new.notify_all()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True


def _handler_of(camera: CameraEmulator) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self) -> None:
            if camera.pulled_out:
                self.send_error(503, "unplugged")
                return
            self.send_response(200)
            self.send_header("Content-Type", CONTENT_TYPE)
            self.end_headers()

        def do_GET(self) -> None:
            hold_little(self.connection)
            self.do_HEAD()
            number = 0
            while not (camera._end.is_set() or camera.pulled_out):
                part = camera.next_part(number)
                if part is None:
                    continue
                number = part.number
                headers = {"X-Timestamp": f"{part.exposed_unix_s:.6f}", "X-Sequence": part.number}
                try:
                    write_part(self.wfile, part.jpeg, headers)
                except OSError:
                    return
                camera.sent += 1

        def log_message(self, *_: object) -> None:
            """Write no log."""

    return Handler
