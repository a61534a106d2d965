"""Reading one picture from a file as 8-bit levels, and writing one.

The libraries that OpenCV uses print messages to the process's stderr, where Python code can't catch them. `overheard` redirects stderr
during one decoder call.

Pixels are taken as they are stored, because a sensor's calibration counts them so. An orientation flag (EXIF) is stated, never applied.
"""

import contextlib
import os
import re
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from scenes.files import read_regular
from twin.errors import ErrorsAs, FrameError
from twin.store import write_bytes

PNG_START = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG file."""
LARGEST_BYTES = 500_000_000
"""Largest size of a picture's file, bytes: ten times an uncompressed 16-bit colour picture of an 8-megapixel camera."""
SEVERAL_FROM_START = (b"II*\0", b"MM\0*", b"RIFF", b"GIF8")
"""First bytes of TIFF, WebP and GIF files, which can hold several pictures."""
TIFF_STARTS = {b"II*\0": "<", b"MM\0*": ">"}
"""First bytes of TIFF files, which are also those of EXIF data, and the order of bytes that each states."""
EXIF_MARKS = {b"": 0, b"Exif\0\0": 6, b"eXIf": 4, b"EXIF": 8}
"""Marks before EXIF data in TIFF, JPEG, PNG and WebP files, and the number of bytes from each mark to the data."""
ORIENTATION, UPRIGHT = 0x0112, 1
"""EXIF's tag of the orientation (CIPA DC-008), and its value for pictures that are shown as they are stored."""
NOT_TURNED = "an orientation flag ({}) is not applied: pixels are taken as they are stored"
"""Note on a picture or video that a player would show turned or mirrored."""
Pictures = Iterator[tuple[int, np.ndarray | str, float]]
"""Index of each frame, its picture, or the reason why it can't be used, and its time, s."""
ADDED_BYTES = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9")
"""The JPEG decoder's message about extra bytes after a complete picture. Some cameras add such bytes."""
DAMAGE = re.compile(
    r"(?!.*before marker 0xd9)Corrupt JPEG data: (?!bad ICC)[\w ]+|Premature end of JPEG file|Inconsistent progression sequence"
    r"|Invalid SOS parameters|(?<=TIFF_Error )[^\n]+"
)
"""Decoders' messages about damaged pictures. The decoder read only a part of such a picture, but returns a whole one."""
DEPTHS = (8, 10, 12, 14, 16)
"""Bit depths of camera levels stored in 16-bit files."""
MOST_HEARD = 10_000
"""Most bytes of a decoder's messages that are kept. The first message says what is wrong."""
STDERR = 2
"""File descriptor of the process's stderr."""

_hearing = threading.Lock()  # one decoder call at a time, so that the messages belong to this call


def read_image(path: Path, bits: int = 0) -> tuple[np.ndarray, str]:
    """A picture as (H, W) or (H, W, 3) uint8 RGB, and a note on what was converted or odd ("" if nothing).

    Parameters
    ----------
    bits : int
        Least number of bits in use in a 16-bit file, as found in other frames of its recording. The file's own levels may need more.

    Raises
    ------
    FrameError
        The file cannot be read: it is missing, empty, truncated, damaged or no picture.
    """
    return _as_levels(*read_levels(path), bits)


def picture_of(data: bytes) -> tuple[np.ndarray, str]:
    """A picture from a file's bytes, as of ``read_image``.

    Raises
    ------
    FrameError
        The bytes are truncated, damaged or no picture; the message names no file.
    """
    return _as_levels(*_decode_picture(data), 0)


def _as_levels(stored: np.ndarray, odd: str, bits: int) -> tuple[np.ndarray, str]:
    image, note = to_eight_bits(stored, bits)
    note = "; ".join(filter(None, [odd, note]))
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] < 3 else cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2RGB)
    return np.ascontiguousarray(image), note


def write_image(path: Path, image: np.ndarray) -> Path:
    """Write a gray or RGB frame as PNG, whole or not at all, and return the path.

    Raises
    ------
    StoreError
        The file cannot be written.
    """
    return write_bytes(path, png(image))


def png(image: np.ndarray) -> bytes:
    """A gray or RGB picture as the content of a PNG file."""
    return cv2.imencode(".png", image if image.ndim == 2 else image[..., ::-1])[1].tobytes()


def read_levels(path: Path) -> tuple[np.ndarray, str]:
    """Levels of a picture as stored, and a note on irregularities of the file ("" if there are none).

    The levels are (H, W) or (H, W, C) in OpenCV's channel order, uint8 or uint16.

    Raises
    ------
    FrameError
        The file cannot be read: it is missing, empty, truncated, damaged or no picture.
    """
    with ErrorsAs(OSError, lambda error: FrameError(f"{path.name}: can't be read ({error.strerror})")):
        data = read_regular(path, LARGEST_BYTES)
    if not data:
        raise FrameError(f"{path.name}: the file is empty; copy it again")
    with ErrorsAs(FrameError, lambda error: FrameError(f"{path.name}: {error}")):
        image, odd = _decode_picture(data)
    several = "holds several pictures; only the first is read" if _holds_several(path, data) else ""
    return image, "; ".join(filter(None, [several, odd]))


def _decode_picture(data: bytes) -> tuple[np.ndarray, str]:
    """Levels as of `read_levels` from a picture's bytes, and a note on irregularities that its decoder reported ("" if there are none)."""
    orientation, place = _orientation(data)
    if place and data[:4] in TIFF_STARTS:  # OpenCV turns TIFF pictures, whatever it is told
        data = data[:place] + struct.pack(f"{TIFF_STARTS[data[:4]]}H", UPRIGHT) + data[place + 2 :]
    try:
        with overheard() as said:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None and data.startswith(PNG_START):
        raise FrameError(f"{'damaged' if b'IEND' in data else 'truncated'} PNG ({len(data)} bytes); copy it again")
    if image is None:
        raise FrameError("not a readable picture (broken or unknown format); copy or convert it again")
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"expected 8-bit levels, got {image.dtype}; convert it to 8 bits")
    if fault := DAMAGE.search(said[0]):
        raise FrameError(f"damaged ({fault[0]}); copy it again, or leave it out")
    odd = [NOT_TURNED.format(f"EXIF {orientation}")] if orientation != UPRIGHT else []
    if extra := ADDED_BYTES.search(said[0]):
        odd.append(f"contains {extra[1]} extra bytes: it is damaged, or the camera adds such bytes; check its pins")
    return image, "; ".join(odd)


def _orientation(data: bytes) -> tuple[int, int]:
    """EXIF's orientation that a picture's file states, and the place of its two bytes; ``UPRIGHT`` and 0 if it states none."""
    for mark, skip in EXIF_MARKS.items():
        start = data.find(mark) + skip
        order = TIFF_STARTS.get(data[start : start + 4])
        if order is None:
            continue
        with contextlib.suppress(struct.error):
            place = start + int(struct.unpack_from(f"{order}I", data, start + 4)[0])
            for entry in range(place + 2, place + 2 + 12 * struct.unpack_from(f"{order}H", data, place)[0], 12):
                if struct.unpack_from(f"{order}H", data, entry)[0] == ORIENTATION:
                    return struct.unpack_from(f"{order}H", data, entry + 8)[0] or UPRIGHT, entry + 8
    return UPRIGHT, 0


def _holds_several(path: Path, data: bytes) -> bool:
    """Whether a picture's file is an animation or has several pages."""
    if data.startswith(PNG_START):
        return b"acTL" in data[: data.find(b"IDAT")]  # the chunk that makes it an animation, before the first picture
    with overheard():
        return data.startswith(SEVERAL_FROM_START) and cv2.imcount(str(path)) > 1


def bits_used(image: np.ndarray) -> int:
    """Smallest bit depth of ``DEPTHS`` that can hold the brightest level; 0 for 8-bit pictures."""
    if image.dtype == np.uint8:
        return 0
    brightest = int(image.max())
    return next(bits for bits in DEPTHS if brightest < 1 << bits)


def to_eight_bits(image: np.ndarray, bits: int = 0) -> tuple[np.ndarray, str]:
    """8-bit levels, and a note on how they were scaled; ``bits`` as for ``read_image``."""
    if image.dtype == np.uint8:
        return image, ""
    bits = max(bits, bits_used(image))
    return np.round(image * (255.0 / ((1 << bits) - 1))).astype(np.uint8), f"16-bit levels taken as {bits}-bit data and scaled to 8 bits"


@contextlib.contextmanager
def overheard() -> Iterator[list[str]]:
    """Context that keeps from the terminal what any thread prints to stderr, for one decoder call only.

    It gives a list of one text. When the context ends, the text is what was printed.
    """
    said = [""]
    with _hearing:
        kept = _own_stderr()
        if kept is None:
            yield said
            return
        heard, ear = os.pipe()
        os.set_blocking(ear, False)  # text beyond the pipe's capacity is dropped
        os.set_blocking(heard, False)
        os.dup2(ear, STDERR)
        os.close(ear)
        try:
            yield said
        finally:
            os.dup2(kept, STDERR)
            os.close(kept)
            with contextlib.suppress(BlockingIOError):
                said[0] = os.read(heard, MOST_HEARD).decode("utf-8", "replace")
            os.close(heard)


def _own_stderr() -> int | None:
    """A second descriptor of the process's stderr; None if it has none, or if pipes always block (Python 3.11 on Windows)."""
    try:
        return os.dup(STDERR) if hasattr(os, "set_blocking") else None
    except OSError:
        return None
