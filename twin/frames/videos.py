"""Reads videos frame by frame, counts their frames, and finds out which frames are valid.

Motion JPEG is read picture by picture, so that a damaged frame is noticed and left out. Of other codecs those frames are left out of which
the decoder reports damage, with those that are predicted from them. Pixels are taken as they are stored: a flag that says how a player
should turn the picture is stated, and not applied.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.container import InputContainer
from av.logging import Capture
from av.video.stream import VideoStream

from scenes.files import quote, require_regular
from twin.errors import ErrorsAs, FrameError, format_count
from twin.frames.forms import times
from twin.frames.images import NOT_TURNED, Pictures, picture_of

MOTION_JPEG = "mjpeg"
"""FFmpeg's name of the codec whose frames are JPEG pictures."""
COMPLAINT = re.compile(r".*(?:error|damage|corrupt|conceal|invalid|truncat|missing|mismatch|premature|not reached).*", re.IGNORECASE)
"""A decoder's message about a damaged frame."""
CODEC = re.compile(rb"stsd.{12}(\w{4})|vids(\w{4})|(V_[\w/]{3,20})", re.DOTALL)
"""Name of the codec in an MP4, AVI or Matroska file, which states it even if nothing here can open it."""
LOOKED_BYTES = 16_000_000
"""Bytes of a video that are searched for this name at a time."""
USUAL_FPS = 25.0
"""Frames a second of a video that states no times."""
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

    def frames(self, chosen: Collection[int]) -> Pictures:
        """Pictures of chosen frames, in order."""
        last = min(self.count - 1, max(chosen, default=-1))
        for index, shown in enumerate(islice(_read_frames(self.path), last + 1)):
            if index in chosen:
                yield index, self.faults.get(index) or (shown.said if shown.image is None else shown.image), shown.time_s


def open_video(path: Path) -> Video:
    """Read a video once, to count its frames and to find irregularities.

    Raises
    ------
    FrameError
        The video can't be read, or has no usable frame.
    """
    with ErrorsAs(OSError, lambda error: FrameError(f"{path}: can't be read ({error.strerror}); give a video")):
        require_regular(path)
    times_s: list[float] = []
    said: dict[int, str] = {}
    sizes: dict[int, tuple[int, ...]] = {}
    firsts: dict[tuple[int, ...], np.ndarray] = {}
    repeated, before, turned = 0, None, 0
    for index, shown in enumerate(_read_frames(path)):
        times_s.append(shown.time_s)
        said |= {index: shown.said} if shown.said else {}
        if (image := shown.image) is not None:
            sizes[index], turned = image.shape[1::-1], shown.turned_deg
            firsts.setdefault(sizes[index], image)
            repeated += before is not None and np.array_equal(before, image)
            before = image
    count = len(times_s)
    if not sizes:
        raise FrameError(f"{path}: no frame can be decoded{_remedy(path, said.get(0, ''))}")
    with _open(path) as opened:
        promised, lasts_s, as_pictures = _describe(*opened) if opened else (0, 0.0, False)
    problems = [NOT_TURNED.format(f"{turned} deg")] if turned else []
    odd = [note for index, note in said.items() if index in sizes]
    if as_pictures and 2 * len(odd) > count:  # so its camera stores them
        problems.append(f"{odd[0]} ({len(odd)} such frames)")
        said = {index: note for index, note in said.items() if index not in sizes}
    # The number that a header states can be an estimate from the duration, which a pause makes too large.
    step_s = np.median(np.diff(times_s)) if count > 1 else 0.0
    if (promised > count and times_s[-1] + 1.5 * step_s < lasts_s) or is_cut(path):
        # The decoder fills the missing part of a truncated frame with a guess, without a message.
        decoded = f"{count} of {format_count(max(promised, count), 'frames')} can be decoded"
        problems.append(f"cut, {decoded}; the last of them may lack a part and is left out")
        count -= 1
    if min(sizes) >= count:
        raise FrameError(f"{path}: cut within its first frame; copy it again, or record it again")
    usable = Counter(size for index, size in sizes.items() if index not in said and index < count).most_common()
    if not usable:
        raise FrameError(f"{path}: no usable frame ({next(iter(said.values()))}); record it again")
    others = {index: size for index, size in sizes.items() if size != usable[0][0]}
    faults = {index: f"another size ({times(size)}) than the others" for index, size in others.items()} | said
    faults = {index: fault for index, fault in faults.items() if index < count}
    given = format_count(count, "frames")
    problems += [f"{n} of {given} are left out: {fault}" for fault, n in Counter(faults.values()).most_common(MOST_SAID)]
    problems += [f"{repeated} of {given} repeat the one before them"] if repeated else []
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
    return f"{format_count(len(long), 'pauses')}, {steps_s[long].sum():.3g} s in all, {known}"


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


def _remedy(path: Path, said: str) -> str:
    """Why no frame of a video can be decoded, and what helps."""
    codec = b""
    with path.open("rb") as file:
        while not codec and (part := file.read(LOOKED_BYTES)):
            named = CODEC.search(part)
            codec = named[named.lastindex or 0] if named else b""
    if not codec:
        return "; check that it is a video, or record it again"
    why = f"{quote(codec.decode('ascii', 'replace'))}{f' ({said})' if said else ''}"
    return f": its codec is {why}; convert it without loss, for example with 'ffmpeg -i VIDEO -c:v libx264 -qp 0 OTHER.mp4'"


@contextmanager
def _open(path: Path) -> Iterator[tuple[InputContainer, VideoStream] | None]:
    """A file and its video, decoded by one thread, so that messages belong to the packet that is decoded; None if it holds none."""
    with ExitStack() as opened:
        try:
            container = opened.enter_context(av.open(f"file:{path}"))
            video = container.streams.video[0] if container.streams.video else None
        except av.FFmpegError:
            video = None
        if video is None or video.codec_context is None:
            yield None
            return
        video.codec_context.thread_count = 1
        yield container, video


def _describe(container: InputContainer, video: VideoStream) -> tuple[int, float, bool]:
    """Number of frames and duration (s) that a file states, 0 if it does not, and whether its frames are JPEG pictures."""
    lasts_s = (container.duration or 0) / av.time_base
    promised = video.frames or round(lasts_s * float(video.average_rate or 0))
    return promised, lasts_s, video.codec_context.name == MOTION_JPEG


class _Shown(NamedTuple):
    """A frame's time (s), picture (RGB), irregularities, and angle of its flag (deg). One that can't be used has the reason alone."""

    time_s: float
    image: np.ndarray | None
    said: str
    turned_deg: int = 0


def _read_frames(path: Path) -> Iterator[_Shown]:
    """Each frame of a video, in order."""
    with _open(path) as opened:
        if opened is None:
            return
        container, video = opened
        start, tick_s, step_s = video.start_time or 0, float(video.time_base or 0), 1 / float(video.average_rate or USUAL_FPS)
        as_pictures, harm, count = _describe(*opened)[2], "", 0
        harms: dict[int | None, str] = {}  # by the time of the frame that a packet holds
        for packet in _packets(container, video):
            shown: list[_Shown] = []
            if as_pictures and packet.size:
                shown = [_Shown(tick_s * ((packet.pts or 0) - start), *_picture(bytes(packet)))]
            elif not as_pictures:
                frames, said = _decode(packet)
                harm = f"damaged ({said}), or predicted from such a frame" if said else "" if packet.is_keyframe else harm
                harms[packet.pts] = harm
                for frame in frames:
                    time_s = (count + len(shown)) * step_s if frame.pts is None else tick_s * (frame.pts - start)
                    rgb = frame.to_ndarray(format="rgb24", interpolation="BICUBIC")
                    shown.append(_Shown(time_s, rgb, harms.pop(frame.pts, harm), round(-frame.rotation) % 360))
            yield from shown
            count += len(shown)


def _packets(container: InputContainer, video: VideoStream) -> Iterator[av.Packet]:
    """The packets of a video, up to where its file can't be read any more; the last one is empty."""
    with suppress(av.FFmpegError):
        yield from container.demux(video)


def _decode(packet: av.Packet) -> tuple[list[av.VideoFrame], str]:
    """The frames that a packet completes, and what the decoder reports against them, "" if nothing."""
    av.logging.set_level(av.logging.ERROR)
    try:
        with Capture() as said:
            frames = packet.decode()
    except av.FFmpegError as error:
        return [], error.strerror or str(error)
    finally:
        av.logging.set_level(None)
    complaint = COMPLAINT.search("\n".join(text.strip() for _, _, text in said))
    return frames, complaint[0] if complaint else ""


def _picture(stored: bytes) -> tuple[np.ndarray | None, str]:
    """A frame (H, W) or (H, W, 3), RGB, from its bytes, and its irregularities; None and the reason if it can't be used."""
    try:
        return picture_of(stored)
    except FrameError as error:
        return None, str(error)
