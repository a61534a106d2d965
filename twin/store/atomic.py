"""Atomic writing of results: after any interruption a file is either complete or unchanged.

The content is written to a temporary file in the same folder, flushed to the disk, and renamed in one step. If the process is killed
before that, the old file is unchanged, and the temporary file stays until ``remove_parts`` removes it.

`locked` reserves a folder for one run at a time.
"""

import errno
import hashlib
import io
import json
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np
import platformdirs

from twin.errors import ErrorsAs, StoreError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PART = ".part"
"""End of the name of a temporary file. The name begins with a dot."""
LOCK = ".lock"
"""Name of the file that is locked where the file system (NFS) can't lock a folder itself. Earlier versions left one in each folder."""
CACHE_VARIABLE = "TACTIP_CACHE"
"""Environment variable with another folder for results that are kept between runs, or ``off``."""
LOOK_S = 0.05
"""Interval, s, at which a run that waits for another one looks again."""

_REMEDIES = {
    "free some space and give the same command again": (errno.ENOSPC, errno.EDQUOT),
    "give a folder that may be written to": (errno.EROFS, errno.EACCES, errno.EPERM),
    "make its folder first, or give another one": (errno.ENOENT,),
    "give another folder: a file is in the way": (errno.ENOTDIR, errno.EEXIST),
    "give a shorter name": (errno.ENAMETOOLONG,),
    "files can't be larger there; give another folder": (errno.EFBIG,),
    "give another name: a folder is in the way": (errno.EISDIR,),
}


def write_with(path: Path, fill: Callable[[BinaryIO], object]) -> Path:
    """Write the content that ``fill`` writes to an open binary file, and return the path.

    Raises
    ------
    StoreError
        The file cannot be written: the disk is full, the folder is read-only or missing. An existing file is unchanged.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}{secrets.token_hex(4)}{PART}")
    try:
        with part.open("xb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise unwritten(path, error) from error
        raise
    return path


def write_bytes(path: Path, data: bytes) -> Path:
    """Write bytes; raises as ``write_with``."""
    return write_with(path, lambda file: file.write(data))


def write_text(path: Path, text: str) -> Path:
    """Write text as UTF-8 without a change of its line ends; raises as ``write_with``.

    File names in the text that the locale can't decode are written with their bytes on the disk.
    """
    return write_bytes(path, text.encode(errors="surrogateescape"))


def write_result(folder: Path, texts: Mapping[str, str]) -> None:
    """Write texts, given by file name, each file atomically. If a file can't be written, the results are not lost: the error contains them.

    Raises
    ------
    StoreError
        If a file cannot be written. ``unsaved`` of the error contains all texts.
    """
    try:
        for name, text in texts.items():
            write_text(folder / name, text)
    except StoreError as error:
        told = StoreError(f"{error}; the result is printed, so that it can be saved elsewhere")
        told.unsaved = dict(texts)
        raise told from error


@contextmanager
def text_file(path: Path) -> Iterator[io.StringIO]:
    """Context that gives a text to write to. If the context ends without an error, the text is written; raises as ``write_with``."""
    text = io.StringIO(newline="")
    yield text
    write_text(path, text.getvalue())


def write_json(path: Path, content: object) -> Path:
    """Write JSON with indented lines; numbers of NumPy are written as numbers; raises as ``write_with``."""
    return write_text(path, json.dumps(content, indent=1, default=np.generic.item) + "\n")


def write_npz(path: Path, arrays: Mapping[str, np.ndarray], *, compressed: bool = False) -> Path:
    """Write arrays by name in the format that ``np.load`` reads; raises as ``write_with``."""
    save: Callable[..., None] = np.savez_compressed if compressed else np.savez
    return write_with(path, lambda file: save(file, **arrays))


def cache_folder() -> Path | None:
    """Folder of results that are kept between runs; None if the cache is off."""
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen.lower() == "off":
        return None
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("tactip-twin"))


def make_folder(folder: Path) -> Path:
    """The folder, which is made if it does not exist.

    Raises
    ------
    StoreError
        It can't be made.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def replace_folder(part: Path, path: Path) -> Path:
    """Rename a finished folder, which replaces an existing folder of that name. Returns the path.

    Raises
    ------
    StoreError
        The folder cannot be moved.
    """
    with writing(path):
        shutil.rmtree(path, ignore_errors=True)
        os.replace(part, path)
    return path


def remove_parts(folder: Path) -> None:
    """Remove the temporary files and folders of killed processes. No other process may be writing to the folder.

    Raises
    ------
    StoreError
        A file or folder cannot be removed.
    """
    with writing(folder):
        for part in folder.glob(f".*{PART}"):
            shutil.rmtree(part) if part.is_dir() else part.unlink()


def unwritten(path: Path, error: OSError) -> StoreError:
    """The error for a path that can't be written. It names the path, the reason and the remedy."""
    remedy = next((text for text, numbers in _REMEDIES.items() if error.errno in numbers), "give another folder or free some space")
    return StoreError(f"{path}: can't be written ({error.strerror or error}); {remedy}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Context that converts an error of the operating system to the ``StoreError`` of ``unwritten``."""
    with ErrorsAs(OSError, lambda error: unwritten(path, error)):
        yield


@contextmanager
def lock_folder(folder: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Context that reserves a folder, made if missing, for this run. The lock of a killed run is released.

    Parameters
    ----------
    folder : Path
    wait_s : float
        Longest wait for another run that has reserved the folder.

    Raises
    ------
    StoreError
        Another run has reserved the folder, or it cannot be written to.
    """
    until_s = time.monotonic() + wait_s
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        while (place := _lock(folder)) is None:
            if time.monotonic() >= until_s:
                raise StoreError(f"{folder}: another run is at work there; wait until it has ended, or give another `out`")
            time.sleep(LOOK_S)
    try:
        yield
    finally:
        if fcntl is None:
            _reservation(folder).unlink(missing_ok=True)
        else:
            fcntl.flock(place, fcntl.LOCK_UN)  # forked processes have the descriptor too, and may live longer
        os.close(place)


def _lock(folder: Path) -> int | None:
    """Descriptor of a locked folder, or if the file system locks no folders, of a file in it. None if another run has locked it."""
    if fcntl is None:
        with suppress(FileExistsError):  # Windows removes the file when its process ends, whatever the cause
            return os.open(_reservation(folder), os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_TEMPORARY", 0))
        return None
    for path, flags in ((folder, os.O_RDONLY), (folder / LOCK, os.O_RDWR | os.O_CREAT)):
        place = os.open(path, flags)
        try:
            fcntl.flock(place, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return place
        except OSError as error:
            os.close(place)
            failure = error
        if isinstance(failure, BlockingIOError):
            return None
    raise failure


def _reservation(folder: Path) -> Path:
    """The file that exists while a folder is reserved on Windows, where a folder can't be locked. It is not in the folder."""
    place = os.path.normcase(os.path.realpath(folder))
    return Path(tempfile.gettempdir()) / f"tactip-twin-{hashlib.sha256(os.fsencode(place)).hexdigest()}"
