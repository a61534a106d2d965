"""A catalogue of odd camera servers, over real sockets: what they send, and whether it is read or refused, and how."""

import base64
import hashlib
import re
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count

import cv2
import numpy as np

USER, SECRET = "admin", "s3cret/pw"
"""A login with a character that needs a % code."""
PERIOD_S = 0.02
MULTIPART = "multipart/x-mixed-replace; boundary=frame"


def picture(number: int, size=(64, 48), colour: bool = True) -> np.ndarray:
    """A noisy picture."""
    shape = (size[1], size[0], 3) if colour else (size[1], size[0])
    return np.random.default_rng(number).integers(40, 220, shape, np.uint8)


def jpeg(number: int, *flags: int, size=(64, 48), colour: bool = True) -> bytes:
    return cv2.imencode(".jpg", picture(number, size, colour), [cv2.IMWRITE_JPEG_QUALITY, 90, *flags])[1].tobytes()


def png(number: int) -> bytes:
    return cv2.imencode(".png", picture(number))[1].tobytes()


def thumbnailed(number: int) -> bytes:
    """A JPEG whose APP1 segment contains a whole JPEG."""
    small = jpeg(number, size=(16, 16))
    whole = jpeg(number)
    return whole[:2] + b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small + whole[2:]


class Handler(BaseHTTPRequestHandler):
    """A request, with what the cases need."""

    protocol_version = "HTTP/1.1"
    served: "OddCamera"

    def do_GET(self):
        self.close_connection = True
        with suppress(OSError):
            self.server.camera.serve(self)

    def log_message(self, *_):
        pass

    def begin(self, kind=MULTIPART, code=200, **headers):
        self.send_response(code)
        if kind:
            self.send_header("Content-Type", kind)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def parts(self, write: Callable[[int], bytes]):
        for number in count():
            self.wfile.write(write(number))
            time.sleep(PERIOD_S)


def part(number: int, body: bytes | None = None, *, boundary="--frame", length=False, end=b"\r\n", line="\r\n", kind="image/jpeg") -> bytes:
    body = jpeg(number) if body is None else body
    size = f"Content-Length: {len(body)}{line}" if length else ""
    return f"{boundary}{line}Content-Type: {kind}{line}{size}{line}".encode() + body + end


@dataclass(frozen=True)
class OddCamera:
    """A case: its server, and a pattern of the refusal ("" if its pictures are read). ``login`` is put into the address."""

    serve: Callable[[Handler], None]
    refused: str = ""
    login: str = ""
    notes: str = ""


def stream(write, **begin):
    def serve(handler):
        handler.begin(**begin)
        handler.parts(write)

    return serve


def single(body: Callable[[int], bytes], kind="image/jpeg"):
    counter = count()

    def serve(handler):
        data = body(next(counter))
        handler.begin(kind, Content_Length=str(len(data)))
        handler.wfile.write(data)

    return serve


def answer(code, body=b"", kind="text/html", **headers):
    def serve(handler):
        handler.begin(kind, code, Content_Length=str(len(body)), **headers)
        handler.wfile.write(body)

    return serve


def chunked(handler):
    handler.begin(Transfer_Encoding="chunked")
    handler.parts(lambda number: (lambda data: f"{len(data):x}\r\n".encode() + data + b"\r\n")(part(number)))


def redirecting(code):
    def serve(handler):
        if handler.path.startswith("/moved"):
            handler.begin()
            handler.parts(part)
        else:
            handler.begin("text/html", code, Location="/moved/here?n=1", Content_Length="0")

    return serve


def circular(handler):
    handler.begin("text/html", 302, Location="/round", Content_Length="0")


def basic(handler):
    wanted = "Basic " + base64.b64encode(f"{USER}:{SECRET}".encode()).decode()
    if handler.headers.get("Authorization") != wanted:
        handler.begin("text/html", 401, WWW_Authenticate='Basic realm="camera"', Content_Length="0")
        return
    handler.begin()
    handler.parts(part)


def digest(handler):
    given = dict(re.findall(r'(\w+)="?([^",]*)"?', handler.headers.get("Authorization", "")))
    md5 = lambda text: hashlib.md5(text.encode()).hexdigest()  # noqa: E731
    one, two = md5(f"{USER}:camera:{SECRET}"), md5(f"GET:{handler.path}")
    wanted = md5(f"{one}:abc:{given.get('nc')}:{given.get('cnonce')}:auth:{two}")
    if given.get("response") != wanted:
        handler.begin("text/html", 401, WWW_Authenticate='Digest realm="camera", nonce="abc", qop="auth"', Content_Length="0")
        return
    handler.begin()
    handler.parts(part)


NUMBERS = count()


def closing(handler):
    handler.begin()
    handler.wfile.write(part(next(NUMBERS)))


def slow(number):
    time.sleep(0.3)
    return part(number)


def dripping(handler):
    handler.begin()

    def write(number):
        data = part(number)
        for at in range(0, len(data), 700):
            handler.wfile.write(data[at : at + 700])
            time.sleep(0.002)
        return b""

    handler.parts(write)


def silent(handler):
    handler.begin()
    time.sleep(30)


def not_http(handler):
    handler.wfile.write(b"ICY 200 OK\r\nServer: radio\r\n\r\n" + bytes(100))


def every_third_torn(number):
    return part(number, jpeg(number)[:700] if number % 3 == 2 else None)


LOGIN = f"{USER}:s3cret%2Fpw@"
CATALOGUE = {
    "with Content-Length": OddCamera(stream(lambda n: part(n, length=True))),
    "without Content-Length": OddCamera(stream(part)),
    "a wrong Content-Length": OddCamera(stream(lambda n: part(n).replace(b"image/jpeg", b"image/jpeg\r\nContent-Length: 17"))),
    "another boundary than stated": OddCamera(stream(lambda n: part(n, boundary="--myboundary"))),
    "boundary with quotes": OddCamera(stream(part, kind='multipart/x-mixed-replace;boundary="frame"')),
    "boundary stated with its dashes": OddCamera(stream(part, kind="multipart/x-mixed-replace; boundary=--frame")),
    "no boundary stated": OddCamera(stream(part, kind="multipart/x-mixed-replace")),
    "lines end with LF": OddCamera(stream(lambda n: part(n, line="\n", end=b"\n"))),
    "nothing between a picture and the next boundary": OddCamera(stream(lambda n: part(n, end=b""))),
    "parts without headers": OddCamera(stream(lambda n: b"--frame\r\n\r\n" + jpeg(n) + b"\r\n")),
    "headers in capitals, with a time": OddCamera(
        stream(lambda n: part(n).replace(b"Content-Type", b"X-TIMESTAMP: %.3f\r\nCONTENT-TYPE" % time.time()))
    ),
    "chunked": OddCamera(chunked),
    "PNGs": OddCamera(stream(lambda n: part(n, png(n), kind="image/png"))),
    "gray JPEGs": OddCamera(stream(lambda n: part(n, jpeg(n, colour=False)))),
    "progressive JPEGs": OddCamera(stream(lambda n: part(n, jpeg(n, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)))),
    "JPEGs with restart markers": OddCamera(stream(lambda n: part(n, jpeg(n, cv2.IMWRITE_JPEG_RST_INTERVAL, 2)))),
    "JPEGs with a thumbnail": OddCamera(stream(lambda n: part(n, thumbnailed(n)))),
    "JPEGs with zeros after them": OddCamera(stream(lambda n: part(n, jpeg(n) + bytes(64)))),
    "slow parts": OddCamera(stream(slow)),
    "parts in drips": OddCamera(dripping),
    "closes after each part": OddCamera(closing, notes=r"the camera was opened again \d+ times"),
    "redirected once": OddCamera(redirecting(302)),
    "moved for good": OddCamera(redirecting(301)),
    "basic login": OddCamera(basic, login=LOGIN),
    "digest login": OddCamera(digest, login=LOGIN),
    "a single JPEG": OddCamera(single(jpeg)),
    "a single PNG": OddCamera(single(png, "image/png")),
    "every third torn": OddCamera(
        stream(every_third_torn), notes=r"pictures left out, incomplete or damaged: \d+; the last: an incomplete JPEG"
    ),
    "text among the parts": OddCamera(
        stream(lambda n: part(n, b"hello", kind="text/plain") if n % 3 == 1 else part(n)), notes="neither a JPEG nor a PNG"
    ),
    # refused
    "redirected in a circle": OddCamera(circular, "answers 302 Found: look up the address"),
    "redirected to a file": OddCamera(answer(302, Location="file:///etc/passwd"), "answers 302 Found: look up the address"),
    "a login is missing": OddCamera(basic, r"answers 401 Unauthorized: it wants a login: give http://NAME:PASSWORD@HOST"),
    "a wrong login": OddCamera(basic, "answers 401 Unauthorized: .*it refuses this one", login=f"{USER}:hunter2@"),
    "a wrong digest login": OddCamera(digest, "answers 401 Unauthorized: .*it refuses this one", login=f"{USER}:hunter2@"),
    "forbidden": OddCamera(answer(403), "answers 403 Forbidden: it refuses this user or this computer"),
    "not found": OddCamera(answer(404, b"<html>no</html>"), "answers 404 Not Found: it has no such page; look up the path"),
    "busy": OddCamera(answer(503), "answers 503 Service Unavailable: it is busy"),
    "an HTML page": OddCamera(answer(200, b"<html><img src=x></html>"), "answers text/html: the page that shows the picture; give"),
    "no type": OddCamera(answer(200, b"x", kind=None), "answers nothing about its type: no picture or stream; a video"),
    "a film": OddCamera(answer(200, b"x", kind="video/mp4"), "answers video/mp4: no picture or stream; a video .*ffmpeg:http"),
    "an empty picture": OddCamera(answer(200, kind="image/jpeg"), "the last: 0 bytes that are neither a JPEG nor a PNG"),
    "an empty stream": OddCamera(lambda handler: handler.begin(), "the last: the stream ended; check camera and cable"),
    "a truncated JPEG": OddCamera(stream(lambda n: part(n, jpeg(n)[:-300])), r"the last: an incomplete JPEG \(\d+ bytes"),
    "damaged JPEGs": OddCamera(
        stream(lambda n: part(n, jpeg(n)[:2] + b"\xff\xc0\x00\x04\x08\x00" + jpeg(n)[2:])), "reads in a row failed, the last: .*JPEG"
    ),
    "no answer": OddCamera(lambda handler: time.sleep(30), "no answer .*timed out.*; start the stream or check the address"),
    "silent": OddCamera(silent, "no new frame"),
    "no HTTP": OddCamera(not_http, "no answer .*ICY"),
}
"""The cases by name."""


@contextmanager
def odd_camera(case: OddCamera):
    """The address of a case's server."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.camera = case
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    yield f"http://{case.login}127.0.0.1:{server.server_port}/video?user={USER}&pwd=hunter2"
    server.shutdown()
    server.server_close()
