"""Protection of output folders: each is tested before the work, reserved for one run, and no file of others is overwritten.

A folder of results contains a list of the files that this program wrote into it, with a digest of each. A file that is not in the list, or
that has changed since, is not overwritten unless the user requests it (``overwriting``). During a run, the list contains the names that the
run may write without a digest, so that the same command can continue after a run that was killed. The list of single files, which may be
written into the user's working folder, is in the user's home, not beside them.
"""

import errno
import fnmatch
import glob
import hashlib
import inspect
import json
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import platformdirs

from twin.errors import StoreError
from twin.store.atomic import LOCK, PART, lock_folder, unwritten, write_json
from twin.store.fingerprint import PROGRAM

WRITTEN = ".written.json"
"""Name of the list of files that this program wrote into a folder."""
_ANY = ""  # replaces a digest if the content does not matter: the file is being written, or it is a folder
_WAIT_S = 10.0  # longest wait for another run that enters its file into the same list
_MOST_NAMED = 3  # largest number of files that a message names
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}  # errors that concern the output alone
_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())  # folders that are reserved in this context
_overwrite: ContextVar[bool] = ContextVar("overwrite", default=False)

Given = ParamSpec("Given")
Made = TypeVar("Made")


@contextmanager
def overwriting(wanted: bool = True) -> Iterator[None]:
    """Context in which outputs may replace files that this program did not write, as with ``--force``; no effect if not ``wanted``."""
    before = _overwrite.set(wanted or _overwrite.get())
    try:
        yield
    finally:
        _overwrite.reset(before)


@contextmanager
def output(folder: Path, *names: str, gone_on: tuple[str, ...] = ()) -> Iterator[None]:
    """Context that reserves a folder for this run, which writes files or folders with the given names into it.

    The folder is created if missing, and removed if the run fails before it has written anything. A run may open a folder again that it
    has already reserved.

    Parameters
    ----------
    folder : Path
    names : str
        Names of all files and folders that may be written directly below the folder, as patterns of ``fnmatch``. A folder with such a name
        belongs to the program with all its content.
    gone_on : tuple of str
        Names of files from which a later run continues. That run checks their content itself, so a changed file is not refused.

    Raises
    ------
    StoreError
        If the folder can't be written to, if another run uses it, if it contains a file with one of these names that this program did not
        write or that has changed since, or if the disk becomes full during the work.
    """
    with _unmade_if_empty(folder), _held_once(folder), _convert_disk_error(folder):
        every = (*names, *gone_on)
        written = _require_ours(folder, every)
        _write_list(folder / WRITTEN, written | dict.fromkeys(every, _ANY))
        try:
            yield
        finally:
            with suppress(StoreError):  # the names stay in the list without digests
                _enter(folder, every, gone_on)


@contextmanager
def output_file(path: Path, *beside: str) -> Iterator[None]:
    """Context that checks first that a file can be written, and enters it into a list at the end.

    The folder is created if missing, and removed if it is still empty after an error. It is not reserved in between, because it may be the
    user's working folder.

    Parameters
    ----------
    path : Path
    beside : str
        Endings of other files that are written, as patterns of ``fnmatch``. Their names begin with the file's name without its suffix.

    Raises
    ------
    StoreError
        As ``output``.
    """
    folder, names = path.parent, [glob.escape(path.name), *(glob.escape(path.stem) + ending for ending in beside)]
    with _unmade_if_empty(folder), _convert_disk_error(path):
        with _held_once(folder, wait_s=_WAIT_S):
            _require_ours(folder, names)
            _require_room(folder)
        try:
            yield
        finally:
            with suppress(StoreError, OSError), _held_once(folder, wait_s=_WAIT_S):
                _enter(folder, names, alone=False)


def writes(*names: str, gone_on: tuple[str, ...] = (), to: str = "out") -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Decorator for a function that writes files with these names into the folder given by its parameter ``to`` (see ``output``)."""
    return _opening(to, lambda path: output(path, *names, gone_on=gone_on))


def writes_file(*beside: str, to: str = "out") -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Decorator for a function that writes the file given by its parameter ``to``, if that is not None (see ``output_file``)."""
    return _opening(to, lambda path: output_file(path, *beside))


def _opening(to: str, context: Callable[[Path], AbstractContextManager[None]]) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    def decorate(function: Callable[Given, Made]) -> Callable[Given, Made]:
        signature = inspect.signature(function)
        if to not in signature.parameters:
            raise TypeError(f"{function.__qualname__} has no parameter {to!r}")

        @wraps(function)
        def call_in_context(*args: Given.args, **kwargs: Given.kwargs) -> Made:
            path = signature.bind(*args, **kwargs).arguments.get(to)
            if path is None:
                return function(*args, **kwargs)
            with context(Path(path)):
                return function(*args, **kwargs)

        return call_in_context

    return decorate


def contents(folder: Path) -> list[str]:
    """Sorted names of the files and folders in a folder, without the store's own files.

    Raises
    ------
    StoreError
        If the folder can't be read.
    """
    try:
        names = [path.name for path in folder.iterdir() if path.name not in (LOCK, WRITTEN)]
        return sorted(name for name in names if not (name.startswith(".") and name.endswith(PART)))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(f"{folder}: can't be read ({error.strerror}); give another folder") from error


def written_by_us(folder: Path) -> list[str]:
    """Sorted names of the files and folders in a folder that this program wrote and that have not changed since."""
    known = _read_list(folder)
    return [name for name in contents(folder) if _is_ours(folder / name, known)]


def _require_ours(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The folder's list, after a check that files with the given names may be written.

    Raises
    ------
    StoreError
        If there is a file with such a name that this program did not write or that has changed since.
    """
    known = _read_list(folder)
    foreign = [name for name in _there(folder, names) if not _is_ours(folder / name, known)]
    if foreign and not _overwrite.get():
        shown = ", ".join(foreign[:_MOST_NAMED]) + (f" and {len(foreign) - _MOST_NAMED} more" if len(foreign) > _MOST_NAMED else "")
        raise StoreError(
            f"{folder}: holds files that this program did not write, or that were changed since ({shown}); "
            "give another `out`, or `force=True` to write over them"
        )
    return known


def _there(folder: Path, names: Iterable[str]) -> list[str]:
    """Names of the files and folders in a folder that match the patterns ``names``."""
    patterns = tuple(names)
    return [name for name in contents(folder) if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]


def _is_ours(path: Path, known: dict[str, str]) -> bool:
    """Whether a file agrees with the list of its folder; for a folder, whether it is in the list or empty."""
    digest = known.get(path.name)
    if digest is None:
        pattern = any(value == _ANY and fnmatch.fnmatchcase(path.name, name) for name, value in known.items())
        return pattern or (path.is_dir() and not path.is_symlink() and not contents(path))
    return digest in (_ANY, _digest(path))


def _enter(folder: Path, names: Sequence[str], gone_on: Sequence[str] = (), *, alone: bool = True) -> None:
    """Enter the existing files with these names into the list, with their digests except for ``gone_on``; remove names without a file.

    Names of other runs without a file are removed if this run is ``alone``: those runs were killed. Otherwise they may be at work.
    """
    path, known = _list_of(folder), {name: digest for name, digest in _read_list(folder).items() if name not in names}
    if alone:
        known = {name: digest for name, digest in known.items() if digest != _ANY or (folder / name).exists()}
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_list(path, known | {name: _ANY if name in gone_on else _digest(folder / name) for name in _there(folder, names)})


def _digest(path: Path) -> str:
    """Digest of a regular file; ``_ANY`` for anything else."""
    if path.is_symlink() or not path.is_file():
        return _ANY
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return _ANY


def _list_of(folder: Path) -> Path:
    """The file of a folder's list: in the folder if results are there, else in the user's home."""
    inside = folder / WRITTEN
    if os.path.lexists(inside):
        return inside
    name = hashlib.sha256(os.fsencode(os.path.realpath(folder))).hexdigest()
    return Path(platformdirs.user_state_dir(PROGRAM)) / "written" / f"{name}.json"


def _read_list(folder: Path) -> dict[str, str]:
    """The files that this program wrote, with their digests; empty if the list is damaged."""
    path = _list_of(folder)
    if path.is_symlink() or not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return {name: digest for name, digest in content.items() if isinstance(digest, str)} if isinstance(content, dict) else {}


def _write_list(path: Path, content: dict[str, str]) -> None:
    if content:
        write_json(path, dict(sorted(content.items())))
    else:
        path.unlink(missing_ok=True)


def _require_room(folder: Path) -> None:
    """Raise OSError if no file can be written into a folder."""
    with tempfile.TemporaryFile(dir=folder) as file:
        file.write(b" ")
        file.flush()


@contextmanager
def _unmade_if_empty(folder: Path) -> Iterator[None]:
    """Context that removes the folders again which were made in it, if it ends with an error and nothing was written there."""
    folder = Path(os.path.abspath(folder))  # the run may change the working folder
    made = [each for each in (folder, *folder.parents) if not os.path.exists(each)]
    try:
        yield
    except BaseException:
        with suppress(StoreError, OSError):  # another run is at work there, or a folder holds something
            if made:
                with lock_folder(folder):
                    for each in made:
                        each.rmdir()
        raise


@contextmanager
def _held_once(folder: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Context that reserves a folder as ``lock_folder`` does, unless this context has reserved it already."""
    place = Path(os.path.abspath(folder))
    if place in _held.get():
        yield
        return
    with lock_folder(folder, wait_s=wait_s):
        before = _held.set(_held.get() | {place})
        try:
            yield
        finally:
            _held.reset(before)


@contextmanager
def _convert_disk_error(path: Path) -> Iterator[None]:
    """Context that converts the error of a full or read-only disk to the ``StoreError`` of ``unwritten``."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        raise unwritten(Path(error.filename) if isinstance(error.filename, str) else path, error) from error
