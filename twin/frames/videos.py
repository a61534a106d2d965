"""Reads videos frame by frame, counts their frames, and finds out which frames are valid.

Motion JPEG is read picture by picture, so that a damaged frame is noticed and left out. Of other codecs those frames are left out of which
the decoder reports damage, with those that are predicted from them, and those that the decoder would scale to the first frame's size.
Pixels are taken as they are stored: a flag that says how a player should turn the picture is stated, and not applied.
"""

import itertools
import re
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from scenes.files import quote, require_regular
from twin.errors import ErrorsAs, FrameError
from twin.frames.av1 import decode_av1
from twin.frames.forms import times
from twin.frames.images import NOT_TURNED, overheard, picture_of

MOTION_JPEG, AV1 = b"MJPG", b"AV01"
"""Four-letter codes of the codec whose frames are JPEG pictures, and of one that OpenCV can't decode."""
AS_STORED = -1.0
"""Value of OpenCV's format setting that gives a video's frames without decoding them."""
MS_PER_S = 1e3
COMPLAINT = re.compile(
    r"(?:\[[^\]]*\] )?(.*(?:error|damage|corrupt|conceal|invalid|truncat|missing|mismatch|premature|not reached).*)", re.IGNORECASE
)
"""A decoder's message about a damaged frame, behind the name of the decoder."""
CODEC = re.compile(rb"stsd.{12}(\w{4})|vids(\w{4})|(V_[\w/]{3,20})", re.DOTALL)
"""Name of the codec in an MP4, AVI or Matroska file, which states it even if nothing here can open it."""
LOOKED_BYTES = 16_000_000
"""Bytes of a video that are searched for this name at a time."""
DELAY = 4
"""Most frames by which a decoder's message usually comes before the frame that it is about."""
HEAD_BYTES, MOST_HEADS = 48, 300
"""Bytes of a key frame that hold its size, and the most different ones of a video from which a size is read."""
MOST_SAID = 3
"""Most reasons against frames that are stated, the most frequent ones."""
PAUSE = 3.0
"""A pause is longer than this many times the usual time from frame to frame."""


@dataclass(frozen=True)
class Video:
    """A video that can be read.

    Attributes
    ----------
    path : Path
    count : int
        Number of frames; of a truncated video without the last one.
    first : (H, W) or (H, W, 3) uint8
        The first usable frame of the most frequent size, RGB.
    problems : list of str
        Irregularities, one line each.
    faults : dict of int to str
        Frames that can't be used, and the reasons.
    """

    path: Path
    count: int
    first: np.ndarray
    problems: list[str] = field(default_factory=list)
    faults: dict[int, str] = field(default_factory=dict)

    def frames(self) -> Iterator[tuple[int, float, np.ndarray | str]]:
        """Index, time (s) and picture of each frame, in order. A frame that can't be used gives the reason, a text, instead."""
        for index, time_s, image, said in _read_frames(self.path):
            if index >= self.count:
                return
            yield index, time_s, self.faults.get(index) or (said if image is None else image)


def open_video(path: Path) -> Video:
    """Read a video once, to count its frames and to find irregularities.

    Raises
    ------
    FrameError
        The video can't be read, or has no usable frame.
    """
    with ErrorsAs(OSError, lambda error: FrameError(f"{path}: can't be read ({error.strerror}); give a video")):
        require_regular(path)
    stored = _read_properties(path)
    times_s: list[float] = []
    said: dict[int, str] = {}
    sizes: dict[int, tuple[int, ...]] = {}
    firsts: dict[tuple[int, ...], np.ndarray] = {}
    repeated, before = 0, None
    for index, time_s, image, note in _read_frames(path):
        times_s.append(time_s)
        said |= {index: note} if note else {}
        if image is not None:
            sizes[index] = image.shape[1::-1]
            firsts.setdefault(sizes[index], image)
            repeated += before is not None and np.array_equal(before, image)
            before = image
    count = len(times_s)
    if not sizes:
        raise FrameError(f"{path}: no frame can be decoded{_remedy(path, stored.codec, said.get(0, ''))}")
    problems = [NOT_TURNED.format(f"{stored.turned} deg")] if stored.turned else []
    odd = [note for index, note in said.items() if index in sizes]
    if stored.codec == MOTION_JPEG and 2 * len(odd) > count:  # so its camera stores them
        problems.append(f"{odd[0]} ({len(odd)} such frames)")
        said = {index: note for index, note in said.items() if index not in sizes}
    # The number that a header states can be an estimate from the duration, which a pause makes too large.
    step_s = np.median(np.diff(times_s)) if count > 1 else 0.0
    if (stored.promised > count and times_s[-1] + 1.5 * step_s < stored.lasts_s) or is_cut(path):
        # The decoder fills the missing part of a truncated frame with a guess, without a message.
        decoded = f"{count} of {max(stored.promised, count)} frames can be decoded"
        problems.append(f"cut, {decoded}; the last of them may lack a part and is left out")
        count -= 1
    if min(sizes) >= count:
        raise FrameError(f"{path}: cut within its first frame; copy it again, or record it again")
    faults = said if stored.codec == MOTION_JPEG else stored.faults(said, np.array(times_s), sizes[min(sizes)])
    usable = Counter(size for index, size in sizes.items() if index not in faults and index < count).most_common()
    if not usable:
        raise FrameError(f"{path}: no usable frame ({next(iter(faults.values()))}); record it again")
    others = {index: size for index, size in sizes.items() if size != usable[0][0]}
    faults = {index: f"another size ({times(size)}) than the others" for index, size in others.items()} | faults
    faults = {index: fault for index, fault in faults.items() if index < count}
    problems += [f"{n} of {count} frames are left out: {fault}" for fault, n in Counter(faults.values()).most_common(MOST_SAID)]
    problems += [f"{repeated} of {count} frames repeat the one before them"] if repeated else []
    problems += filter(None, [describe_pauses(times_s)])
    return Video(path, count, firsts[usable[0][0]], [f"{path.name}: {problem}" for problem in problems], faults)


def describe_pauses(times_s: Sequence[float] | np.ndarray) -> str:
    """Pauses between frames with these times, in words; "" if there are none."""
    steps_s = np.diff(times_s)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    long = np.flatnonzero((steps_s > PAUSE * usual_s) & (usual_s > 0))
    if not len(long):
        return ""
    most = int(np.argmax(steps_s))
    known = f"the longest {steps_s[most]:.3g} s after frame {most}; usually {usual_s:.3g} s from frame to frame"
    return f"{len(long)} {'pause' if len(long) == 1 else 'pauses'}, {steps_s[long].sum():.3g} s in all, {known}"


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


@dataclass
class _Stored:
    """What a video's file holds without decoding it.

    Codec, number of frames and duration that its header states, angle of its flag (deg), number of packets, and of its key frames number,
    time (s) and size (() if unknown).
    """

    codec: bytes = b""
    promised: int = 0
    lasts_s: float = 0.0
    turned: int = 0
    count: int = 0
    keys: list[int] = field(default_factory=list)
    key_times_s: list[float] = field(default_factory=list)
    sizes: list[tuple[int, ...]] = field(default_factory=list)

    def faults(self, damaged: dict[int, str], times_s: np.ndarray, size: tuple[int, ...]) -> dict[int, str]:
        """Reasons against decoded frames: damage, up to the next key frame, and a size that the decoder has scaled to the first frame's."""
        found: dict[int, str] = {}
        frame, last = np.arange(len(times_s)), len(times_s) - 1
        by_time = self.count != len(times_s) and bool((np.diff(self.key_times_s) > 0).all())
        keys, places = (self.key_times_s, times_s) if by_time else (self.keys, frame)
        part = np.searchsorted(keys, places, side="right") - 1
        for index, said in damaged.items():
            after = (frame >= index) & (part <= part[min(index + DELAY, last)])
            found |= dict.fromkeys(np.flatnonzero(after).tolist(), f"{said}, or predicted from such a frame")
        slack = 0 if by_time else abs(self.count - len(times_s))  # frames whose packet is not known for sure
        soonest = part[np.minimum(frame + slack, last)]
        for k, of_key in enumerate(self.sizes):
            if of_key and of_key != size:
                said = f"another size ({times(of_key)}), which the decoder scales to {times(size)}"
                found |= dict.fromkeys(np.flatnonzero((part <= k) & (soonest >= k)).tolist(), said)
        return found


def _remedy(path: Path, codec: bytes, said: str) -> str:
    """Why no frame of a video can be decoded, and what helps."""
    with path.open("rb") as file:
        while not codec and (part := file.read(LOOKED_BYTES)):
            named = CODEC.search(part)
            codec = named[named.lastindex or 0] if named else b""
    if not codec:
        return "; check that it is a video, or record it again"
    why = f"{quote(codec.decode('ascii', 'replace'))}{f' ({said})' if said else ''}"
    return f": its codec is {why}; convert it without loss, for example with 'ffmpeg -i VIDEO -c:v libx264 -qp 0 OTHER.mp4'"


@contextmanager
def _capture(path: Path) -> Iterator[tuple[cv2.VideoCapture, bytes]]:
    """An open video and its codec. One thread decodes it, so that messages belong to the frame that is read; nothing is turned."""
    with overheard():
        capture = cv2.VideoCapture(str(path), cv2.CAP_ANY, [cv2.CAP_PROP_N_THREADS, 1])
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    code = int(capture.get(cv2.CAP_PROP_FOURCC)) if capture.isOpened() else 0
    try:
        yield capture, (code & 0xFFFFFFFF).to_bytes(4, "little").strip(b"\0")
    finally:
        capture.release()


def _read_properties(path: Path) -> _Stored:
    with _capture(path) as (capture, codec):
        if not capture.isOpened():
            return _Stored()
        promised, fps = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
        found = _Stored(codec, promised, promised / fps if fps > 0 else 0.0, round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360)
        known: dict[bytes, tuple[int, ...]] = {}
        more = codec != MOTION_JPEG and capture.set(cv2.CAP_PROP_FORMAT, AS_STORED)
        while more:
            with overheard():
                more, data = capture.read()
            if more and capture.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME):
                packet = data.tobytes()
                head = packet[:HEAD_BYTES]
                if head not in known and len(known) < MOST_HEADS:
                    known[head] = _size_in(packet, codec)
                found.keys.append(found.count)
                found.key_times_s.append(capture.get(cv2.CAP_PROP_POS_MSEC) / MS_PER_S)
                found.sizes.append(known.get(head, ()))
            found.count += more
        return found


def _size_in(packet: bytes, codec: bytes) -> tuple[int, ...]:
    """Width and height of a key frame by its own data, which are put into a file without stated size; () if they do not hold it."""
    head = struct.pack("<4s2H4s2H4I", b"DKIF", 0, 32, codec, 0, 0, 30, 1, 1, 0) + struct.pack("<IQ", len(packet), 0)
    for content in (head + packet, packet):  # an IVF file, and the data alone for codecs that IVF does not have
        with tempfile.NamedTemporaryFile(suffix=".ivf") as file:
            file.write(content)
            file.flush()
            with _capture(Path(file.name)) as (capture, _):
                size = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if min(size) > 0:
            return size
    return ()


def _read_frames(path: Path) -> Iterator[tuple[int, float, np.ndarray | None, str]]:
    """Index, time (s), picture (RGB) and irregularities of each frame; None and the reason for a frame that can't be used."""
    with _capture(path) as (capture, codec):
        if codec == AV1:
            yield from decode_av1(path)
            return
        pictures = codec == MOTION_JPEG and capture.set(cv2.CAP_PROP_FORMAT, AS_STORED)
        for index in itertools.count():
            with overheard() as said:
                good, image = capture.read()
            if not good:
                return
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / MS_PER_S
            if pictures:
                yield index, time_s, *_picture(image)
            else:
                complaint = COMPLAINT.search(said[0])
                rgb = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
                yield index, time_s, rgb, f"damaged ({complaint[1]})" if complaint else ""


def _picture(stored: np.ndarray) -> tuple[np.ndarray | None, str]:
    """A frame (H, W) or (H, W, 3), RGB, from its bytes (1, n), and its irregularities; None and the reason if it can't be used."""
    try:
        image, note = picture_of(stored.tobytes())
    except FrameError as error:
        return None, str(error)
    return image, note
