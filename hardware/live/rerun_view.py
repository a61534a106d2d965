"""A view in Rerun (``rerun-sdk``, an optional package): frame, pins, graph and estimates over time, in its viewer or in a file."""

from __future__ import annotations

import re
from pathlib import Path
from socket import create_connection
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np

from hardware.errors import DeviceError
from twin.errors import OptionError
from twin.studio.live_page import LiveFrame
from twin.types import Observation

if TYPE_CHECKING:
    import rerun

VIEWER, SUFFIX = "viewer", ".rrd"
# Longest wait, s, for a viewer, at the start and at the end. A new viewer needs a second or two.
ANSWER_S = 8.0


class RerunView:
    """Logs frames and estimates to Rerun. A context manager.

    Parameters
    ----------
    title : str
    target : str
        ``viewer`` (opened on this machine), a new file ``*.rrd``, or the address of a running viewer (``rerun+http://...``).

    Raises
    ------
    DeviceError
        The package is missing, the target is none of these, or the file already exists.
    """

    def __init__(self, title: str, target: str) -> None:
        if target != VIEWER and "://" not in target and not target.endswith(SUFFIX):
            raise OptionError(f"`rerun` {target}: expected '{VIEWER}', a file *{SUFFIX} or an address rerun+http://...")
        if target.endswith(SUFFIX) and "://" not in target and Path(target).exists():
            raise DeviceError(f"`rerun` {target}: exists already; give a new file, or remove it")
        try:
            import rerun
        except ImportError as error:
            raise DeviceError("`rerun` needs the package rerun-sdk; install it: pip install 'tactip-twin[rerun]'") from error
        self._rerun, self._title, self._target = rerun, title, target
        self._stream: rerun.RecordingStream | None = None
        self.url = "Rerun's viewer" if target == VIEWER else target

    def __enter__(self) -> RerunView:
        """Open the target.

        Raises
        ------
        DeviceError
            No viewer answers at the address, or the file can't be written.
        """
        stream = self._stream = self._rerun.RecordingStream(re.sub(r"\W+", "-", self._title))
        try:
            if self._target == VIEWER:
                stream.spawn()
            elif "://" in self._target:
                with create_connection(_address(self._target), timeout=ANSWER_S):  # reports a refusal at once and in few words
                    stream.connect_grpc(self._target)
            else:
                Path(self._target).parent.mkdir(parents=True, exist_ok=True)
                stream.save(self._target)
            stream.flush(timeout_sec=ANSWER_S)  # connecting itself reports no error, but flushing does
        except (RuntimeError, OSError, ValueError) as error:
            remedy = "start a viewer ('rerun' prints its address) and give rerun+http://HOST:9876/proxy, or a file"
            raise DeviceError(f"`rerun` {self._target}: can't be opened ({error}); {remedy} *{SUFFIX}") from error
        return self

    def __exit__(self, *_: object) -> None:
        stream = self._require_open()
        try:
            stream.flush(timeout_sec=ANSWER_S)
        except RuntimeError as error:
            raise DeviceError(f"`rerun` {self._target}: closed before the end ({error}); the last pictures are missing there") from error
        finally:
            stream.disconnect()

    def _require_open(self) -> rerun.RecordingStream:
        if self._stream is None:
            raise DeviceError(f"`rerun` {self._target}: not open; use the view as a context manager")
        return self._stream

    def show(self, live: LiveFrame, seen: Observation) -> None:
        """Log a frame with its pins and graph, the estimate's values with their intervals, and the lines, on ``frame`` and ``time``."""
        rerun, stream, frame, estimate = self._rerun, self._require_open(), live.frame, live.estimate
        stream.set_time("frame", sequence=frame.sequence)
        stream.set_time("time", duration=frame.time_s)
        stream.log("camera", rerun.Image(frame.image))
        if seen.valid and seen.graph is not None:
            nodes = seen.graph.nodes_px
            stream.log("camera/edges", rerun.LineStrips2D(nodes[np.asarray(seen.graph.edges)]))
            stream.log("camera/pins", rerun.Points2D(nodes))
        for name, value, low, high in zip(estimate.names, estimate.value, estimate.low, estimate.high, strict=True):
            stream.log(f"pose/{name}", rerun.Scalars([value, low, high]))
        stream.log("figures", rerun.TextDocument("\n".join(live.lines)))


def _address(target: str) -> tuple[str, int]:
    """Host and port of a viewer's address; raises ``ValueError`` if it has none."""
    parts = urlsplit(target)
    if not parts.hostname or not parts.port:
        raise ValueError("no host and port")
    return parts.hostname, parts.port
