"""Decodes AV1 video in MP4 files, the codec of LeRobot's data sets, which OpenCV's own video decoder lacks.

A sequence of AVIF pictures is such a file with two other labels (AV1 Image File Format, 4). Pillow reads such sequences.
"""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, features

from scenes.files import read_regular

LARGEST_BYTES = 4_000_000_000
"""Largest size of a video; it is held in memory. LeRobot makes files of 200 MB."""
HANDLER_AT, LABEL = 12, 4
"""Place of a track's kind behind the name of its box ``hdlr``, and the number of letters of a label."""
MS_PER_S = 1e3


def decode_av1(path: Path) -> Iterator[tuple[int, float, np.ndarray | None, str]]:
    """Index, time (s), picture (H, W, 3), uint8 RGB, and "" of each frame; None and the reason for a frame that can't be decoded."""
    index, time_ms = 0, 0.0
    try:
        with Image.open(io.BytesIO(_as_pictures(path))) as pictures:
            for index in range(getattr(pictures, "n_frames", 1)):
                try:
                    pictures.seek(index)
                    image, time_ms = np.asarray(pictures.convert("RGB")), pictures.info["timestamp"]
                except (OSError, EOFError, ValueError, RuntimeError) as error:
                    time_ms += pictures.info.get("duration", 0)
                    yield index, time_ms / MS_PER_S, None, f"damaged ({error})"
                else:
                    yield index, time_ms / MS_PER_S, image, ""
    except OSError as error:
        yield index, time_ms / MS_PER_S, None, str(error)


def _as_pictures(path: Path) -> bytearray:
    """The file with the labels of a sequence of pictures.

    Raises
    ------
    OSError
        The installed Pillow reads no such sequences, or the file is no MP4.
    """
    if not features.check("avif"):
        raise OSError("the installed Pillow reads no AVIF")
    data = bytearray(read_regular(path, LARGEST_BYTES))
    if data[LABEL : 2 * LABEL] != b"ftyp":
        raise OSError("AV1 is read from MP4 files alone")
    track = data.find(b"hdlr")
    while track >= 0 and data[track + HANDLER_AT : track + HANDLER_AT + LABEL] != b"vide":
        track = data.find(b"hdlr", track + 1)
    data[2 * LABEL : 3 * LABEL], data[track + HANDLER_AT : track + HANDLER_AT + LABEL] = b"avis", b"pict"
    return data
