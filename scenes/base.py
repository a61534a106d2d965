"""What every section of a specification shares: frozen, strict, no unknown key, no NaN; and the error that a specification raises."""

import unicodedata
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator


class SpecError(ValueError):
    """A specification file is missing, unreadable or impossible.

    The message names the file, the key and the remedy, on one line.
    """


LONGEST_NAME = 100  # characters; file systems take 255 bytes, and a name in UTF-8 has up to 4 in each character


def _plain_name(name: str) -> str:
    if not 0 < len(name) <= LONGEST_NAME:
        raise ValueError(f"a name has 1 to {LONGEST_NAME} characters, this one has {len(name)}")
    if name in (".", "..") or set(name) & {"/", "\\"} or any(unicodedata.category(c).startswith("C") for c in name):
        raise ValueError("a name becomes that of a file or folder: without '/', '\\' and control characters")
    return name


def _no_truth(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


Name = Annotated[str, AfterValidator(_plain_name)]
NotTruth = BeforeValidator(_no_truth)  # for a choice of numbers: to Python, and so to ``Literal``, true is 1
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Index = Annotated[float, Field(ge=1, le=3)]
NearOne = Annotated[float, Field(ge=0.9, le=1.1)]
Rgb = tuple[Fraction, Fraction, Fraction]


class Section(BaseModel):
    """A frozen section of a specification file; unknown keys are errors, and so are truths and texts in the place of numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, data: object) -> object:
        """Files have lists, where a frozen section has tuples."""
        return _as_tuples(data)


def _as_tuples(value: object) -> object:
    if isinstance(value, list):
        return tuple(map(_as_tuples, value))
    return {key: _as_tuples(part) for key, part in value.items()} if isinstance(value, dict) else value
