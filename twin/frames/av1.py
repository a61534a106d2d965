"""Decodes AV1 video, the codec of LeRobot's data sets, which OpenCV's own video decoder lacks.

An AVIF picture sequence is an AV1 video with another label. Pillow reads such sequences, so the packets of any video become one.
"""

import io
import struct
from collections.abc import Iterator, Sequence

import numpy as np

TICKS = 1000
"""Duration of each frame in a sequence's time base. The true times are those of the video."""


def decode_av1(packets: Sequence[bytes], keys: Sequence[int], config: bytes, size_px: tuple[int, int]) -> Iterator[np.ndarray | str]:
    """Pictures (H, W, 3) uint8 RGB of AV1 packets, one for each. After a packet that can't be decoded there is the reason instead.

    Parameters
    ----------
    packets : sequence of bytes
        Each holds one frame, as in MP4 and Matroska files.
    keys : sequence of int
        Numbers of the packets that need none before them.
    config : bytes
        The codec's configuration record (``av1C``).
    size_px : (int, int)
        Width and height.

    Raises
    ------
    OSError
        Pillow is missing or reads no AVIF, or the packets are no AV1.
    """
    try:
        from PIL import Image, features
    except ImportError as error:
        raise OSError("Pillow is not installed") from error
    if not features.check("avif"):
        raise OSError("the installed Pillow reads no AVIF")
    with Image.open(io.BytesIO(_sequence(packets, keys, config, size_px))) as pictures:
        for number in range(len(packets)):
            try:
                pictures.seek(number)
                yield np.asarray(pictures.convert("RGB"))
            except (OSError, EOFError, ValueError, RuntimeError) as error:
                yield f"damaged ({error})"


def _sequence(packets: Sequence[bytes], keys: Sequence[int], config: bytes, size_px: tuple[int, int]) -> bytes:
    """An AVIF sequence (ISO/IEC 14496-12, and the AVIF specification's brand ``avis``) of these packets."""
    count, (width, height) = len(packets), size_px
    start = _box(b"ftyp", b"avis", bytes(4), b"avismsf1iso8")
    matrix = struct.pack(">9I", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    entry = bytes(6) + struct.pack(">H16x2H2I4xH32xHh", 1, width, height, 72 << 16, 72 << 16, 1, 24, -1)

    def movie(first: int) -> bytes:
        """All that is known of the packets, the first of which begins at this byte."""
        table = _box(
            b"stbl",
            _box(b"stsd", struct.pack(">2I", 0, 1), _box(b"av01", entry, _box(b"av1C", config))),
            _box(b"stts", struct.pack(">4I", 0, 1, count, TICKS)),
            _box(b"stsc", struct.pack(">5I", 0, 1, 1, count, 1)),
            _box(b"stsz", struct.pack(f">3I{count}I", 0, 0, count, *map(len, packets))),
            _box(b"stco", struct.pack(">3I", 0, 1, first)),
            _box(b"stss", struct.pack(f">2I{len(keys)}I", 0, len(keys), *(number + 1 for number in keys))),
        )
        named = _box(b"hdlr", bytes(8), b"pict", bytes(13))
        media = _box(b"mdia", _box(b"mdhd", struct.pack(">5I4x", 0, 0, 0, TICKS, TICKS * count)), named, _box(b"minf", table))
        head = _box(b"tkhd", struct.pack(">6I16x", 1, 0, 0, 1, 0, TICKS * count), matrix, struct.pack(">2I", width << 16, height << 16))
        about = struct.pack(">5IIH10x", 0, 0, 0, TICKS, TICKS * count, 1 << 16, 1 << 8) + matrix + struct.pack(">24xI", 2)
        return _box(b"moov", _box(b"mvhd", about), _box(b"trak", head, media))

    begin = len(start) + len(movie(0)) + 8
    return start + movie(begin) + _box(b"mdat", *packets)


def _box(kind: bytes, *parts: bytes) -> bytes:
    return struct.pack(">I", 8 + sum(map(len, parts))) + kind + b"".join(parts)
