"""Work in a folder that can be interrupted and continued at any moment. Results that other code made are never used.

If the items of the work are independent, each is stored under a name that includes a digest of its inputs and of the code. Files of other
code have other names and are not read. If the items are parts of one whole (a data set), the folder contains one record of the code that
makes it, and other code is refused, because the parts would not be consistent.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from twin.errors import StoreError
from twin.store.atomic import make_folder, write_json, write_npz
from twin.store.fingerprint import Maker, code_of, fingerprint, inputs_digest, made_by

MADE_BY = "made_by.json"  # file with the record of the code, in the folder of a whole
_RECORD = "made_by"  # key of the record in the file of an item
_CONTENT = "content"  # key of the content in the file of an item
_STRANGE = re.compile(r"[^-+.=\w]")  # characters that a file's name should not have
_DIGITS = 16  # hexadecimal digits of the digest in a file's name: 64 bits
KEPT = f"*-{'?' * _DIGITS}.*"  # pattern of the names of the files of items
_MOST_CHANGES = 3  # most changes of the code that a message names


@dataclass(frozen=True)
class Item:
    """One piece of work whose result is stored.

    Attributes
    ----------
    name : str
        Readable beginning of the file's name.
    by : tuple of functions, classes or names of modules
        The code that makes the result.
    inputs : object
        All inputs of the result, as ``inputs_digest`` takes them.
    """

    name: str
    by: tuple[Maker, ...]
    inputs: object

    @cached_property
    def file(self) -> str:
        """Name of the item's file without the suffix."""
        digest = inputs_digest(self.inputs, fingerprint(*self.by))
        return f"{_STRANGE.sub('_', self.name)}-{digest[:_DIGITS]}"

    @cached_property
    def made_by(self) -> dict[str, str]:
        """The record of the code that makes it, as in its file."""
        return made_by(*self.by, inputs=self.inputs)


def find_arrays(folder: Path, item: Item) -> dict[str, np.ndarray] | None:
    """Arrays of an item that the same code stored, by name; None if there are none or their file is damaged."""
    try:
        with np.load(folder / f"{item.file}.npz", allow_pickle=False) as file:
            return {name: file[name] for name in file.files if name != _RECORD}
    except Exception:  # zipfile and numpy raise exceptions of any type for damaged files; the file is written again
        return None


def keep_arrays(folder: Path, item: Item, arrays: dict[str, np.ndarray]) -> Path:
    """Store the arrays of an item, and return the file.

    Raises
    ------
    StoreError
        The file can't be written.
    """
    return write_npz(make_folder(folder) / f"{item.file}.npz", arrays | {_RECORD: np.array(json.dumps(item.made_by))})


def kept_arrays(folder: Path, item: Item, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of ``compute()``. They are read from the folder if the same code stored them there, else computed and stored."""
    if (found := find_arrays(folder, item)) is None:
        keep_arrays(folder, item, found := compute())
    return found


def find_json(folder: Path, item: Item) -> Any:
    """Content of an item that the same code stored as JSON; None if there is none or its file is damaged."""
    try:
        return json.loads((folder / f"{item.file}.json").read_text(encoding="utf-8"))[_CONTENT]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def keep_json(folder: Path, item: Item, content: object) -> Path:
    """Store an item as JSON, and return the file.

    Raises
    ------
    StoreError
        The file can't be written.
    """
    return write_json(make_folder(folder) / f"{item.file}.json", {_RECORD: item.made_by, _CONTENT: content})


def kept_json(folder: Path, item: Item, compute: Callable[[], Any]) -> Any:
    """Result of ``compute()`` as JSON holds it. It is read from the folder if the same code stored it there, else computed and stored."""
    if (found := find_json(folder, item)) is None:
        keep_json(folder, item, found := compute())
    return found


def require_same_code(folder: Path, *by: Maker, begun: bool) -> None:
    """Record in a folder which code makes its content, or check that the code has not changed.

    Parameters
    ----------
    folder : Path
    by : functions, classes or names of modules
        The code that makes each of the parts.
    begun : bool
        Whether the folder may already have parts. It must then have a record of the code that made them.

    Raises
    ------
    StoreError
        Other code made the content, the folder has no record of the code, or the record can't be written.
    """
    path, code = folder / MADE_BY, code_of(*by)
    if not begun:
        write_json(path, made_by(*by, dated=False) | code.record())
        return
    remedy = "give another `out`, or remove the folder to make it again"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise StoreError(f"{folder}: does not say what version of the program made it; {remedy}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not readable ({error}); {remedy}") from error
    if not isinstance(record, dict) or not all(isinstance(record.get(part), dict) for part in ("modules", "libraries")):
        raise StoreError(f"{path}: damaged, it does not say what code made the folder; {remedy}")
    changes = code.changes(record)
    if changes:
        more = f" and {len(changes) - _MOST_CHANGES} more" if len(changes) > _MOST_CHANGES else ""
        raise StoreError(f"{folder}: made by another version of the program ({', '.join(changes[:_MOST_CHANGES])}{more}); {remedy}")
