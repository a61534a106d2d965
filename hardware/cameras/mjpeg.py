"""JPEG pictures over HTTP (multipart/x-mixed-replace): the writing of such a stream, and a camera that reads it."""

import contextlib
import http.client
import socket
import time
from io import BufferedIOBase
from urllib.parse import urlsplit

import cv2
import numpy as np

from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed, TornPicture
from hardware.errors import DeviceError
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs, FrameError
from twin.frames.images import picture_of
from twin.types import Form

BOUNDARY = "frame"
CONTENT_TYPE = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
# Quality (0 to 100) of the JPEGs that are written.
JPEG_QUALITY = 95
# Time, s, without a byte after which a read has failed.
SILENT_S = 2.0
# Largest accepted picture, in bytes.
LARGEST_PART = 32_000_000
# Header of a part with the exposure in Unix seconds, in lower case, as mjpg-streamer sends it.
TIME_HEADER = "x-timestamp"
# Largest difference, s, between a time stamp and the present time. A time stamp with a larger difference is of another clock and not used.
CLOCK_SLACK_S = 60.0
# Bytes in the send buffer of a server's connection. The kernel doubles the number, and the client has its own buffer.
HELD_BYTES = 16_384
# First and last bytes of a JPEG.
START, END = b"\xff\xd8", b"\xff\xd9"


def jpeg_of(image: np.ndarray) -> bytes:
    """A gray (H, W) or RGB (H, W, 3) picture as JPEG."""
    _, coded = cv2.imencode(".jpg", image if image.ndim == 2 else image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return coded.tobytes()


def write_part(out: BufferedIOBase, jpeg: bytes, headers: dict[str, object] | None = None) -> None:
    """Write one picture of a stream; raises ``OSError`` if the client is gone."""
    more = "".join(f"{name}: {value}\r\n" for name, value in (headers or {}).items())
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n{more}\r\n"
    out.write(head.encode("ascii") + jpeg + b"\r\n")


def hold_little(connection: socket.socket) -> None:
    """Limit a connection's buffer to few pictures, so that a client that pauses gets few old pictures, and then the newest."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, HELD_BYTES)


class MjpegCamera(LiveSource):
    """A stream of JPEG pictures.

    The time of exposure is a part's ``X-Timestamp`` (Unix seconds), or its arrival if there is none. Gaps in
    ``X-Sequence`` are lost pictures.

    Parameters
    ----------
    url : str
    spec : SensorSpec, optional
    form : Form
    """

    def __init__(self, url: str, spec: SensorSpec | None = None, form: Form = Form.RAW) -> None:
        super().__init__(url, form)
        self._spec = spec
        try:
            parts = urlsplit(url)
            usable = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
        except ValueError:  # the port is not a number
            usable = False
        if not usable:
            raise DeviceError(f"{url}: not the address of a stream; expected http://host:port/path")
        self._parts = parts
        self._connection: http.client.HTTPConnection | None = None
        self._stream: http.client.HTTPResponse | None = None
        self._socket: socket.socket | None = None
        self._last: int | None = None

    def _open(self) -> None:
        self._last = None
        with ErrorsAs(OSError, lambda error: DeviceError(f"{self.name}: {error}; start the stream or check the address")):
            self._request()

    def _request(self) -> None:
        """Request the stream; an ``OSError`` states the reason of a failure."""
        protocol = http.client.HTTPSConnection if self._parts.scheme == "https" else http.client.HTTPConnection
        connection = protocol(self._parts.hostname or "", self._parts.port, timeout=SILENT_S)
        try:
            connection.request("GET", (self._parts.path or "/") + (f"?{self._parts.query}" if self._parts.query else ""))
            self._socket = connection.sock  # kept here, because the answer may take it over
            answer = connection.getresponse()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            raise OSError(f"no answer ({error})") from error
        kind = answer.getheader("Content-Type", "")
        if answer.status != 200 or "multipart" not in kind:
            connection.close()
            raise OSError(f"answers {answer.status} {kind or 'without a type'}, no multipart stream of JPEGs")
        self._connection, self._stream = connection, answer

    def _close(self) -> None:
        for opened in (self._stream, self._connection):
            if opened is not None:
                opened.close()
        self._connection = self._stream = self._socket = None

    def _interrupt(self) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def _grab(self) -> DevicePicture:
        if self._stream is None:
            self._again(self._request)
        stream = self._stream
        if stream is None:  # another thread closed it
            raise ReadFailed("the stream was closed")
        try:
            headers, data = next_part(stream)
        except (OSError, EOFError, http.client.HTTPException) as error:
            self._close()  # so that it is opened again
            raise ReadFailed(str(error) or type(error).__name__) from error
        image, note = decode_jpeg(data)
        number = int(headers["x-sequence"]) if headers.get("x-sequence", "").isdecimal() else None
        lost = max(0, number - self._last - 1) if number is not None and self._last is not None else 0
        again = number is not None and number == self._last
        if number is not None:
            self._last = number
        return DevicePicture(image, stamped_s(headers), lost, note, again)


def next_part(stream: BufferedIOBase) -> tuple[dict[str, str], bytes]:
    """Headers (lower case) and body of the next part of a multipart stream; ``EOFError`` at its end."""
    headers: dict[str, str] = {}
    while True:  # skip lines up to the next part's boundary and headers
        line = stream.readline(65536)
        if not line:
            raise EOFError("the stream ended")
        name, colon, value = line.decode("latin-1").strip().partition(":")
        if colon:
            headers[name.lower()] = value.strip()
        elif not name and headers:
            break
    length = int(headers.get("content-length", 0)) if headers.get("content-length", "0").isdecimal() else 0
    if not 0 < length <= LARGEST_PART:
        raise EOFError(f"a part without a usable Content-Length ({headers.get('content-length', 'none')})")
    data = stream.read(length)
    if len(data) < length:
        raise EOFError(f"the stream ended within a picture ({len(data)} of {length} bytes)")
    return headers, data


def decode_jpeg(data: bytes) -> tuple[np.ndarray, str]:
    """A JPEG as gray (H, W) or RGB (H, W, 3) uint8, and a note as of ``picture_of``.

    An incomplete or damaged one raises ``TornPicture``, because decoders guess the rest.
    """
    if not data.startswith(START) or not data.rstrip(b"\0\r\n").endswith(END):
        raise TornPicture(f"an incomplete JPEG ({len(data)} bytes, without its {'end' if data.startswith(START) else 'start'})")
    with ErrorsAs(FrameError, lambda error: TornPicture(f"a damaged JPEG: {error}")):
        return picture_of(data)


def stamped_s(headers: dict[str, str]) -> float:
    """Time of exposure on the monotonic clock, from a part's headers; the present time if the headers do not state it."""
    now_s, unix_s = time.monotonic(), time.time()
    try:
        age_s = unix_s - float(headers[TIME_HEADER])
    except (KeyError, ValueError):
        return now_s
    return now_s - max(age_s, 0.0) if abs(age_s) < CLOCK_SLACK_S else now_s
