"""Where a recording's frames and no-contact frames lie in a folder."""

import os
import re
from collections import Counter
from pathlib import Path

from scenes.files import require_regular
from twin.errors import FrameError
from twin.types import Form

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})
VIDEO_SUFFIXES = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg", ".ts", ".gif"})
IMAGE_FOLDERS = ("frames_bw", "sensor_images", "images", "processed_images")
# Names of no-contact frames in use, besides init_*.
NO_CONTACT_NAME = re.compile(
    r"(init|rest|no[-_ ]?contact|undeformed|unloaded|background|reference)([-_ ]?(frame|image|raw|\d+))*", re.IGNORECASE
)
# Greatest depth of subfolders that are searched for pictures; the error message names the folders found.
SEARCH_DEPTH = 4


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key by which frame_2 comes before frame_10."""
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part.lower()) for part in re.split(r"(\d+)", name)]


def pictures_folder(form: str) -> str:
    """Name of the subfolder that a written recording has for its pictures, by their form."""
    return "frames_bw" if form == Form.PROCESSED else "images"


def distinct_stems(names: list[str]) -> list[str]:
    """File names for the frames: each frame's name without suffix, or with it if another frame has the same stem."""
    stems = [Path(name).stem for name in names]
    count = Counter(stems)
    return [stem if count[stem] == 1 else Path(name).name for stem, name in zip(stems, names, strict=True)]


def _files(folder: Path, suffixes: frozenset[str]) -> list[Path]:
    found = (p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file() and not p.name.startswith("."))
    return sorted(found, key=lambda p: natural_key(p.name))


def odd_entries(folder: Path) -> list[str]:
    """Entries of a folder that are named like pictures but are no files, one line each: broken links, folders, named pipes, devices."""
    found = []
    for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)):
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith("."):
            continue
        try:
            require_regular(path)
        except OSError as error:
            reason = "a broken link" if path.is_symlink() and isinstance(error, FileNotFoundError) else error.strerror
            found.append(f"{path.name}: {reason}; left out")
    return found


def _is_reference(path: Path) -> bool:
    return path.name.lower().startswith("init_") or bool(NO_CONTACT_NAME.fullmatch(path.stem))


def frames_in(folder: Path) -> list[Path]:
    """Pictures of a folder in natural order, without its no-contact frames."""
    return [p for p in _files(folder, IMAGE_SUFFIXES) if not _is_reference(p)]


def references_in(folder: Path) -> list[Path]:
    """No-contact frames (``init_*``, ``no_contact``, ``rest``, ...) of a folder in natural order."""
    return [p for p in _files(folder, IMAGE_SUFFIXES) if _is_reference(p)]


def image_folders(path: Path, form: Form | None) -> list[Path]:
    """Folders that may hold the frames of the recording at ``path``, the most probable first; empty if there are none.

    Raises
    ------
    FrameError
        There are several folders that aren't parts of one recording.
    """
    known = [path / name for name in IMAGE_FOLDERS if (path / name).is_dir() and frames_in(path / name)]
    if form == Form.PROCESSED:  # if both folders exist, processed_images holds the thresholded pictures
        known.sort(key=lambda folder: folder.name != "processed_images")
    if frames_in(path):
        known.append(path)
    if known:
        return known
    nested = [p for p in sorted(path.iterdir()) if p.is_dir() and frames_in(p)]
    if len(nested) > 1:
        raise FrameError(f"{path}: no pictures here, but in several folders ({_some(path, nested)}); give one of them")
    return nested


def the_video_in(path: Path) -> Path:
    """The one video of a folder without pictures.

    Raises
    ------
    FrameError
        There is none or there are several; the message names what is there instead.
    """
    videos = _files(path, VIDEO_SUFFIXES)
    if len(videos) == 1:
        return videos[0]
    if videos:
        raise FrameError(f"{path}: {len(videos)} videos here ({_some(path, videos)}); give one of them")
    if deeper := _deeper_folders(path):
        raise FrameError(f"{path}: no pictures here, but in folders below ({_some(path, deeper)}); give the folder of the pictures")
    if references_in(path):
        raise FrameError(f"{path}: no frames (only no-contact references, init_*); give a folder of frames")
    suffixes = ", ".join(sorted(s[1:] for s in IMAGE_SUFFIXES))
    raise FrameError(f"{path}: no pictures found (looked for {suffixes}); give a folder of frames")


def _deeper_folders(path: Path) -> list[Path]:
    found = []
    for name, inner, _ in os.walk(path):
        folder = Path(name)
        inner.sort(key=natural_key)
        if len(folder.relative_to(path).parts) >= SEARCH_DEPTH:
            inner.clear()
        if frames_in(folder):
            found.append(folder)
    return found


def _some(path: Path, found: list[Path]) -> str:
    return ", ".join(str(p.relative_to(path)) for p in found[:5]) + (", ..." if len(found) > 5 else "")
