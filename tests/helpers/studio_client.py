"""A client of the studio's page without a browser: it speaks viser's protocol over one websocket, as the page's own program does."""

import re
import threading
import time
from dataclasses import dataclass, field
from urllib.parse import urlsplit

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0), "fov": 1.0, "near": 0.1, "far": 100.0,
    "image_height": 800, "image_width": 1280, "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
# marks in the page's numbers: which answer they show, and at which depth
MARK = re.compile(r"data-number='(\d+)' data-depth='([-\d.]+)'")


@dataclass(frozen=True)
class Update:
    """What came in one message window: the numbers' HTML, and which scene nodes and controls changed."""

    time_s: float
    number: int
    depth_mm: float
    html: str
    nodes: frozenset[str]
    pictures: int


@dataclass
class StudioClient:
    """Connects, keeps the state that the server sends, and sends what a user does. A context manager."""

    url: str
    origin: str | None = None
    gui: dict[str, dict] = field(default_factory=dict)
    nodes: dict[str, dict] = field(default_factory=dict)
    updates: list[Update] = field(default_factory=list)

    def __enter__(self) -> "StudioClient":
        parts = urlsplit(self.url)
        origin = f"{parts.scheme}://{parts.netloc}" if self.origin is None else self.origin
        self._socket = connect(
            f"ws://{parts.netloc}", subprotocols=[f"viser-v{viser.__version__}"], origin=origin, max_size=None, compression=None
        )
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.send(CAMERA)
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join(timeout=5.0)

    def send(self, message: dict) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def drag(self, position: tuple[float, float, float], wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)) -> None:
        """Move the gizmo."""
        place = tuple(map(float, position))
        self.send({"type": "TransformControlsUpdateMessage", "name": "/wish", "wxyz": wxyz, "position": place, "owner": ""})

    def set(self, label: str, value: object) -> None:
        """Set a control, named by its label; a button is pressed by True."""
        self.send({"type": "GuiUpdateMessage", "uuid": self.uuid(label), "updates": {"value": value}})

    def uuid(self, label: str) -> str:
        found = [uuid for uuid, each in self.gui.items() if each.get("props", {}).get("label") == label]
        assert found, f"no control {label!r} among {sorted(str(each.get('props', {}).get('label')) for each in self.gui.values())}"
        return found[-1]

    def value(self, label: str) -> object:
        return self.gui[self.uuid(label)]["value"]

    def html(self) -> str:
        """All HTML that the page shows."""
        with self._news:
            shown = [each["props"] for each in self.gui.values() if each.get("props", {}).get("visible", True)]
            return "\n".join(props["content"] for props in shown if "content" in props)

    def wait(self, wanted, timeout_s: float = 30.0, *, since: int = 0) -> Update:
        """The first update from a place in ``updates`` on that is wanted."""
        end = time.monotonic() + timeout_s
        with self._news:
            while True:
                for update in self.updates[since:]:
                    if wanted(update):
                        return update
                since = len(self.updates)
                assert self._news.wait(end - time.monotonic()) and time.monotonic() < end, f"nothing came within {timeout_s} s"

    def _listen(self) -> None:
        try:
            for data in self._socket:
                self._take(data)
        except ConnectionClosed:
            pass
        with self._news:
            self._news.notify_all()

    def _take(self, data: bytes) -> None:
        plain, packed = (int.from_bytes(data[k : k + 8], "little") for k in (0, 8))
        window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed], max_output_size=plain))
        changed, pictures, number, depth, html = set(), 0, -1, 0.0, ""
        with self._news:
            for message in window["messages"]:
                kind = message["type"]
                if kind.startswith("Gui") and "props" in message:
                    self.gui[message["uuid"]] = message
                elif kind == "GuiRemoveMessage":
                    self.gui.pop(message["uuid"], None)
                elif kind == "GuiUpdateMessage" and message["uuid"] in self.gui:
                    element = self.gui[message["uuid"]]
                    for name, value in message["updates"].items():
                        (element if name == "value" else element["props"])[name] = value
                    pictures += "_data" in message["updates"]
                    text = message["updates"].get("content", "")
                    if mark := MARK.search(text):
                        number, depth, html = int(mark[1]), float(mark[2]), text
                elif "name" in message:
                    changed.add(message["name"])
                    self.nodes.setdefault(message["name"], {}).update(message)
            self.updates.append(Update(time.monotonic(), number, depth, html, frozenset(changed), pictures))
            self._news.notify_all()
