"""A camera that is read over HTTP: a stream of JPEGs or PNGs (multipart/x-mixed-replace), or the address of a single picture."""

import contextlib
import http.client
import re
import socket
import time
import urllib.request
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit

from hardware.cameras import reader
from hardware.cameras.coded import Parts, decode_picture, on_own_clock
from hardware.cameras.reader import DevicePicture, LiveSource, ReadFailed, TornPicture
from hardware.errors import DeviceError
from scenes.files import quote
from scenes.sensor import SensorSpec
from twin.errors import ErrorsAs
from twin.types import Form

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
                try:
                    image, note = decode_picture(data)
                except TornPicture:
                    self._end.wait(reader.FAILED_PAUSE_S)  # it may be about to be replaced
                    raise
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
