"""JPEG and PNG pictures as cameras send them: where one ends, whether it is whole, and streams of them (multipart/x-mixed-replace)."""

import time
from collections.abc import Callable
from io import BufferedIOBase

import cv2
import numpy as np

from hardware.cameras.reader import TornPicture
from twin.errors import ErrorsAs, FrameError
from twin.frames.images import picture_of

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
# Second bytes of a JPEG's markers: start and end of a picture, start of a scan, those without content, and those inside a scan.
_START, _END, _SCAN = 0xD8, 0xD9, 0xDA
_BARE, _IN_SCAN = (0x01, *range(0xD0, 0xD9)), (0x00, *range(0xD0, 0xD8), 0xFF)


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
    at, scan = 2, False
    while data.startswith(JPEG):
        at = data.find(0xFF, at)
        if at < 0 or at + 1 >= len(data):
            return 0
        marker = data[at + 1]
        if marker == _END:
            return at + 2
        if marker == _START:  # the next picture
            return 0
        if scan and marker in _IN_SCAN or marker in _BARE:
            at += 1 if marker == 0xFF else 2
            continue
        if at + 3 >= len(data):
            return 0
        at, scan = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big"), marker == _SCAN
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
