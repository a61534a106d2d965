"""A picture of one frame, and a window that shows such pictures.

The picture has pins and graph over the frame, the Voronoi map beside it, and pose and rates below. The window needs a display, and an
OpenCV that can open windows.
"""

import os
import re

import cv2
import numpy as np

from twin.pins.batch import GRAY, draw_overlay, voronoi_map
from twin.types import Frame, Observation

# Keys that close the window: q and Esc.
QUIT = {ord("q"), 27}
# Height of a line of text, and the margin around the text, in px.
TEXT_PX, MARGIN_PX = 18, 8
WHITE = (255, 255, 255)


def has_window() -> bool:
    """Whether a window can be opened here: a display, and an OpenCV that is not headless."""
    gui = re.search(r"GUI:\s*(\S+)", cv2.getBuildInformation())
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")) and gui is not None and gui[1] not in ("NONE", "NO")


class WindowView:
    """Shows pictures in a window; q or Esc closes it."""

    def __init__(self, title: str) -> None:
        self._title, self.url = title, "a window"

    def show(self, picture: np.ndarray, stats: dict[str, object]) -> bool:
        """Show a picture (H, W, 3) RGB; False once the user closed it."""
        cv2.imshow(self._title, picture[..., ::-1])
        return cv2.waitKey(1) & 0xFF not in QUIT

    def __enter__(self) -> "WindowView":
        cv2.namedWindow(self._title, cv2.WINDOW_NORMAL)
        return self

    def __exit__(self, *_: object) -> None:
        cv2.destroyWindow(self._title)


def draw_view(frame: Frame, seen: Observation, rest_area_px2: np.ndarray | None, lines: list[str]) -> np.ndarray:
    """(H, W, 3) uint8 RGB.

    Parameters
    ----------
    frame : Frame
    seen : Observation
        What the pipeline saw in it.
    rest_area_px2 : (N,) float, optional
        Cell areas without contact; without them no map is drawn.
    lines : list of str
        Text below.
    """
    left = draw_overlay(frame, seen, scale=1)
    picture = np.hstack([left, voronoi_map(frame.image.shape[:2], seen, rest_area_px2)])
    text = np.full((2 * MARGIN_PX + TEXT_PX * len(lines), picture.shape[1], 3), GRAY, np.uint8)
    for k, line in enumerate(lines):
        place = (MARGIN_PX, MARGIN_PX + TEXT_PX * k + TEXT_PX - 5)
        cv2.putText(text, line.encode("ascii", "replace").decode(), place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, WHITE, 1, cv2.LINE_AA)
    return np.vstack([picture, text])
