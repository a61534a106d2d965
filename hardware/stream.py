"""JPEG pictures over HTTP as multipart/x-mixed-replace: what a server of such a stream writes."""

from typing import Protocol

import cv2
import numpy as np

BOUNDARY = "frame"
CONTENT_TYPE = f"multipart/x-mixed-replace; boundary={BOUNDARY}"
JPEG_QUALITY = 95


def jpeg_of(image: np.ndarray) -> bytes:
    """A gray (H, W) or RGB (H, W, 3) picture as JPEG."""
    _, coded = cv2.imencode(".jpg", image if image.ndim == 2 else image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return coded.tobytes()


class Writable(Protocol):
    """What bytes can be written to."""

    def write(self, data: bytes, /) -> int | None: ...


def write_part(out: Writable, jpeg: bytes, headers: dict[str, object] | None = None) -> None:
    """Write one picture of a stream; ``OSError`` where the client has gone."""
    more = "".join(f"{name}: {value}\r\n" for name, value in (headers or {}).items())
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n{more}\r\n"
    out.write(head.encode("ascii") + jpeg + b"\r\n")
