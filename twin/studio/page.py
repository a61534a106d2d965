"""The page's frame: server, panels, pictures, numbers, charts, and the choice of the mode."""

import errno
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np
import viser
import websockets.asyncio.server
from viser import uplot
from viser.infra import WebsockClientConnection
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from scenes.base import SpecError
from twin.errors import TwinError
from twin.studio.pictures import boxed, paragraph
from twin.types import ImageArray

LOCAL = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine reaches."""
PORTS_TRIED, MOST_PORT = 100, 65535
"""Number of ports that are tried one after the other, and the largest port."""
PICTURES_PX, CONTROLS_PX = 330, 350
"""Widths of the panels with the pictures and with the controls."""
JPEG_QUALITY = 88
"""Quality of the JPEG pictures in the page."""
CELLS = "Voronoi cells: blue smaller, red larger"
"""Content of the second picture at the start."""
SPAN_S = 20.0
"""Time that the charts show, s."""
CHART_S = 0.25
"""Shortest interval in s between two drawings of the charts."""
CHART_PX = 165
"""Height of a chart."""
LINES = ("#4dabf7", "#ff922b", "#51cf66", "#f06595", "#ffd43b", "#845ef7")
"""Colours of a chart's lines."""
CHANGE_S = 10.0
"""Longest wait in s for changes of the page."""
SAID_S = 12.0
"""Time in s for which a message stays."""


class Mode(Protocol):
    """What the page knows of a mode."""

    @property
    def title(self) -> str:
        """By which the user chooses it."""

    folder: viser.GuiFolderHandle

    def enter(self) -> None:
        """The user has chosen the mode: show its state."""

    def leave(self) -> None:
        """The user has chosen another mode."""


def put(control: viser.GuiInputHandle[Any], value: object) -> None:
    """Set a control's value in all browsers."""
    setattr(control, "value", value)  # noqa: B010  # by its annotations the value can't be set


class _Server(viser.ViserServer):
    """viser's server without its tunnel to a server elsewhere."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No address outside this machine is ever made."""
        return None


def refuse_foreign_pages(server: viser.ViserServer, hosts: Sequence[str]) -> None:
    """Close connections of pages that other sites have served, or that reached this server under a foreign name.

    A browser lets any site open a websocket to this machine, and it tells in ``Origin`` which site it is.
    """
    websocket_server = server._websock_server

    async def check(connection: WebsockClientConnection) -> None:
        socket = websocket_server._live_connections.get(connection.client_id)
        if socket is None or socket.request is None:
            return
        origin, host = (
            urlsplit(text) for text in (socket.request.headers.get("Origin", ""), "//" + socket.request.headers.get("Host", ""))
        )
        if (origin.netloc and origin.netloc != host.netloc) or (hosts and host.hostname not in hosts):
            await socket.close(1008, "only the studio's own page may connect")

    websocket_server.on_client_connect(check)


@contextmanager
def told_addresses(tell: Callable[[str], None]) -> Iterator[None]:
    """A server of viser that is made here tells the address of each page that is loaded, if it has a query: viser itself reads none.

    A page of another site is not heard: it could load this page with any query, unseen. A browser tells so in ``Sec-Fetch-Site``.
    """
    serve = websockets.asyncio.server.serve

    def serving(*args: Any, process_request: Callable[[ServerConnection, Request], Response | None] | None = None, **more: Any) -> Any:
        def heard(connection: ServerConnection, request: Request) -> Response | None:
            address = urlsplit(request.path)
            if address.path == "/" and address.query and request.headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin"):
                tell(request.path)
            return None if process_request is None else process_request(connection, request)

        return serve(*args, process_request=heard, **more)

    websockets.asyncio.server.serve = serving  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def free_port(host: str, port: int) -> int:
    """The port, or the next one above it on which this machine can listen; 0 stays 0.

    viser itself would try a thousand ports, and then wait for ever.

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


class Chart:
    """Lines over the last seconds.

    Parameters
    ----------
    gui : viser.GuiApi
    title : str
    names : sequence of str
    dashed : sequence of str
        Those of them that are drawn dashed.
    """

    def __init__(self, gui: viser.GuiApi, title: str, names: Sequence[str], *, dashed: Sequence[str] = ()) -> None:
        self._points: deque[tuple[float, list[float]]] = deque()
        self._drawn_s = 0.0
        lines: list[uplot.Series] = [{"label": "s"}]
        for name, colour in zip(names, LINES, strict=False):
            lines.append({"label": name, "stroke": colour, "width": 2, **({"dash": (6, 4)} if name in dashed else {})})
        axis: uplot.Axis = {"stroke": "#8a93a3", "size": 34, "grid": {"stroke": "#8a93a333", "width": 1}}
        self._plot = gui.add_uplot(
            self._arrays(len(names)),
            tuple(lines),
            title=title,
            height=CHART_PX,
            axes=({**axis, "size": 26}, axis),
            scales={"x": {"time": False, "range": (-SPAN_S, 0.0)}},
            legend={"show": True},
        )
        self._count = len(names)

    def add(self, values: Sequence[float]) -> None:
        """Add the values of now, NaN where there is none."""
        now = time.monotonic()
        self._points.append((now, list(values)))
        while self._points[0][0] < now - SPAN_S:
            self._points.popleft()
        if now - self._drawn_s > CHART_S:
            self._drawn_s = now
            self._plot.data = self._arrays(self._count)

    def _arrays(self, count: int) -> tuple[np.ndarray, ...]:
        if not self._points:
            return tuple(np.zeros(1) for _ in range(count + 1))
        now = self._points[-1][0]
        times, values = zip(*self._points, strict=True)
        return (np.array(times) - now, *np.array(values, float).T)


class Page:
    """The page, served to any number of browsers, which all see the same state. A context manager.

    Parameters
    ----------
    title : str
    host, port : str, int
        Where to listen. If the port is taken, the next free one is used, see ``url``.

    Attributes
    ----------
    on_address : callable
        Called with path and query of the address of each page that is loaded with a query; in the server's event loop.

    Raises
    ------
    TwinError
        Nothing can listen there.
    """

    def __init__(self, title: str, *, host: str, port: int) -> None:
        self.on_address: Callable[[str], None] = lambda address: None
        try:
            port = free_port(host, port)
            with redirect_stdout(StringIO()), told_addresses(lambda address: self.on_address(address)):  # it prints its own addresses
                self.server = _Server(host=host, port=port, label=title, verbose=False)
        except (OSError, RuntimeError) as error:
            raise TwinError(f"--host {host} --port {port}: can't listen there ({error}); give another --host or --port") from error
        self._host = host
        refuse_foreign_pages(self.server, LOCAL if host in LOCAL else ())
        gui = self.gui = self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        pictures = gui.add_panel(order=0)
        with pictures.add_tab("Camera"):
            empty = np.zeros((8, 8, 3), np.uint8)
            self._camera = gui.add_image(empty, label="camera", format="jpeg", jpeg_quality=JPEG_QUALITY)
            self._cells = gui.add_image(empty, label=CELLS, format="jpeg", jpeg_quality=JPEG_QUALITY)
        self.charts_tab = pictures.add_tab("Charts")
        pictures.dock_left()
        pictures.set_width(PICTURES_PX)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(CONTROLS_PX)
        self._numbers = gui.add_html(boxed())
        self._said = gui.add_html("", visible=False)
        self._forget_s = 0.0
        self._modes: dict[str, Mode] = {}
        self._mode: str = ""
        self._choice: viser.GuiDropdownHandle[str] | None = None

    @property
    def url(self) -> str:
        """Address of the page on this machine."""
        shown = "127.0.0.1" if self._host in ("0.0.0.0", "::") else self._host
        return f"http://{shown}:{self.server.get_port()}/"

    @property
    def mode(self) -> Mode:
        """The mode that the user has chosen."""
        return self._modes[self._mode]

    def set_modes(self, modes: Sequence[Mode]) -> None:
        """Offer modes; the first one is entered."""
        self._modes = {mode.title: mode for mode in modes}
        if self._choice is not None:
            self._choice.options = tuple(self._modes)

            @self._choice.on_update
            def _(event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
                self.choose(event.target.value)

        self.choose(modes[0].title)

    def add_mode_choice(self, titles: Sequence[str]) -> None:
        """Put the control in which the user chooses a mode here."""
        self._choice = self.gui.add_dropdown("mode", tuple(titles), initial_value=titles[0])

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
        self.mode.enter()

    def show_pictures(self, camera: ImageArray, below: ImageArray, label: str, label_below: str = CELLS) -> None:
        """Show two pictures (h, w, 3) RGB with what they are."""
        self._camera.label, self._cells.label = label, label_below
        self._camera.image, self._cells.image = camera, below

    def show_nothing(self, why: str) -> None:
        """Take pictures and numbers of another mode away, and say what is to come."""
        empty = np.zeros((8, 8, 3), np.uint8)
        self.show_pictures(empty, empty, "no picture yet", "")
        self.show_numbers(paragraph(why, "note"))

    def show_numbers(self, *parts: str) -> None:
        """Show pieces of HTML above the controls."""
        self._numbers.content = boxed(*parts)
        if self._said.visible and time.monotonic() > self._forget_s:
            self._said.visible = False

    def together(self, change: Callable[[], None]) -> None:
        """Make changes that all browsers get at once, never a part of them, and wait until they are made.

        They are made in the server's event loop, which therefore can't send in between.
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

    def guarded(self, action: Callable[[], None]) -> Callable[[object], None]:
        """A callback of a control that does an action, and says what the user did wrong. Changes by this program do nothing."""

        def called(event: object) -> None:
            if getattr(event, "client", self) is None:
                return
            try:
                action()
            except (TwinError, SpecError) as error:
                self.say(str(error), bad=True)

        return called

    def say(self, text: str, *, bad: bool = False) -> None:
        """Show a line for some seconds."""
        self._said.content = boxed(paragraph(text, "stop" if bad else "said"))
        self._said.visible = True
        self._forget_s = time.monotonic() + SAID_S

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        with redirect_stdout(StringIO()):  # it says that it has stopped
            self.server.stop()
