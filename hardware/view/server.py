"""A view in the browser: a page, a stream of annotated pictures, and figures, from the standard library's HTTP server."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from hardware.cameras.mjpeg import CONTENT_TYPE, hold_little, jpeg_of, write_part
from hardware.errors import cannot_listen
from twin.report.page import render_page

# What each path of the view is.
KINDS = {"/": "text/html; charset=utf-8", "/stats.json": "application/json", "/stream.mjpg": CONTENT_TYPE}
# Interval in s at which a stream looks whether the view was closed.
WAIT_S = 0.5


class BrowserView:
    """Serves the last picture and figures given to ``show``. A context manager.

    Parameters
    ----------
    title : str
    host, port : str, int
        Port 0 selects a free port, see ``url``.
    """

    def __init__(self, title: str, *, host: str = "127.0.0.1", port: int = 0) -> None:
        self._host = host
        self._page = render_page("hardware.view", title=title).encode()
        self._new = threading.Condition()
        self._jpeg, self._number, self._ended = b"", 0, False
        self._stats: dict[str, object] = {}
        try:
            self._server = ThreadingHTTPServer((host, port), self._handler())
        except OSError as error:
            raise cannot_listen("view", host, port, error) from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, name="view", daemon=True)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self._host}:{self._server.server_port}/"

    def show(self, picture: np.ndarray, stats: dict[str, object]) -> bool:
        """Show a picture (H, W, 3) RGB and figures by name; False once the user closed the view (never, in a browser)."""
        jpeg = jpeg_of(picture)
        with self._new:
            self._jpeg, self._number, self._stats = jpeg, self._number + 1, dict(stats)
            self._new.notify_all()
        return True

    def __enter__(self) -> "BrowserView":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._new:
            self._ended = True
            self._new.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=5.0)

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        view = self

        class Handler(BaseHTTPRequestHandler):
            def do_HEAD(self) -> None:
                path = self.path.partition("?")[0]
                if path not in KINDS:
                    self.send_error(404)
                    return
                self.send_response(200)
                self.send_header("Content-Type", KINDS[path])
                self.end_headers()

            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                if path == "/":
                    self._send(KINDS[path], view._page)
                elif path == "/stats.json":
                    with view._new:
                        stats = dict(view._stats)
                    self._send(KINDS[path], json.dumps(stats).encode())
                elif path == "/stream.mjpg":
                    self._stream()
                else:
                    self.send_error(404)

            def _send(self, kind: str, body: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def _stream(self) -> None:
                hold_little(self.connection)
                self.send_response(200)
                self.send_header("Content-Type", CONTENT_TYPE)
                self.end_headers()
                number = 0
                while True:
                    with view._new:
                        view._new.wait_for(lambda: view._ended or view._number > number, WAIT_S)  # noqa: B023
                        if view._ended:
                            return
                        if view._number == number:
                            continue
                        jpeg, number = view._jpeg, view._number
                    try:
                        write_part(self.wfile, jpeg)
                    except OSError:
                        return

            def log_message(self, *_: object) -> None:
                """Write no log."""

        return Handler
