"""Makes the pictures, videos and numbers of the page, without a browser."""

import re
import time
from collections.abc import Callable, Mapping
from enum import StrEnum
from html import escape
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from twin.errors import TwinError
from twin.estimate import Estimate, readable_labels
from twin.pins.batch import FOUND_RGB, FULL_CHANGE, GRAY, area_colours, draw_overlay, voronoi_map
from twin.store import write_bytes
from twin.types import FloatArray, Frame, ImageArray, Observation

ARROW_RGB = (255, 140, 40)
"""Colour of the arrows of the pins' displacements."""
TOLD_APART_PX = 0.7
"""Length, px, below which displacements of pins are not drawn."""


CONTROLS = {"no_contact": "no-contact frame", "radius_mm": "dome radius, mm"}
"""Labels of the controls for arguments with another name."""


class OverlayChoices(StrEnum):
    """Choices of what is drawn over the camera's picture."""

    NOTHING = "picture alone"
    GRAPH = "pins and graph"
    WAYS = "trajectories of the pins"


def camera_picture(frame: Frame, seen: Observation, rest_px: FloatArray, drawn: OverlayChoices) -> ImageArray:
    """(H, W, 3) uint8 RGB: the frame alone, or with found pins and graph, or with the displacements of the pins."""
    if drawn is OverlayChoices.GRAPH:
        return draw_overlay(frame, seen, scale=1)
    image = frame.image if frame.image.ndim == 3 else cv2.cvtColor(frame.image, cv2.COLOR_GRAY2RGB)
    if drawn is OverlayChoices.NOTHING:
        return np.asarray(image, np.uint8)
    canvas = np.array(image, np.uint8)
    for start, stop in zip(rest_px, seen.pins_px, strict=True):
        if np.isfinite(stop).all():
            tip = tuple(map(int, np.rint(stop)))
            if np.linalg.norm(stop - start) > TOLD_APART_PX:
                cv2.arrowedLine(canvas, tuple(map(int, np.rint(start))), tip, ARROW_RGB, 1, cv2.LINE_AA, tipLength=0.3)
            else:
                cv2.circle(canvas, tip, 1, FOUND_RGB, -1)
    return canvas


def cell_picture(
    frame: Frame, seen: Observation, rest_px2: FloatArray, crop: Callable[[ImageArray], ImageArray] = lambda image: image
) -> ImageArray:
    """(h, w, 3) uint8 RGB: the cropped Voronoi cells by their change of area, with a scale below."""
    picture = np.array(crop(voronoi_map(frame.image.shape[:2], seen, rest_px2)), np.uint8)
    height, width = picture.shape[:2]
    low, high, top = width // 4, width - width // 4, height - height // 40 - 3
    picture[top - 4 :] = GRAY
    picture[top : height - 2, low:high] = area_colours(np.linspace(-1, 1, high - low))
    size = width / 900
    for text, x in ((f"{-100 * FULL_CHANGE:.0f} %", low - 0.15 * width), (f"{100 * FULL_CHANGE:+.0f} %", high + 0.03 * width)):
        cv2.putText(picture, text, (int(x), height - 3), cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def pins_found(seen: Observation) -> str:
    """How many pins were found, and why the result is not valid, if it is not."""
    return f"{seen.found} of {len(seen.pins_px)}" + ("" if seen.valid else f": {seen.reason}")


def estimate_table(estimate: Estimate | None, truth: Mapping[str, float], *, missing: str = "no model") -> str:
    """HTML of the estimate with its 90 % interval and the true value. A true value outside the interval is marked."""
    if estimate is None:
        return f"<p class='note'>Estimate: {escape(missing)}</p>"
    if not estimate.valid:
        return f"<p class='bad'>No estimate: {escape(estimate.reason)}</p>"
    rows = []
    titles = zip(estimate.names, readable_labels(estimate.names), estimate.units, strict=True)
    for (name, label, unit), value, low, high in zip(titles, estimate.value, estimate.low, estimate.high, strict=True):
        known = name in truth
        kind = "" if not known else ("good" if low <= truth[name] <= high else "bad")
        true = f"{truth[name]:+.2f}" if known else "-"
        named = label if label == name else f"{label} ({name})"  # its sign and zero are those of the recordings' column
        cells = f"<td>{escape(', '.join(filter(None, (named, unit))))}</td><td>{value:+.2f}</td><td>{low:+.2f} to {high:+.2f}</td>"
        rows.append(f"<tr>{cells}<td class='{kind}'>{true}</td></tr>")
    return f"<table><tr><th>estimate</th><th>value</th><th>90 % interval</th><th>truth</th></tr>{''.join(rows)}</table>"


def number_table(rows: Mapping[str, str]) -> str:
    """HTML of names and values."""
    return "<table>" + "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows.items()) + "</table>"


STYLE, DROP = (files(__package__).joinpath(name).read_text(encoding="utf-8") for name in ("studio.html", "drop.js"))
"""The page's stylesheet with the notice of a lost server, and the program that takes dropped files."""
PAGE = f'{STYLE}<img hidden src="data:," onerror="{escape(DROP)}">'
"""Both as HTML. A page runs no script that is added to it later, but it runs that of a picture that can't be loaded."""


def numbers_html(*parts: str, kind: str = "") -> str:
    """HTML of parts in the page's style; ``kind`` is one more class of it."""
    return f"<div class='studio {kind}'>{''.join(parts)}</div>"


def badge(text: str, kind: str = "") -> str:
    """HTML of a short remark about what is shown."""
    return f"<span class='badge {kind}'>{escape(text)}</span>"


def paragraph(text: str, kind: str) -> str:
    """HTML of a line; empty for an empty text. Arguments that the text names in backquotes become the names of the page's controls."""
    named = re.sub(r"`(\w+)`", lambda found: f"'{CONTROLS.get(found[1], found[1])}'", text)
    return f"<p class='{kind}'>{escape(named)}</p>" if text else ""


RATE_HZ = 15.0
"""Pictures per second of a video."""
LONGEST_S = 300.0
"""Time, s, after which a video ends by itself."""


class FilmWriter:
    """Writes pictures as an MP4, each for the time for which it was shown. The file appears when it is complete.

    Parameters
    ----------
    path : Path
        A new file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = TemporaryDirectory(prefix="tactip-video-")
        self._part = Path(self._folder.name) / "part.mp4"
        self._writer: cv2.VideoWriter | None = None
        self._size_px = (0, 0)
        self._begun_s, self._count = time.monotonic(), 0
        self._last: ImageArray | None = None

    def add(self, picture: ImageArray, *, at_s: float | None = None) -> None:
        """Show a picture (h, w, 3) RGB from now on, or from ``at_s``, s after the beginning.

        Raises
        ------
        TwinError
            OpenCV can't write MP4 files on this machine.
        """
        at_s = time.monotonic() - self._begun_s if at_s is None else at_s
        if at_s > LONGEST_S:
            return
        if self._writer is None:
            self._size_px = picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2
            self._writer = cv2.VideoWriter(str(self._part), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, self._size_px)
            if not self._writer.isOpened():
                raise TwinError(f"{self._path}: OpenCV can't write an MP4 here; save pictures instead")
            self._last = picture
        while self._last is not None and self._count < at_s * RATE_HZ:
            self._write(self._last)
        self._last = picture

    def _write(self, picture: ImageArray) -> None:
        assert self._writer is not None
        width, height = self._size_px
        canvas = np.zeros((height, width, 3), np.uint8)
        part = picture[:height, :width, ::-1]
        canvas[: part.shape[0], : part.shape[1]] = part
        self._writer.write(canvas)
        self._count += 1

    def close(self) -> str:
        """End the video, and return a line that states what was written.

        Raises
        ------
        StoreError
            The file can't be written.
        """
        if self._writer is None or self._last is None:
            self._folder.cleanup()
            return "no video: no picture was shown"
        self._write(self._last)
        self._writer.release()
        write_bytes(self._path, self._part.read_bytes())
        self._folder.cleanup()
        return f"saved {self._path} ({self._count / RATE_HZ:.1f} s)"
