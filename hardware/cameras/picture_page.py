"""A page on this machine that shows a camera's newest picture, with a line of text above it."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

import cv2
import numpy as np

from hardware.cameras.coded import CONTENT_TYPE, jpeg_of, write_part
from hardware.cameras.mjpeg import hold_little
from hardware.errors import cannot_listen
from twin.errors import ErrorsAs

WAIT_S = 0.5
STREAM = "/stream.mjpg"
PAGE = f"""<!doctype html><meta name=viewport content="width=device-width"><title>Camera</title>
<body style="margin:0;background:#222;text-align:center"><img src="{STREAM}" style="max-width:100%" alt="the camera's picture">"""
LINE_PX, LETTER = 28, 0.6
"""Height of the line of text, px, and size of its letters, for OpenCV."""


class PicturePage(ThreadingHTTPServer):
    """A context manager; the page is served while it is entered.

    Parameters
    ----------
    port : int
        Port; 0 for a free one, see ``url``.
    """

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        with ErrorsAs(OSError, lambda error: cannot_listen("preview", "127.0.0.1", port, error)):
            super().__init__(("127.0.0.1", port), _Handler)
        self._new, self._number, self._jpeg, self.ended = threading.Condition(), 0, b"", False

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server_port}/"

    def __enter__(self) -> "PicturePage":
        threading.Thread(target=self.serve_forever, name="preview", daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.ended = True
        self.shutdown()
        self.server_close()

    def show(self, image: np.ndarray, line: str) -> None:
        """Show a picture (H, W) or (H, W, 3), RGB, with a line of text."""
        text = np.zeros((LINE_PX, max(image.shape[1], 1), 3), np.uint8)
        cv2.putText(text, line, (6, LINE_PX - 9), cv2.FONT_HERSHEY_SIMPLEX, LETTER, (255, 255, 255), 1, cv2.LINE_AA)
        coloured = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
        with self._new:
            self._number, self._jpeg = self._number + 1, jpeg_of(np.vstack([text, coloured]))
            self._new.notify_all()

    def next_picture(self, after: int) -> tuple[int, bytes]:
        """Number and JPEG of the newest picture, as soon as its number is larger than ``after``, or after a while."""
        with self._new:
            self._new.wait_for(lambda: self._number > after, WAIT_S)
            return self._number, self._jpeg


class _Handler(BaseHTTPRequestHandler):
    server: PicturePage

    def do_GET(self) -> None:
        streams = self.path == STREAM
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE if streams else "text/html; charset=utf-8")
        self.end_headers()
        if not streams:
            self.wfile.write(PAGE.encode())
            return
        hold_little(self.connection)
        number = 0
        while not self.server.ended:
            newest, jpeg = self.server.next_picture(number)
            if newest > number:
                try:
                    write_part(self.wfile, jpeg)
                except OSError:
                    return
            number = newest

    def log_message(self, *_: object) -> None:
        """Write no log."""
