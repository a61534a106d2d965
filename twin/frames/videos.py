"""Reads videos frame by frame, counts their frames, and finds out which frames can be used.

Motion JPEG is read picture by picture, so that a damaged frame is noticed and left out. A video decoder would fill the missing part with a
guess, without a message. A frame of another codec cannot be checked in this way.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from scenes.files import require_regular
from twin.errors import FrameError
from twin.frames.images import picture_of, quiet

MOTION_JPEG = "MJPG"
"""Four-letter code of the codec whose frames are JPEG pictures."""
AS_STORED = -1.0
"""Value of OpenCV's format setting that gives a video's frames without decoding them."""
MS_PER_S = 1e3


@dataclass(frozen=True)
class Video:
    """A video that can be read.

    Attributes
    ----------
    path : Path
    count : int
        Number of frames; of a truncated video without the last one.
    first : (H, W) or (H, W, 3) uint8
        The first usable frame, RGB.
    problems : list of str
        Irregularities, one line each.
    oddly_stored : bool
        Whether most frames hold extra bytes that belong to no part of them, as some cameras write them. If only a few frames hold such
        bytes, these frames are damaged.
    """

    path: Path
    count: int
    first: np.ndarray
    problems: list[str] = field(default_factory=list)
    oddly_stored: bool = False

    def frames(self) -> Iterator[tuple[int, float, np.ndarray | str]]:
        """Index, time (s) and picture of each frame, in order. A damaged frame gives the reason, a text, instead of the picture."""
        for index, time_s, image, said in _read(self.path):
            if index >= self.count:
                return
            yield index, time_s, said if image is None or (said and not self.oddly_stored) else image


def open_video(path: Path) -> Video:
    """Read a video once, to count its frames and to find irregularities.

    Raises
    ------
    FrameError
        The video can't be read, or has no usable frame.
    """
    try:
        require_regular(path)
    except OSError as error:
        raise FrameError(f"{path}: can't be read ({error.strerror}); give a video") from error
    first, first_index, odd, count = None, 0, dict[int, str](), 0
    for index, _, image, said in _read(path):
        count = index + 1
        if image is None:
            continue
        if said:
            odd[index] = said
        if first is None:
            first, first_index = image, index
    if first is None:
        raise FrameError(f"{path}: no frame can be decoded; check that it is a video, or record it again")
    oddly_stored = 2 * len(odd) > count
    problems = [f"{path.name}: {said} ({len(odd)} such frames)" for said in list(odd.values())[:1] if oddly_stored]
    promised = _promised(path)
    if promised > count or is_cut(path):
        # The decoder fills the missing part of a truncated frame with a guess, without a message.
        decoded = f"{count} of {max(promised, count)} frames can be decoded"
        problems.append(f"{path.name}: cut, {decoded}; the last of them may lack a part and is left out")
        count -= 1
    if first_index >= count:
        raise FrameError(f"{path}: cut within its first frame; copy it again, or record it again")
    return Video(path, count, first, problems, oddly_stored)


def is_cut(path: Path) -> bool:
    """Whether an AVI or MP4 file is shorter than its own chunks state."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(8)
        if head[:4] == b"RIFF":
            return size < len(head) + int.from_bytes(head[4:], "little")
        if head[4:] != b"ftyp":
            return False
        start = 0
        while start < size:
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:  # the true length follows, in 8 bytes
                length = int.from_bytes(head[8:], "big")
            elif length == 0:  # this box extends to the end of the file
                return False
            if length < 8:  # not a valid box
                return True
            start += length
        return start > size


def _promised(path: Path) -> int:
    """Number of frames that the file states in its header."""
    with quiet():
        capture = cv2.VideoCapture(str(path))
    try:
        return int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    finally:
        capture.release()


def _read(path: Path) -> Iterator[tuple[int, float, np.ndarray | None, str]]:
    """Index, time (s), picture (RGB) and irregularities of each frame; None and the reason for a frame that can't be used."""
    with quiet():
        capture = cv2.VideoCapture(str(path))
    try:
        stored = _gives_pictures(capture) and capture.set(cv2.CAP_PROP_FORMAT, AS_STORED)
        index = 0
        while True:
            with quiet():
                good, image = capture.read()
            if not good:
                return
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / MS_PER_S
            if not stored:
                yield index, time_s, image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB), ""
            else:
                yield index, time_s, *_picture(image)
            index += 1
    finally:
        capture.release()


def _gives_pictures(capture: cv2.VideoCapture) -> bool:
    """Whether a video's frames are JPEG pictures."""
    code = int(capture.get(cv2.CAP_PROP_FOURCC)) if capture.isOpened() else 0
    return code & 0xFFFFFFFF == cv2.VideoWriter.fourcc(*MOTION_JPEG)


def _picture(stored: np.ndarray) -> tuple[np.ndarray | None, str]:
    """A frame (H, W) or (H, W, 3), RGB, from its bytes (1, n), and its irregularities; None and the reason if it can't be used."""
    try:
        image, note = picture_of(stored.tobytes())
    except FrameError as error:
        return None, str(error)
    return image, note
