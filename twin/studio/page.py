"""The page: server, panels, pictures, numbers, charts, uploaded files, the choice of the mode; and the page of live frames.

``twin live`` opens the page of live frames; the studio's mode 'Live' shows the same. Frames and estimates are handed in; this package does
not depend on the devices.
"""

import errno
import re
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from http import HTTPStatus
from io import BytesIO, StringIO
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar
from urllib.parse import urlsplit
from zipfile import BadZipFile, ZipFile

import numpy as np
import viser
import websockets.asyncio.server
from viser import uplot
from viser._messages import GuiUpdateMessage
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from scenes.base import SpecError
from scenes.files import quote
from scenes.sensor import SensorSpec
from twin.errors import TwinError
from twin.estimate import Estimate, readable_labels
from twin.pins.labelling.reference import Reference
from twin.store import writing
from twin.studio.camera import dome_part
from twin.studio.pictures import (
    PAGE,
    OverlayChoices,
    badge,
    camera_picture,
    cell_picture,
    estimate_table,
    numbers_html,
    paragraph,
    pins_found,
)
from twin.studio.state import next_path
from twin.types import Frame, ImageArray, Observation

if TYPE_CHECKING:
    from twin.studio.modes.mode import PageMode

Value = TypeVar("Value")
Control = TypeVar("Control", bound=viser.GuiInputHandle[Any])

LOCAL = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine reaches."""
PORTS_TRIED, MOST_PORT = 100, 65535
"""Number of consecutive ports that are tried, and the largest port."""
PICTURES_PX, LARGE_PX, CONTROLS_PX = 330, 620, 390
"""Widths, px, of the panel with the pictures beside the scene and without the scene, and of the panel with the controls."""
NO_SCENE = "<style>@media (max-width: 36em) { .mantine-Paper-root:has(.studio) { height: 100%; max-height: 100% !important; } }</style>"
"""Style without a scene: in a narrow window the pictures and controls have its place."""
JPEG_QUALITY = 88
"""Quality of the JPEG pictures in the page."""
CELLS = "change of the Voronoi cells' areas"
"""Caption of the second picture at the start."""
ARCHIVES = ".zip,.mp4,.avi,.mkv,.mov"
"""Kinds of files with frames that can be uploaded."""
SPAN_S = 20.0
"""Time that the charts show, s."""
CHART_S = 0.25
"""Shortest interval in s between two drawings of the charts."""
CHART_PX = 170
"""Height of a chart, px."""
LINES = ("#4dabf7", "#ff922b", "#51cf66", "#f06595", "#ffd43b", "#845ef7")
"""Colours of a chart's lines."""
MOST_UNPACKED_GB = 4
"""Largest size of the content of an uploaded archive."""
CHANGE_S = 10.0
"""Longest wait, s, for changes of the page."""


def value_of(control: viser.GuiInputHandle[str], kind: Callable[[str], Value], now: str) -> Value:
    """A choice's value as a ``kind``. One that no browser gives is replaced by the present value ``now``.

    Raises
    ------
    TwinError
        It is no such value.
    """
    given = control.value
    try:
        return kind(given)
    except ValueError:
        put(control, now)
        raise TwinError(f"'{quote(given)}' is not a value of this control; choose one that the page offers") from None


def put(control: viser.GuiInputHandle[Any], value: object, *, send: bool = False) -> None:
    """Set a control's value in all browsers.

    Parameters
    ----------
    send : bool
        Send the value although the control has it. A browser may show another one: its own change and a change by this program can
        cross on their path.
    """
    if send and control.value == value:
        control._impl.gui_api._websock_interface.queue_message(GuiUpdateMessage(control._impl.uuid, {"value": value}))
    setattr(control, "value", value)  # noqa: B010  # by its annotations the value can't be set


class _ViserServer(viser.ViserServer):
    """viser's server without its tunnel to an external server."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Does nothing, so that the page never gets an address outside this machine."""
        return None


def from_own_page(request: Request, hosts: Sequence[str]) -> bool:
    """Whether a request comes from a page of this server, or from a program that is no browser.

    A browser lets any site open a websocket to this machine, and any site may have a name that leads here. It states the site in the header
    ``Origin`` ("null" for a local file or a frame without rights), and the name that was used in ``Host``.

    Parameters
    ----------
    hosts : sequence of str
        Names by which this machine may be called; if empty, by any.
    """
    used = request.headers.get_all("Host")
    try:
        host = urlsplit("//" + used[0]) if len(used) == 1 else None
        origins = [urlsplit(origin) for origin in request.headers.get_all("Origin")]
    except ValueError:  # no address
        return False
    if host is None or (hosts and host.hostname not in hosts):
        return False
    return all(origin.scheme in ("http", "https") and origin.netloc.lower() == host.netloc.lower() for origin in origins)


@contextmanager
def guarded_server(hosts: Sequence[str], report: Callable[[str], None]) -> Iterator[None]:
    """Context in which a new viser server refuses requests of foreign pages, and reports the address of each loaded page that has a query.

    A foreign page is refused before its connection is open, so that none of its messages is read (see ``from_own_page``). viser itself
    ignores queries. Those that a page of another site links to are ignored, because such a page could load this page with any query without
    the user's knowledge. The browser states the origin in ``Sec-Fetch-Site``.
    """
    serve = websockets.asyncio.server.serve

    def serving(*args: Any, process_request: Callable[[ServerConnection, Request], Response | None] | None = None, **more: Any) -> Any:
        def answer_request(connection: ServerConnection, request: Request) -> Response | None:
            if not from_own_page(request, hosts):
                return connection.respond(HTTPStatus.FORBIDDEN, "only the page of the studio may connect\n")
            address = urlsplit(request.path)
            if address.path == "/" and address.query and request.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin"):
                report(request.path)
            return None if process_request is None else process_request(connection, request)

        return serve(*args, process_request=answer_request, **more)

    websockets.asyncio.server.serve = serving  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def free_port(host: str, port: int) -> int:
    """The port, or the next larger one on which this machine can listen; 0 is returned as 0.

    viser itself would try a thousand ports, and then wait forever.

    Raises
    ------
    OSError
        The host is no address of this machine, or no such port is free.
    """
    for candidate in range(port, min(port + PORTS_TRIED, MOST_PORT + 1)):
        try:
            with socket.create_server((host, candidate), family=socket.AF_INET6 if ":" in host else socket.AF_INET):
                return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    raise OSError(errno.EADDRINUSE, f"no port from {port} on is free")


def keep_upload(folder: Path, name: str, content: bytes) -> Path:
    """Store an uploaded file in a new folder ``upload-NUMBER``, and return its path. An archive is unpacked: the path is its folder's.

    Raises
    ------
    TwinError
        The archive is damaged or too large, or nothing can be written.
    """
    safe = re.sub(r"[^\w.-]+", "_", name).lstrip(".") or "file"
    place = next_path(folder, "upload", "")
    with writing(place):
        place.mkdir()
        if not safe.lower().endswith(".zip"):
            (place / safe).write_bytes(content)
            return place / safe
        try:
            with ZipFile(BytesIO(content)) as archive:
                if sum(each.file_size for each in archive.infolist()) > 1e9 * MOST_UNPACKED_GB:
                    raise TwinError(f"{safe}: more than {MOST_UNPACKED_GB} GB unpacked; give the folder's path on the studio's machine")
                archive.extractall(place)  # never writes outside of the folder
        except (BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
            raise TwinError(f"{safe}: no readable archive ({error}); upload a .zip of a folder of frames") from error
    inside = list(place.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else place


class LineChart:
    """Chart of lines over the last seconds. It appears with its first values.

    Parameters
    ----------
    page : Page
    title : str
    """

    def __init__(self, page: "StudioPage", title: str) -> None:
        self._page, self._title = page, title
        self._order, self._visible = page.next_chart(), True
        self._plot: viser.GuiUplotHandle | None = None
        self._names: tuple[str, ...] = ()
        self._points: deque[tuple[float, ...]] = deque()
        self._drawn_s = 0.0

    def add(self, values: Mapping[str, float]) -> None:
        """Add the present value of each line. Other lines than before begin a new chart; without values nothing changes."""
        if not values:
            return
        now = time.monotonic()
        if tuple(values) != self._names:
            self._names = tuple(values)
            self._points.clear()
            self._draw_anew()
        self._points.append((now, *values.values()))
        while self._points[0][0] < now - SPAN_S:
            self._points.popleft()
        if self._plot is not None and now - self._drawn_s > CHART_S:
            self._drawn_s = now
            times, *lines = np.array(self._points).T
            self._plot.data = (times - now, *lines)

    def show(self, visible: bool) -> None:
        """Show or hide the chart. It goes on to collect values."""
        self._visible = visible
        if self._plot is not None:
            self._plot.visible = visible

    def _draw_anew(self) -> None:
        if self._plot is not None:
            self._plot.remove()
        lines: list[uplot.Series] = [{"label": name, "stroke": rgb, "width": 2} for name, rgb in zip(self._names, LINES, strict=False)]
        faint: uplot.Axis_Grid = {"stroke": "#8a93a333", "width": 1}
        axis: uplot.Axis = {"stroke": "#8a93a3", "size": 50, "grid": faint, "ticks": {**faint, "size": 4}}
        with self._page.charts_tab:
            self._plot = self._page.gui.add_uplot(
                (np.zeros(1),) * (len(lines) + 1),
                ({"label": "s"}, *lines),
                title=self._title,
                height=CHART_PX,
                axes=({**axis, "size": 24}, axis),
                scales={"x": {"time": False, "range": (-SPAN_S, 0.0)}},
                legend={"show": True, "live": False},
                padding=(12, 16, 0, 0),
                order=self._order,
                visible=self._visible,
            )


class StudioPage:
    """The page, served to any number of browsers, which all show the same state. A context manager.

    Parameters
    ----------
    title : str
    host, port : str, int
        Address on which to listen. If the port is used already, the next free one is taken, see ``url``.
    modes : sequence of str
        Titles of the modes among which the user chooses.
    saves : Path
        Folder for uploaded files.

    Attributes
    ----------
    on_address : callable
        Called in the server's event loop with path and query of the address of each page that is loaded with a query.

    Raises
    ------
    TwinError
        The server can't listen on this host and port.
    """

    def __init__(self, title: str, *, host: str, port: int, modes: Sequence[str] = (), saves: Path = Path()) -> None:
        self.on_address: Callable[[str], None] = lambda address: None
        try:
            port = free_port(host, port)
            hosts = LOCAL if host in LOCAL else ()
            with redirect_stdout(StringIO()), guarded_server(hosts, lambda address: self.on_address(address)):  # viser prints its addresses
                self.server = _ViserServer(host=host, port=port, label=title, verbose=False)
        except (OSError, RuntimeError) as error:
            raise TwinError(f"`host` {host} `port` {port}: can't listen there ({error}); give another `host` or `port`") from error
        self._host, self._saves = host, saves
        gui = self.gui = self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        pictures = gui.add_panel(order=0)
        with pictures.add_tab("Camera"):
            self._absent = gui.add_html("")
            empty = np.zeros((8, 8, 3), np.uint8)
            shown = [gui.add_image(empty, label="", format="jpeg", jpeg_quality=JPEG_QUALITY, visible=False) for _ in range(2)]
            self._camera, self._cells = shown
        self.charts_tab = pictures.add_tab("Charts")
        with self.charts_tab:  # PAGE hides this beside a chart
            none = "There is no chart. Forces and estimates of the modes Twin and Live give charts."
            gui.add_html(numbers_html(paragraph(none, "absent"), kind="charts"))
        self.next_chart = count().__next__
        self._panel = pictures
        pictures.dock_left()
        pictures.set_width(LARGE_PX)
        pictures.expand()  # in a narrow window, too
        gui.main_panel.dock_right()
        gui.main_panel.set_width(CONTROLS_PX)
        self._style = gui.add_html(PAGE)
        self._said = gui.add_html("", visible=False)
        self._choice = gui.add_dropdown("mode", tuple(modes), initial_value=modes[0]) if modes else None
        self._numbers = gui.add_html(numbers_html())
        self._said_count = 0
        self._modes: dict[str, PageMode] = {}
        self._mode: str = ""

    @property
    def url(self) -> str:
        """Address of the page on this machine."""
        shown = "127.0.0.1" if self._host in ("0.0.0.0", "::") else self._host
        return f"http://{shown}:{self.server.get_port()}/"

    @property
    def mode(self) -> "PageMode":
        """The mode that the user has chosen."""
        return self._modes[self._mode]

    def set_modes(self, modes: Sequence["PageMode"]) -> None:
        """Offer these modes, and enter the first one."""
        self._modes = {mode.title: mode for mode in modes}
        if self._choice is not None:
            self._choice.on_update(lambda event: self.choose(event.target.value))
        self.choose(modes[0].title)

    def choose(self, title: str) -> None:
        """Enter a mode."""
        if title == self._mode or title not in self._modes:
            return
        if self._mode:
            self.mode.leave()
        self._mode = title
        for name, mode in self._modes.items():
            mode.folder.visible = name == title
        if self._choice is not None and self._choice.value != title:
            put(self._choice, title)
        self.server.scene.set_global_visibility(self.mode.has_scene)
        self._style.content = PAGE if self.mode.has_scene else PAGE + NO_SCENE
        self._panel.set_width(PICTURES_PX if self.mode.has_scene else LARGE_PX)
        self.mode.enter()

    def show_pictures(self, camera: ImageArray, below: ImageArray, label: str, label_below: str = CELLS) -> None:
        """Show two pictures (h, w, 3) RGB with their captions."""
        self._absent.content = ""
        for shown, image, caption in ((self._camera, camera, label), (self._cells, below, label_below)):
            shown.image, shown.label, shown.visible = image, caption, True

    def show_nothing(self, why: str) -> None:
        """Remove pictures and numbers of another mode, and show at their place what to do or what will follow."""
        self._camera.visible = self._cells.visible = False
        self._absent.content = numbers_html(paragraph(why, "absent"))
        self.show_numbers()

    def show_numbers(self, *parts: str) -> None:
        """Show parts of HTML above the controls, in a box of a fixed height so that the controls keep their places."""
        self._numbers.content = numbers_html(*parts, kind="numbers") if parts else ""

    def together(self, change: Callable[[], None]) -> None:
        """Make changes that all browsers get at once, and wait until they are made.

        They are made in the server's event loop. Therefore the server can't send a part of them in between.
        """
        done: Future[None] = Future()

        def call() -> None:
            try:
                change()
                done.set_result(None)
            except BaseException as error:
                done.set_exception(error)

        try:
            self.server.get_event_loop().call_soon_threadsafe(call)
        except RuntimeError:  # the server has been stopped
            return
        done.result(CHANGE_S)
        self.server.flush()

    def guard(self, action: Callable[[], object]) -> Callable[[object], None]:
        """A callback of a control that calls ``action`` and shows the user's errors. Changes that this program makes do nothing."""

        def call_action(event: object) -> None:
            if getattr(event, "client", self) is None:
                return
            self.hush()
            try:
                action()
            except (TwinError, SpecError) as error:
                self.say(str(error), bad=True)

        return call_action

    def watch(self, control: Control, action: Callable[[], object]) -> Control:
        """Call an action (see ``guard``) at each change of a control, which is returned."""
        control.on_update(self.guard(action))
        return control

    def button(self, label: str, action: Callable[[], object], **options: Any) -> None:
        """Add a button that calls an action (see ``guard``)."""
        self.gui.add_button(label, **options).on_click(self.guard(action))

    def upload(self, label: str, kinds: str, take: Callable[[str], object], *, hint: str) -> None:
        """Add a button for a file of some kinds (".stl,.obj"); ``take`` is called with the path at which it is stored."""
        button = self.gui.add_upload_button(label, mime_type=kinds, hint=hint)
        button.on_upload(self.guard(lambda: take(str(keep_upload(self._saves, button.value.name, button.value.content)))))

    def upload_frames(self, take: Callable[[str], object]) -> None:
        """Add a button for frames, as ``upload`` does; an archive is unpacked."""
        self.upload("Upload frames (zip or video)", ARCHIVES, take, hint="or drop a folder, an archive or a video on the page")

    def say(self, text: str, *, bad: bool = False) -> None:
        """Show a message for some seconds."""
        self._said_count += 1  # so that the same message begins anew
        self._said.content = numbers_html(paragraph(text, "stop" if bad else "said"), kind=f"message n{self._said_count}")
        self._said.visible = True

    def hush(self) -> None:
        """Hide the message: the user does something else."""
        self._said.visible = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with redirect_stdout(StringIO()):  # viser prints that it has stopped
            self.server.stop()


CHARTED = 3
"""Number of labels that the chart shows."""


@dataclass(frozen=True)
class LiveFrame:
    """A live frame, the model's estimate, and lines about rates and losses."""

    frame: Frame
    estimate: Estimate
    lines: tuple[str, ...]


def frame_pictures(
    sensor: SensorSpec, reference: Reference, frame: Frame, seen: Observation, drawn: OverlayChoices = OverlayChoices.GRAPH
) -> tuple[ImageArray, ImageArray]:
    """The dome's part of a frame with its overlay, and its Voronoi cells by their change of area; (h, w, 3) uint8 RGB each."""

    def crop(image: ImageArray) -> ImageArray:
        return dome_part(sensor, image, frame.form)

    return crop(camera_picture(frame, seen, reference.pins_px, drawn)), cell_picture(frame, seen, reference.area_px2, crop)


def frame_numbers(live: LiveFrame, seen: Observation) -> list[str]:
    """HTML of the estimate, the number of found pins, and the lines."""
    return [estimate_table(live.estimate, {}), *(paragraph(line, "note") for line in (f"pins found: {pins_found(seen)}", *live.lines))]


def chart_values(estimate: Estimate) -> dict[str, float]:
    """The values for the chart, by label; none without an estimate."""
    named = zip(readable_labels(estimate.names)[:CHARTED], estimate.value, strict=False)
    return {name: float(value) for name, value in named} if estimate.valid else {}


class LivePage(StudioPage):
    """A page that shows live frames to any number of browsers. A context manager.

    Parameters
    ----------
    title : str
    sensor : SensorSpec
    reference : Reference
        Pins at rest.
    host, port : str, int
        As for ``StudioPage``.

    Raises
    ------
    TwinError
        The server can't listen on this host and port.
    """

    def __init__(self, title: str, sensor: SensorSpec, reference: Reference, *, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(title, host=host, port=port)
        self._title, self._sensor, self._reference = title, sensor, reference
        self._chart = LineChart(self, "live estimates")
        self.show_nothing("Waiting for the first frame.")

    def show(self, live: LiveFrame, seen: Observation) -> None:
        """Show a frame with the pipeline's observation of it. Browsers get pictures and numbers together."""
        pictures = frame_pictures(self._sensor, self._reference, live.frame, seen)
        numbers = [badge("live", "moving"), paragraph(self._title, "note"), *frame_numbers(live, seen)]

        def change() -> None:
            self.show_pictures(*pictures, f"live {live.frame.form} frame {live.frame.sequence}")
            self.show_numbers(*numbers)
            self._chart.add(chart_values(live.estimate))

        self.together(change)
