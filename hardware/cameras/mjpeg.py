"""Pictures over HTTP: how JPEGs and PNGs are coded, streams of them (multipart/x-mixed-replace), a camera that sends them, and a server.

The camera sends a stream, or is the address of a single picture. The server sends the newest picture as a stream, and on a page with a line
of text above it.
"""

import contextlib
import http.client
import re
import socket
import threading
import time
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np

from hardware.cameras import reader
from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed, TornPicture
from hardware.errors import DeviceError, cannot_listen, on_error
from scenes.files import quote
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs, FrameError
from twin.frames.images import picture_of
from twin.types import Form

BOUNDARY = "frame"
CONTENT_TYPE = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
# Quality (0 to 100) of the JPEGs that are written.
JPEG_QUALITY = 95
# Largest accepted picture, in bytes.
LARGEST_PART = 32_000_000
# Most bytes of a line of a part's headers.
LONGEST_HEADER = 65_536
# Largest difference, s, between a time stamp and the present time. A time stamp with a larger difference is of another clock and not used.
CLOCK_SLACK_S = 60.0
# First bytes of a JPEG and of a PNG, and the last bytes of a PNG.
JPEG, PNG, PNG_END = b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"IEND\xae\x42\x60\x82"
# A JPEG's markers but those without content and those inside a scan; and its start and end.
_MARKER = re.compile(rb"\xff([^\x00\x01\xd0-\xd7\xff])")
_START, _END = 0xD8, 0xD9
# Time, s, without a byte after which a read has failed.
SILENT_S = 2.0
# Pause, s, after which the address of a single picture is asked again.
POLL_S = 0.03
# Bytes that are read at once.
CHUNK = 65_536
# Header of a part with the exposure in Unix seconds, in lower case, as mjpg-streamer sends it.
TIME_HEADER = "x-timestamp"
# What to do about an answer, by its status.
REMEDIES = {
    401: "it wants a login: give http://NAME:PASSWORD@HOST/..., with % codes for special characters; if you did, it refuses this one",
    403: "it refuses this user or this computer; allow it in the camera's settings",
    404: "it has no such page; look up the path of the stream in the camera's manual",
    503: "it is busy or not ready; end what else uses the camera, and try again",
}
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


def jpeg_of(image: np.ndarray, quality: int = JPEG_QUALITY) -> bytes:
    """A gray (H, W) or RGB (H, W, 3) picture as JPEG."""
    _, coded = cv2.imencode(".jpg", image if image.ndim == 2 else image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return coded.tobytes()


def write_part(out: BufferedIOBase, jpeg: bytes, headers: dict[str, object] | None = None) -> None:
    """Write one picture of a stream; raises ``OSError`` if the client is gone."""
    more = "".join(f"{name}: {value}\r\n" for name, value in (headers or {}).items())
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n{more}\r\n"
    out.write(head.encode("ascii") + jpeg + b"\r\n")


def picture_end(data: bytes | bytearray) -> int:
    """Number of bytes of the picture with which ``data`` begins; 0 if it is not whole.

    A JPEG's end is found by its segments, because its thumbnail has an end of its own.
    """
    if data.startswith(PNG):
        return data.find(PNG_END) + len(PNG_END) if PNG_END in data else 0
    at = len(JPEG) if data.startswith(JPEG) else len(data)
    while found := _MARKER.search(data, at):
        at = found.end()
        if found[1][0] in (_START, _END):  # a start is that of the next picture
            return at if found[1][0] == _END else 0
        at += int.from_bytes(data[at : at + 2], "big")
    return 0


def decode_picture(data: bytes) -> tuple[np.ndarray, str]:
    """A JPEG or PNG as gray (H, W) or RGB (H, W, 3) uint8, and a note as of ``picture_of``.

    An incomplete or damaged one raises ``TornPicture``, because decoders guess the rest.
    """
    kind = "JPEG" if data.startswith(JPEG) else "PNG" if data.startswith(PNG) else ""
    if not kind:
        raise TornPicture(f"{len(data)} bytes that are neither a JPEG nor a PNG")
    if not (end := picture_end(data)):
        raise TornPicture(f"an incomplete {kind} ({len(data)} bytes, without its end)")
    with ErrorsAs(FrameError, lambda error: TornPicture(f"a damaged {kind}: {error}")):
        return picture_of(data[:end])


class Parts:
    """The parts of a multipart stream, with or without ``Content-Length``, whatever its boundary is.

    Parameters
    ----------
    read : callable
        Gives the next bytes of the stream, as soon as there are any; none at its end.
    """

    def __init__(self, read: Callable[[], bytes]) -> None:
        self._read, self._data, self._boundary = read, bytearray(), b""

    def next_part(self) -> tuple[dict[str, str], bytes]:
        """Headers (lower case) and picture of the next part.

        A part ends with its picture, so that it is there before the next one begins; a part that is no whole picture ends at the boundary.

        Raises
        ------
        EOFError
            The stream has ended.
        """
        headers: dict[str, str] = {}
        begun = False
        while True:
            line = self._line()
            if line.startswith(b"--") and not begun:
                if self._boundary and line == self._boundary + b"--":
                    raise EOFError("the stream ended")
                begun, self._boundary = True, self._boundary or line
            name, colon, value = line.decode("latin-1").partition(":")
            if colon:
                headers[name.strip().lower()] = value.strip()
            elif begun and not line:
                return headers, self._body()

    def _line(self) -> bytes:
        while (end := self._data.find(b"\n")) < 0:
            if len(self._data) > LONGEST_HEADER:
                raise EOFError(f"{LONGEST_HEADER} bytes without a line of headers")
            self._fill("")
        line = bytes(self._data[:end]).strip()
        del self._data[: end + 1]
        return line

    def _body(self) -> bytes:
        while True:
            end = picture_end(self._data)
            next_one = self._data.find(b"\n" + self._boundary)
            if not end and next_one >= 0:
                end = next_one + 1
            if end:
                body = bytes(self._data[:end])
                del self._data[:end]
                return body
            if len(self._data) > LARGEST_PART:
                raise EOFError(f"a part of more than {LARGEST_PART} bytes")
            self._fill(" within a picture")

    def _fill(self, where: str) -> None:
        data = self._read()
        if not data:
            raise EOFError(f"the stream ended{where}")
        self._data += data


def on_own_clock(unix_s: float) -> float:
    """A time of exposure in Unix seconds on the monotonic clock; the present time if it is of another clock, or not known (NaN)."""
    now_s, age_s = time.monotonic(), time.time() - unix_s
    return now_s - max(age_s, 0.0) if abs(age_s) < CLOCK_SLACK_S else now_s


def without_secrets(address: str) -> str:
    """An address without its login, and without the values of its query, any of which may be a password."""
    plain = re.sub(r"^((?:\w+:)*//)?[^?]*@", lambda found: found[1] or "", address)
    return re.sub(r"([?&;][^=&;]*=)[^&;]*", r"\1...", plain)


class MjpegCamera(LiveSource):
    """A camera that is read over HTTP.

    The time of exposure is a part's ``X-Timestamp`` (Unix seconds), or its arrival if there is none. Gaps in
    ``X-Sequence`` are lost pictures. The address of a single picture is asked again and again; a picture that has not changed is not a new
    one, and its time is that of the request.

    Parameters
    ----------
    url : str
        It may contain a login (``http://NAME:PASSWORD@HOST/...``), for basic or digest authentication. It is never printed.
    spec : SensorSpec, optional
    form : Form
    """

    def __init__(self, url: str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        super().__init__(without_secrets(url), form)
        self._spec = spec
        try:
            parts = urlsplit(url)
            usable = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
        except ValueError:  # the port is not a number
            usable = False
        if not usable:
            raise DeviceError(f"{self.name}: not the address of a stream; expected http://host:port/path")
        self._plain = parts._replace(netloc=parts.netloc.rpartition("@")[2], fragment="").geturl()
        self._open_url = _opener(self._plain, parts.username, parts.password)
        self._answer: http.client.HTTPResponse | None = None
        self._parts: Parts | None = None  # None for a single picture
        self._last: int | None = None
        self._before: bytes | None = None

    def _open(self) -> None:
        self._last = self._before = None
        with ErrorsAs(OSError, lambda error: DeviceError(f"{self.name}: {error}; start the stream or check the address")):
            self._request()

    def _request(self) -> None:
        """Request the address; an ``OSError`` states the reason of a failure, ``DeviceError`` that this is no camera."""
        try:
            answer = self._open_url.open(self._plain, timeout=SILENT_S)
        except HTTPError as error:
            error.close()
            why = REMEDIES.get(error.code, "look up the address of the stream in the camera's manual")
            raise OSError(f"answers {error.code} {http.client.responses.get(error.code, '')}: {why}") from None
        except (OSError, http.client.HTTPException, ValueError) as error:
            reason = error.reason if isinstance(error, URLError) else error
            raise OSError(f"no answer ({quote(without_secrets(str(reason) or type(error).__name__))})") from None
        self._answer, kind = answer, answer.headers.get_content_maintype()
        if kind == "multipart":
            self._parts = Parts(lambda: answer.read1(CHUNK))
        elif kind != "image":
            self._close()
            given = answer.headers.get("Content-Type", "nothing about its type")
            page = "the page that shows the picture; give the address of the picture in it" if "html" in given else "no picture or stream"
            raise OSError(f"answers {quote(given)}: {page}; a video (rtsp://..., or ffmpeg:http://...) is read as one")

    def _close(self) -> None:
        if self._answer is not None:
            self._answer.close()
        self._answer = self._parts = None

    def _interrupt(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # the connection's socket belongs to the answer, or it is closed already
            self._answer.fp.raw._sock.shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]

    def _grab(self) -> DevicePicture:
        begun_s = time.monotonic()
        if self._answer is None:
            self._again(self._request)
        answer, parts = self._answer, self._parts
        if answer is None:  # another thread closed it
            raise ReadFailed("the stream was closed")
        try:
            if parts is None:
                return self._single(answer, begun_s)
            headers, data = parts.next_part()
        except (OSError, EOFError, http.client.HTTPException, ValueError) as error:
            self._close()  # so that it is opened again
            raise ReadFailed(str(error) or type(error).__name__) from error
        image, note = decode_picture(data)
        number = int(headers["x-sequence"]) if headers.get("x-sequence", "").isdecimal() else None
        lost = max(0, number - self._last - 1) if number is not None and self._last is not None else 0
        again = number is not None and number == self._last
        if number is not None:
            self._last = number
        return DevicePicture(image, stamped_s(headers), lost, note, again)

    def _single(self, answer: http.client.HTTPResponse, begun_s: float) -> DevicePicture:
        """The picture of an address of single pictures, once it has changed."""
        until_s = begun_s + SILENT_S
        while not self._end.is_set():
            data = answer.read()
            self._close()
            if data != self._before:
                with on_error(lambda: self._end.wait(reader.FAILED_PAUSE_S)):  # it may be about to be replaced
                    image, note = decode_picture(data)
                self._before = data
                return DevicePicture(image, begun_s, 0, note)
            if time.monotonic() > until_s:
                raise ReadFailed(f"the picture at the address has not changed for {SILENT_S:g} s")
            self._end.wait(POLL_S)
            begun_s = time.monotonic()
            self._request()
            answer = self._answer or answer
        raise ReadFailed("the camera was closed")


def _opener(url: str, user: str | None, password: str | None) -> urllib.request.OpenerDirector:
    """What opens addresses: without proxies, with redirections, and with the login for this one."""
    logins = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    if user:
        logins.add_password(None, url, unquote(user), unquote(password or ""))
    basic, digest = urllib.request.HTTPBasicAuthHandler(logins), urllib.request.HTTPDigestAuthHandler(logins)
    return urllib.request.build_opener(urllib.request.ProxyHandler({}), basic, digest)


def stamped_s(headers: dict[str, str]) -> float:
    """Time of exposure on the monotonic clock, from a part's headers; the present time if the headers do not state it."""
    try:
        return on_own_clock(float(headers[TIME_HEADER]))
    except (KeyError, ValueError):
        return time.monotonic()


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
    refuses : callable, optional
        Whether no client is served at present.

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

    def __init__(self, who: str, host: str, port: int, refuses: Callable[[], bool] = lambda: False) -> None:
        with ErrorsAs(OSError, lambda error: cannot_listen(who, host, port, error)):
            super().__init__((host, port), _Handler)
        self.url, self.refuses = f"http://{host}:{self.server_port}/", refuses
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
