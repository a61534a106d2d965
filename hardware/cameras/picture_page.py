"""A camera's newest picture over HTTP: as a stream (multipart/x-mixed-replace), and on a page with a line of text above it."""

import socket
import threading
import time
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from hardware.cameras.coded import CONTENT_TYPE, jpeg_of, write_part
from hardware.errors import cannot_listen
from twin.errors import ErrorsAs

WAIT_S = 0.5
"""Interval in s at which a connection without new pictures checks whether the server has ended."""
HELD_BYTES = 16_384
"""Bytes in the send buffer of a connection, so that a client that pauses gets few old pictures, and then the newest. The kernel doubles the
number, and the client has its own buffer."""
STREAM = "/stream.mjpg"
LINE = "/line"
PAGE = f"""<!doctype html><meta charset=utf-8><meta name=viewport content="width=device-width,initial-scale=1"><title>Camera</title>
<body style="margin:0;background:#222;color:#fff;text-align:center;font:1.4rem sans-serif">
<p id=line role=status style="margin:.5rem;min-height:2.4em"></p>
<img src="{STREAM}" style="width:100%;height:calc(100vh - 5rem);object-fit:contain;object-position:top" alt="the camera's picture">
<script>setInterval(async () => {{ try {{ line.textContent = await (await fetch("{LINE}")).text() }}
catch {{ line.textContent = "The recording has ended." }} }}, 250)</script>"""


@dataclass(frozen=True)
class StreamPart:
    """A picture as it is sent: its number from 1 on, bytes, further headers, and earliest time of sending (monotonic)."""

    number: int
    jpeg: bytes
    headers: dict[str, object] = field(default_factory=dict)
    due_s: float = 0.0


class JpegServer(ThreadingHTTPServer):
    """Sends the newest picture to every client, each in its own thread.

    Parameters
    ----------
    who : str
        Name of the server, for its threads and errors.
    host : str
    port : int
        Port; 0 for a free one, see ``url``.

    Attributes
    ----------
    page : str
        Page at every address but those of the stream and the line; "" if the stream is at all addresses.
    line : str
        The page's line of text.
    url : str
        Address of the page, or of the server.
    """

    page, line = "", ""

    def __init__(self, who: str, host: str, port: int) -> None:
        with ErrorsAs(OSError, lambda error: cannot_listen(who, host, port, error)):
            super().__init__((host, port), _Handler)
        self.url = f"http://{host}:{self.server_port}/"
        self._new, self.newest, self.ended = threading.Condition(), StreamPart(0, b""), threading.Event()
        self._thread = threading.Thread(target=self.serve_forever, name=who, daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self.ended.set()
        if self._thread.is_alive():
            self.shutdown()
            self._thread.join()
        self.server_close()

    def give(self, part: StreamPart) -> None:
        """Set the newest picture."""
        with self._new:
            self.newest = part
            self._new.notify_all()

    def await_part(self, after: int) -> StreamPart:
        """The newest picture, as soon as its number is larger than ``after`` and it may be sent, or after a while."""
        with self._new:
            self._new.wait_for(lambda: self.newest.number > after, WAIT_S)
            part = self.newest
        self.ended.wait(max(0.0, part.due_s - time.monotonic()))
        return part

    def refuses(self) -> bool:
        """Whether no client is served at present."""
        return False


class PicturePage(JpegServer):
    """A context manager; the page is served while it is entered.

    Parameters
    ----------
    port : int
        Port; 0 for a free one, see ``url``.
    """

    page = PAGE

    def __init__(self, port: int = 0) -> None:
        super().__init__("preview", "127.0.0.1", port)

    def __enter__(self) -> "PicturePage":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def show(self, image: np.ndarray, line: str) -> None:
        """Show a picture (H, W) or (H, W, 3), RGB, with a line of text."""
        self.line = line
        self.give(StreamPart(self.newest.number + 1, jpeg_of(image)))


class _Handler(BaseHTTPRequestHandler):
    server: JpegServer

    def do_HEAD(self) -> None:
        if self.server.refuses():
            self.send_error(503, "unplugged")
            return
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE if self._streams else "text/html; charset=utf-8")
        self.end_headers()

    def do_GET(self) -> None:
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, HELD_BYTES)
        self.do_HEAD()
        if not self._streams:
            self.wfile.write((self.server.line if self.path == LINE else self.server.page).encode())
            return
        number = 0
        while not (self.server.ended.is_set() or self.server.refuses()):
            part = self.server.await_part(number)
            if part.number > number:
                try:
                    write_part(self.wfile, part.jpeg, part.headers)
                except OSError:
                    return
                number = part.number

    @property
    def _streams(self) -> bool:
        return not self.server.page or self.path == STREAM

    def log_message(self, *_: object) -> None:
        """Write no log."""
