"""A cache on disk of arrays that are slow to compute.

Each entry is one file, whose name is the hash of its key and of the code that computes it. A failure of the cache does not stop the work:
if the folder or a file can't be used, the arrays are computed, and one warning names the path. The environment variable ``TACTIP_CACHE``
names another folder, or is ``off`` for no cache.
"""

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from twin.errors import StoreError, warn_once
from twin.store.atomic import CACHE_VARIABLE, cache_folder, write_npz
from twin.store.fingerprint import Maker, UnknownCodeError, fingerprint, inputs_digest

_FORMAT = 2  # version of the files' format; it is increased if older files must not be read
_LIMIT_BYTES = 1_000_000_000  # largest size of all entries together; entries that were unused longest are removed first
_ENTRY = r"[\w-]+-[0-9a-f]{64}\.npz"
_OURS = re.compile(rf"{_ENTRY}|\.{_ENTRY}\.\w+\.part")  # other files in the folder are not touched


def cached_arrays(
    kind: str, key: dict, compute: Callable[[], dict[str, np.ndarray]], *, code: tuple[Maker, ...] | None = None
) -> dict[str, np.ndarray]:
    """The arrays of ``compute()``. They are read from disk if they are stored there, else computed and stored.

    Parameters
    ----------
    kind : str
        Name of the kind of arrays, of letters, digits and hyphens. It is part of the file's name and of the key.
    key : dict
        Every input that the arrays depend on, as ``inputs_digest`` takes it.
    compute : callable
        Returns arrays by name; arrays of objects are not allowed. Its errors are passed on, and nothing is stored then.
    code : tuple of functions, classes or names of modules, optional
        The code that the arrays depend on; by default ``compute``. It should be given if the module of ``compute`` imports much that
        does not affect the arrays.

    Returns
    -------
    dict of str to array

    Notes
    -----
    Arrays that other code computed are not used. If the code of ``compute`` can't be read, nothing is stored.
    """
    digest = inputs_digest(_FORMAT, kind, key)
    folder = cache_folder()
    if folder is None:
        return _arrays(compute)
    try:
        path = folder / f"{kind}-{inputs_digest(digest, fingerprint(*(code or (compute,))))}.npz"
    except UnknownCodeError as error:
        warn_once(str(error))
        return _arrays(compute)
    found = _read_arrays(path)
    if found is None:
        found = _arrays(compute)
        _write(path, found)
    return found


def _arrays(compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    found = {name: np.asarray(value) for name, value in compute().items()}
    if any(value.dtype.hasobject for value in found.values()):
        raise TypeError("arrays of objects can't be kept; give arrays of numbers")
    return found


def _read_arrays(path: Path) -> dict[str, np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (FileNotFoundError, NotADirectoryError):
        return None
    except Exception as error:  # zipfile and numpy raise exceptions of any type for damaged files; the file is written again
        warn_once(f"{path}: not a readable cache entry ({error}); computed again")
        return None
    with suppress(OSError):
        os.utime(path)  # records the time of use
    return found


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Store arrays. Other processes see the complete file or none."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_npz(path, arrays)
        _make_room(path.parent)
    except (OSError, StoreError) as error:
        reason = error.__cause__ if isinstance(error, StoreError) else error
        why = getattr(reason, "strerror", None) or reason
        warn_once(f"{path.parent}: results can't be kept ({why}); set {CACHE_VARIABLE} to a writable folder, or to off")


def _make_room(folder: Path) -> None:
    """Remove the entries that were unused longest until the limit is met. Temporary files of killed processes count as entries."""
    entries = []
    for path in folder.iterdir():
        if _OURS.fullmatch(path.name):
            with suppress(FileNotFoundError):  # another process has removed it
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= _LIMIT_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= size
