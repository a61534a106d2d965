"""The base of every section of a specification (frozen, strict, no unknown key, no NaN), and the error that specifications raise."""

import unicodedata
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator


class SpecError(ValueError):
    """A specification file is missing, unreadable or impossible.

    The message names the file, the key and the remedy, on one line.
    """


# Largest number of characters of a name. File systems allow 255 bytes, a character has up to 4 bytes in UTF-8, and names get prefixes and
# suffixes.
LONGEST_NAME = 100


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


def _data_uri(text: str) -> str:
    head, _, content = text.partition(",")
    if not (head.startswith(PICTURE) and head.endswith(";base64") and content):
        raise ValueError("expected a picture: { picture = 'file name' } of a PNG, JPEG or WebP file, or of a text file with its data URI")
    return text


PICTURE = "data:image/"
"""Beginning of a picture as text: a data URI (RFC 2397) with base64 content."""
Picture = Annotated[str, AfterValidator(_data_uri)]
Name = Annotated[str, AfterValidator(_plain_name)]
# Validator for a choice of numbers. It refuses true and false, which Python (and therefore ``Literal``) accepts as 1 and 0.
NotTruth = BeforeValidator(_no_truth)
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Index = Annotated[float, Field(ge=1, le=3)]
NearOne = Annotated[float, Field(ge=0.9, le=1.1)]
Rgb = tuple[Fraction, Fraction, Fraction]


class Section(BaseModel):
    """A frozen section of a specification file. Unknown keys are errors. Booleans and texts in place of numbers are errors, too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, data: object) -> object:
        """Turn the lists of a file into tuples, because a section is frozen."""
        return _as_tuples(data)


def _as_tuples(value: object) -> object:
    if isinstance(value, list):
        return tuple(map(_as_tuples, value))
    return {key: _as_tuples(part) for key, part in value.items()} if isinstance(value, dict) else value
