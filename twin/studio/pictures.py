"""Makes the pictures and numbers of the page, without a browser."""

from collections.abc import Mapping
from enum import StrEnum
from html import escape

import cv2
import numpy as np

from twin.estimate import Estimate, readable_labels
from twin.pins.batch import FOUND_RGB, draw_overlay, voronoi_map
from twin.types import FloatArray, Frame, ImageArray, Observation

ARROW_RGB = (255, 140, 40)
"""Colour of the arrows of the pins' displacements."""
TOLD_APART_PX = 0.7
"""Length, px, below which displacements of pins are not drawn."""


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


def cell_picture(frame: Frame, seen: Observation, rest_px2: FloatArray) -> ImageArray:
    """(H, W, 3) uint8 RGB: the Voronoi cells by their change of area."""
    return np.asarray(voronoi_map(frame.image.shape[:2], seen, rest_px2), np.uint8)


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
        cells = f"<td>{escape(', '.join(filter(None, (label, unit))))}</td><td>{value:+.2f}</td><td>{low:+.2f} to {high:+.2f}</td>"
        rows.append(f"<tr>{cells}<td class='{kind}'>{true}</td></tr>")
    head = "<tr><th>estimate</th><th>value</th><th>90 % interval</th><th>truth</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>"


def number_table(rows: Mapping[str, str]) -> str:
    """HTML of names and values."""
    return "<table>" + "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows.items()) + "</table>"


STYLE = """<style>
.studio{font:13px/1.35 system-ui,sans-serif;padding:2px 6px}
.studio table{width:100%;border-collapse:collapse;font-variant-numeric:tabular-nums;margin:2px 0}
.studio td,.studio th{padding:1px 4px;text-align:right;font-weight:400}
.studio td:first-child,.studio th:first-child{text-align:left;color:#8a93a3}
.studio th{color:#8a93a3;border-bottom:1px solid #8a93a344}
.studio .badge{display:inline-block;border-radius:4px;padding:0 6px;margin:0 4px 2px 0;background:#8a93a333}
.studio .still{background:#2f9e4455}.studio .moving{background:#f08c0055}
.studio .good{color:#2f9e44}.studio .bad{color:#e03131}
.studio .note{color:#8a93a3;margin:2px 0}
.studio .stop{background:#e0313122;border-left:3px solid #e03131;padding:2px 6px;margin:3px 0}
.studio .said{border-left:3px solid #1c7ed6;padding:2px 6px;margin:3px 0}
</style>"""
"""CSS of the numbers, for light and dark pages."""


def numbers_html(*parts: str) -> str:
    """HTML of the page's numbers."""
    return f"{STYLE}<div class='studio'>{''.join(parts)}</div>"


def badge(text: str, kind: str = "") -> str:
    """HTML of a short remark about what is shown."""
    return f"<span class='badge {kind}'>{escape(text)}</span>"


def paragraph(text: str, kind: str) -> str:
    """HTML of a line; empty for an empty text."""
    return f"<p class='{kind}'>{escape(text)}</p>" if text else ""
