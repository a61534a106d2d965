"""Arrays that are slow to compute, kept on disk between processes.

Each entry is one file whose name is its key's hash. A cache may fail, the work may not: whatever is wrong with the
folder or a file, the arrays are computed, and one warning names the path. ``TACTIP_CACHE`` names another folder, or
``off`` for none.
"""

import hashlib
import json
import os
import re
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np
import platformdirs

_VARIABLE = "TACTIP_CACHE"
_FORMAT = 1  # raised whenever older files must not be read
_LIMIT_BYTES = 1_000_000_000  # of all entries together; the longest unused go first
_OURS = re.compile(r"[\w-]+-[0-9a-f]{64}\.npz(\.\w+\.part)?")  # the folder may hold other things, which are left alone


def cached_arrays(kind: str, key: dict, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of ``compute()``, from disk where they are kept.

    Parameters
    ----------
    kind : str
        What the arrays are, in letters, digits and hyphens: a part of the file's name and of the key.
    key : dict
        Everything the arrays depend on: what JSON can hold, and bytes.
    compute : callable
        Gives arrays by name; no array of objects. Its errors are the caller's, and nothing is kept then.

    Returns
    -------
    dict of str to array
    """
    folder = cache_folder()
    if folder is None:
        return _arrays(compute)
    path = folder / f"{kind}-{_digest(kind, key)}.npz"
    found = _read(path)
    if found is None:
        found = _arrays(compute)
        _write(path, found)
    return found


@cache
def code_digest(*packages: str) -> str:
    """Digest of the Python and TOML files of packages beside this one: whatever is computed by them may be another where it changes."""
    digest, root = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(path for package in packages for path in (root / package).rglob("*") if path.suffix in (".py", ".toml")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def cache_folder() -> Path | None:
    """Where entries are kept; None where the cache is off."""
    chosen = os.environ.get(_VARIABLE, "")
    if chosen.lower() == "off":
        return None
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("tactip-twin"))


def _arrays(compute) -> dict[str, np.ndarray]:
    found = {name: np.asarray(value) for name, value in compute().items()}
    if any(value.dtype.hasobject for value in found.values()):
        raise TypeError("arrays of objects can't be kept; give arrays of numbers")
    return found


def _digest(kind: str, key: dict) -> str:
    def plain(value):
        if isinstance(value, bytes):
            return {"sha256": hashlib.sha256(value).hexdigest()}
        raise TypeError(f"a cache key holds JSON and bytes, not {type(value).__name__}")

    text = json.dumps([_FORMAT, kind, key], sort_keys=True, default=plain)
    return hashlib.sha256(text.encode()).hexdigest()


def _read(path: Path) -> dict[str, np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (FileNotFoundError, NotADirectoryError):
        return None
    except Exception as error:  # damaged bytes raise whatever zipfile and numpy run into; the file is written anew
        _warn(f"{path}: not a readable cache entry ({error}); computed again")
        return None
    with suppress(OSError):
        os.utime(path)  # used now
    return found


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Keep arrays; other processes see the whole file or none."""
    part = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f"{path.name}.", suffix=".part", delete=False) as file:
            part = Path(file.name)
            np.savez(file, **arrays)
        os.replace(part, path)
        _make_room(path.parent)
    except OSError as error:
        _warn(f"{path.parent}: results can't be kept ({error.strerror or error}); set {_VARIABLE} to a writable folder, or to off")
        if part is not None:
            with suppress(OSError):
                part.unlink(missing_ok=True)


def _make_room(folder: Path) -> None:
    """Remove the longest unused entries above the limit; parts that a killed process left count as entries."""
    entries = []
    for path in folder.iterdir():
        if _OURS.fullmatch(path.name):
            with suppress(FileNotFoundError):  # another process was faster
                status = path.stat()
                entries.append((status.st_mtime_ns, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= _LIMIT_BYTES:
            return
        path.unlink(missing_ok=True)
        total -= size


@cache
def _warn(message: str) -> None:
    """Each message once in a process."""
    warnings.warn(message, RuntimeWarning, stacklevel=4)
