"""Where a run writes its results: tried before the work, held for this run alone, and without loss of what others wrote there.

A folder of results has a list of the files that this program wrote into it, with a digest of each. A file that is not in the list, or
that was changed since, is not overwritten unless the user asks for it (``overwriting``). While a run is at work, the names that it
may write are in the list without a digest, so that the same command goes on after a run that was killed.
"""

import errno
import fnmatch
import glob
import hashlib
import inspect
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from twin.errors import StoreError
from twin.store.atomic import LOCK, PART, locked, unwritten, write_json

WRITTEN = ".written.json"
"""Name of the list of files that this program wrote into a folder."""
_ANY = ""  # in place of a digest: the content does not count, because the file is being written, or because it is a folder
_WAIT_S = 10.0  # for another run that enters its file into the same list
_MOST_NAMED = 3  # files in a message
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}  # errors that concern the output alone
_held: ContextVar[frozenset[Path]] = ContextVar("held", default=frozenset())  # folders that are held in this context
_overwrite: ContextVar[bool] = ContextVar("overwrite", default=False)

Given = ParamSpec("Given")
Made = TypeVar("Made")


@contextmanager
def overwriting(wanted: bool = True) -> Iterator[None]:
    """Context in which outputs may replace files that this program did not write, as with ``--force``; nothing where not ``wanted``."""
    before = _overwrite.set(wanted or _overwrite.get())
    try:
        yield
    finally:
        _overwrite.reset(before)


@contextmanager
def output(folder: Path, *names: str, gone_on: tuple[str, ...] = ()) -> Iterator[None]:
    """Hold a folder (made if missing) for this run, which writes files or folders of some names into it.

    A run may open a folder that it holds already.

    Parameters
    ----------
    folder : Path
    names : str
        Of everything that may be written right below the folder, as patterns of ``fnmatch``. A folder among them belongs to the program
        with all that is in it.
    gone_on : tuple of str
        Of files that a later run goes on from. That run itself checks what is in them, so a change of theirs is no reason to refuse it.

    Raises
    ------
    StoreError
        The folder can't be written to, another run is at work in it, it holds a file of these names that this program did not write or
        that was changed since, or the disk becomes full during the work.
    """
    with _held_once(folder), _told(folder):
        every = (*names, *gone_on)
        written = _require_ours(folder, every)
        _write_list(folder, written | dict.fromkeys(every, _ANY))
        try:
            yield
        finally:
            with suppress(StoreError):  # the names stay in the list without digests
                _enter(folder, every, gone_on)


@contextmanager
def output_file(path: Path, *beside: str) -> Iterator[None]:
    """Make sure that a file can be written, and enter it into the list of its folder (made if missing) after the work.

    The folder is not held meanwhile: it may be the one that a user works in.

    Parameters
    ----------
    path : Path
    beside : str
        Endings, as patterns of ``fnmatch``, of other files whose names begin with the file's name without its suffix.

    Raises
    ------
    StoreError
        As of ``output``.
    """
    folder, names = path.parent, [glob.escape(path.name), *(glob.escape(path.stem) + ending for ending in beside)]
    with _told(path):
        with _held_once(folder, wait_s=_WAIT_S):
            _write_list(folder, _require_ours(folder, names))
        try:
            yield
        finally:
            with suppress(StoreError), _held_once(folder, wait_s=_WAIT_S):
                _enter(folder, names)


def writes(*names: str, gone_on: tuple[str, ...] = (), to: str = "out") -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Decorator of a function that writes these names into the folder which its parameter ``to`` gives; see ``output``."""
    return _opening(to, lambda path: output(path, *names, gone_on=gone_on))


def writes_file(*beside: str, to: str = "out") -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Decorator of a function that writes the file which its parameter ``to`` gives, if it is not None; see ``output_file``."""
    return _opening(to, lambda path: output_file(path, *beside))


def _opening(to: str, context: Callable[[Path], AbstractContextManager[None]]) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    def decorated(function: Callable[Given, Made]) -> Callable[Given, Made]:
        signature = inspect.signature(function)
        if to not in signature.parameters:
            raise TypeError(f"{function.__qualname__} has no parameter {to!r}")

        @wraps(function)
        def opened(*args: Given.args, **kwargs: Given.kwargs) -> Made:
            path = signature.bind(*args, **kwargs).arguments.get(to)
            if path is None:
                return function(*args, **kwargs)
            with context(Path(path)):
                return function(*args, **kwargs)

        return opened

    return decorated


def contents(folder: Path) -> list[str]:
    """Sorted names of what lies in a folder, without what the store keeps there for itself.

    Raises
    ------
    StoreError
        The folder can't be read.
    """
    try:
        return sorted(
            path.name
            for path in folder.iterdir()
            if path.name not in (LOCK, WRITTEN) and not (path.name.startswith(".") and path.name.endswith(PART))
        )
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StoreError(f"{folder}: can't be read ({error.strerror}); give another folder") from error


def written_by_us(folder: Path) -> list[str]:
    """Sorted names in a folder that this program wrote and that were not changed since."""
    known = _read_list(folder)
    return [name for name in contents(folder) if _is_ours(folder / name, known)]


def _require_ours(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """The folder's list, once it is sure that the names may be written.

    Raises
    ------
    StoreError
        One is there that this program did not write.
    """
    known = _read_list(folder)
    foreign = [name for name in _there(folder, names) if not _is_ours(folder / name, known)]
    if foreign and not _overwrite.get():
        shown = ", ".join(foreign[:_MOST_NAMED]) + (f" and {len(foreign) - _MOST_NAMED} more" if len(foreign) > _MOST_NAMED else "")
        raise StoreError(
            f"{folder}: holds files that this program did not write, or that were changed since ({shown}); "
            "give another --out, or --force to write over them"
        )
    return known


def _there(folder: Path, names: Iterable[str]) -> list[str]:
    """What lies in a folder under these names."""
    patterns = tuple(names)
    return [name for name in contents(folder) if any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]


def _is_ours(path: Path, known: dict[str, str]) -> bool:
    """Whether a file is as the list of its folder says, or a folder is in the list or empty."""
    digest = known.get(path.name)
    if digest is None:
        pattern = any(value == _ANY and fnmatch.fnmatchcase(path.name, name) for name, value in known.items())
        return pattern or (path.is_dir() and not path.is_symlink() and not contents(path))
    return digest in (_ANY, _digest(path))


def _enter(folder: Path, names: Sequence[str], gone_on: Sequence[str] = ()) -> None:
    """Enter what lies there under these names, with its digest if no run goes on from it; names of nothing leave the list."""
    known = {name: digest for name, digest in _read_list(folder).items() if name not in names}
    found = {name: _ANY if name in gone_on else _digest(folder / name) for name in _there(folder, names)}
    _write_list(folder, {name: digest for name, digest in (known | found).items() if digest != _ANY or (folder / name).exists()})


def _digest(path: Path) -> str:
    """Digest of a file; of anything else none."""
    if path.is_symlink() or not path.is_file():
        return _ANY
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return _ANY


def _read_list(folder: Path) -> dict[str, str]:
    """The files that this program wrote, with their digests. A list that is damaged names none."""
    path = folder / WRITTEN
    if path.is_symlink() or not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(content, dict):
        return {}
    return {name: digest for name, digest in content.items() if isinstance(digest, str)}


def _write_list(folder: Path, content: dict[str, str]) -> None:
    path = write_json(folder / WRITTEN, dict(sorted(content.items())))
    if not content:  # written all the same, because this tries the folder
        path.unlink(missing_ok=True)


@contextmanager
def _held_once(folder: Path, *, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a folder as ``locked`` does, unless this context holds it already."""
    place = Path(os.path.abspath(folder))
    if place in _held.get():
        yield
        return
    with locked(folder, wait_s=wait_s):
        before = _held.set(_held.get() | {place})
        try:
            yield
        finally:
            _held.reset(before)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Context in which a full disk, or one that became read-only, is told as the store tells it, whoever notices it."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_ROOM:
            raise
        raise unwritten(Path(error.filename) if isinstance(error.filename, str) else path, error) from error
