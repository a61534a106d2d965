"""Work in a folder that can be ended at any moment and gone on with, without ever taking a result that other code made.

Work of independent items keeps each of them under a name that holds a digest of its inputs and of the code: what other code
made lies beside and is not looked at. Work whose items belong to one whole (a data set) says once what code makes it, and other
code is refused: it would mix.
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
from twin.store.atomic import unwritten, write_json, write_npz
from twin.store.fingerprint import Maker, code_of, fingerprint
from twin.store.made import inputs_digest, made_by

MADE_BY = "made_by.json"  # in the folder of a whole
_RECORD = "made_by"  # in the file of an item
_CONTENT = "content"
_STRANGE = re.compile(r"[^-+.=\w]")  # what a file's name should not hold
_DIGITS = 16  # of the digest in a file's name: 64 bits
_MOST_CHANGES = 3  # that a message names


@dataclass(frozen=True)
class Item:
    """One piece of work whose result is kept.

    Attributes
    ----------
    name : str
        For people: the beginning of its file's name.
    by : tuple of functions, classes or names of modules
        What makes it.
    inputs : object
        All that it is made of, as ``inputs_digest`` takes it.
    """

    name: str
    by: tuple[Maker, ...]
    inputs: object

    @cached_property
    def file(self) -> str:
        """Its file's name without the suffix."""
        digest = inputs_digest(self.inputs, fingerprint(*self.by))
        return f"{_STRANGE.sub('_', self.name)}-{digest[:_DIGITS]}"

    @cached_property
    def made_by(self) -> dict[str, str]:
        """What makes it, as its file tells."""
        return made_by(*self.by, inputs=self.inputs)


def find_arrays(folder: Path, item: Item) -> dict[str, np.ndarray] | None:
    """Arrays by name that the same code kept of an item; None where there are none, or their file is damaged."""
    try:
        with np.load(folder / f"{item.file}.npz", allow_pickle=False) as file:
            return {name: file[name] for name in file.files if name != _RECORD}
    except Exception:  # damaged bytes raise whatever zipfile and numpy run into; the file is written anew
        return None


def keep_arrays(folder: Path, item: Item, arrays: dict[str, np.ndarray]) -> Path:
    """Keep the arrays of an item; the file.

    Raises
    ------
    StoreError
        They can't be written.
    """
    return write_npz(_ready(folder) / f"{item.file}.npz", arrays | {_RECORD: np.array(json.dumps(item.made_by))})


def kept_arrays(folder: Path, item: Item, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of ``compute()``, from the folder where the same code kept them."""
    found = find_arrays(folder, item)
    if found is None:
        found = compute()
        keep_arrays(folder, item, found)
    return found


def find_json(folder: Path, item: Item) -> Any:
    """What the same code kept of an item as JSON; None where there is nothing, or its file is damaged."""
    try:
        return json.loads((folder / f"{item.file}.json").read_text(encoding="utf-8"))[_CONTENT]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def keep_json(folder: Path, item: Item, content: object, *, default: Callable[[object], object] | None = None) -> Path:
    """Keep an item as JSON (``default`` as of ``json.dumps``); the file.

    Raises
    ------
    StoreError
        It can't be written.
    """
    return write_json(_ready(folder) / f"{item.file}.json", {_RECORD: item.made_by, _CONTENT: content}, default=default)


def kept_json(folder: Path, item: Item, compute: Callable[[], Any]) -> Any:
    """What ``compute()`` gives, as JSON holds it, from the folder where the same code kept it."""
    found = find_json(folder, item)
    if found is None:
        found = compute()
        keep_json(folder, item, found)
    return found


def require_same_code(folder: Path, *by: Maker, begun: bool) -> None:
    """Say in a folder what code makes the whole in it, or make sure that it is still the same.

    Parameters
    ----------
    folder : Path
    by : functions, classes or names of modules
        What makes each of its parts.
    begun : bool
        Whether parts may be there: then the folder has to say what made them.

    Raises
    ------
    StoreError
        Other code made it, or it does not say what made it; or the record can't be written.
    """
    path, code = folder / MADE_BY, code_of(*by)
    if not begun:
        write_json(path, made_by(*by, dated=False) | code.record())
        return
    remedy = "give another --out, or remove the folder to make it anew"
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


def _ready(folder: Path) -> Path:
    """The folder, made if missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritten(folder, error) from error
    return folder
