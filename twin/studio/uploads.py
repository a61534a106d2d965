"""Stores files that a browser uploads."""

import re
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile, ZipFile

from twin.errors import TwinError
from twin.store import writing
from twin.studio.state import next_path

MOST_UNPACKED = 4_000_000_000
"""Largest size of an archive's content, bytes."""


def keep_upload(folder: Path, name: str, content: bytes) -> Path:
    """Store an uploaded file in a new folder ``upload-NUMBER``, and return its path. An archive is unpacked: the path is its folder's.

    Raises
    ------
    TwinError
        The archive is damaged or too large, or nothing can be written.
    """
    safe = re.sub(r"[^\w.-]+", "_", name).lstrip(".") or "file"
    place = next_path(folder, "upload", "")
    with writing(place):
        place.mkdir()
        if not safe.lower().endswith(".zip"):
            (place / safe).write_bytes(content)
            return place / safe
        try:
            with ZipFile(BytesIO(content)) as archive:
                if sum(each.file_size for each in archive.infolist()) > MOST_UNPACKED:
                    raise TwinError(
                        f"{safe}: more than {MOST_UNPACKED / 1e9:g} GB unpacked; give the folder's path on the studio's machine"
                    )
                archive.extractall(place)  # never writes outside of the folder
        except (BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
            raise TwinError(f"{safe}: no readable archive ({error}); upload a .zip of a folder of frames") from error
    inside = list(place.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else place
