"""A view in a window, where there is a display and an OpenCV that can open one."""

import os
import re

import cv2
import numpy as np

QUIT = {ord("q"), 27}


def has_window() -> bool:
    """Whether a window can be opened here: a display, and an OpenCV that is not headless."""
    gui = re.search(r"GUI:\s*(\S+)", cv2.getBuildInformation())
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")) and gui is not None and gui[1] not in ("NONE", "NO")


class WindowView:
    """Shows pictures in a window; q or Esc closes it."""

    def __init__(self, title: str) -> None:
        self._title, self.url = title, "a window"

    def show(self, picture: np.ndarray, stats: dict) -> bool:
        """Show a picture (H, W, 3) RGB; False once the user closed it."""
        cv2.imshow(self._title, picture[..., ::-1])
        return cv2.waitKey(1) & 0xFF not in QUIT

    def __enter__(self) -> "WindowView":
        cv2.namedWindow(self._title, cv2.WINDOW_NORMAL)
        return self

    def __exit__(self, *_: object) -> None:
        cv2.destroyWindow(self._title)
