"""What went into a result, as one digest."""

import hashlib
import json
from dataclasses import fields, is_dataclass
from pathlib import PurePath

import numpy as np
from pydantic import BaseModel


def inputs_digest(*inputs: object) -> str:
    """Digest of inputs, 64 hexadecimal digits; the order of a dict's keys does not matter.

    Parameters
    ----------
    inputs : objects
        What JSON can hold, bytes, arrays of numbers, specifications, dataclasses and paths, in each other as deep as need be.

    Raises
    ------
    TypeError
        One is of another kind.
    """
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=_plain).encode()).hexdigest()


def _plain(value: object) -> object:
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
