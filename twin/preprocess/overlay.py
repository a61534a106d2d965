"""A picture of what the pipeline saw."""

from itertools import chain, count
from pathlib import Path

import cv2
import numpy as np

from twin.recordings.forms import gray_levels
from twin.types import Frame, Observation

# Colours of edges, found pins, places of lost pins, and rejected blobs.
EDGE_RGB, FOUND_RGB, LOST_RGB, EXTRA_RGB = (90, 110, 160), (60, 220, 60), (255, 60, 60), (255, 210, 0)
# What is drawn is at most this far from the frame's origin, px: farther off, OpenCV's integers would overflow.
FARTHEST_PX = 1e4


def draw_overlay(frame: Frame, observation: Observation, *, scale: int = 2) -> np.ndarray:
    """(H, W, 3) uint8 RGB: the frame, its graph, found pins (green), predicted places of lost ones (red), rejected blobs (yellow)."""
    gray = cv2.resize(gray_levels(frame.image), None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    canvas = cv2.cvtColor(gray // 2, cv2.COLOR_GRAY2RGB)

    def place(px: np.ndarray) -> list[list[int]]:
        px = px[np.isfinite(px).all(axis=1)]
        return np.round((np.clip(px, -FARTHEST_PX, FARTHEST_PX) + 0.5) * scale - 0.5).astype(int).tolist()

    if observation.graph is not None:
        nodes = place(observation.graph.nodes_px)
        for i, j in observation.graph.edges:
            if i < j:
                cv2.line(canvas, nodes[i], nodes[j], EDGE_RGB, 1, cv2.LINE_AA)
    for px in place(observation.pins_px):
        cv2.circle(canvas, px, 2, FOUND_RGB, -1, cv2.LINE_AA)
    for px in place(observation.predicted_px):
        cv2.circle(canvas, px, 5, LOST_RGB, 1, cv2.LINE_AA)
    for px in place(observation.extra_px):
        cv2.circle(canvas, px, 6, EXTRA_RGB, 1, cv2.LINE_AA)
    text = f"{frame.name}  {observation.found}/{len(observation.pins_px)}  {observation.reason}"
    cv2.putText(canvas, text, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def overlay_name(frame_name: str, taken: set[str]) -> str:
    """File name for a frame's picture, distinct from those in ``taken`` (in lower case), to which it is added."""
    stem = Path(frame_name).stem
    tries = chain((f"{stem}.png", f"{frame_name}.png"), (f"{stem}_{k}.png" for k in count(2)))
    name = next(name for name in tries if name.casefold() not in taken)
    taken.add(name.casefold())
    return name
