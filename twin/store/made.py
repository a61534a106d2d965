"""The record that every output has of the code that made it, and the digest of its inputs."""

import hashlib
import json
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import PurePath

import numpy as np
from pydantic import BaseModel

from twin.store.fingerprint import Maker, fingerprint, name_of

PROGRAM = "tactip-twin"
"""Name under which this program is installed."""


def inputs_digest(*inputs: object) -> str:
    """Digest of inputs, 64 hexadecimal digits. It does not depend on the order of a dict's keys.

    Parameters
    ----------
    inputs : objects
        Values that JSON can hold, bytes, arrays of numbers, specifications, dataclasses and paths, nested to any depth.

    Raises
    ------
    TypeError
        An input has another type.
    """
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=_plain).encode()).hexdigest()


def _plain(value: object) -> object:
    """A value that JSON can represent, in place of one that it can't."""
    if isinstance(value, bytes):
        return {"sha256": hashlib.sha256(value).hexdigest()}
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return {"array": [value.dtype.str, list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, PurePath):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    raise TypeError(f"a key holds JSON and bytes, arrays of numbers, specifications and dataclasses, not {type(value).__name__}")


def made_by(*by: Maker, inputs: object = None, dated: bool = True) -> dict[str, str]:
    """The record of a result.

    Parameters
    ----------
    by : functions, classes or names of modules
        The code that made the result; the record has the name of the first one.
    inputs : object, optional
        The inputs of the result, as ``inputs_digest`` takes them.
    dated : bool
        Whether the record has a date. It must be False if the same work must give the same bytes.

    Returns
    -------
    dict of str to str
        ``by`` (name), ``version`` (of the program), ``code`` (fingerprint), ``inputs`` (digest, if there are any) and ``date`` (UTC).
    """
    record = {"by": name_of(by[0]), "version": program_version(), "code": fingerprint(*by)}
    if inputs is not None:
        record["inputs"] = inputs_digest(inputs)
    return record | ({"date": datetime.now(UTC).isoformat(timespec="seconds")} if dated else {})


def program_version() -> str:
    """Version of this program, or "not installed"."""
    try:
        return metadata.version(PROGRAM)
    except metadata.PackageNotFoundError:
        return "not installed"
