"""The base of every section of a specification (frozen, strict, no unknown key, no NaN), and the error that specifications raise."""

import unicodedata
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.fields import FieldInfo


class SpecError(ValueError):
    """A specification file is missing, unreadable or impossible.

    The message names the file, the key and the remedy, on one line.
    """


def problem_text(found: Mapping[str, Any]) -> str:
    """What is wrong, of one of pydantic's errors, in our words."""
    return str(found["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")


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

    former_keys: ClassVar[Mapping[str, str]] = {}
    """Present keys by their names in files of version 1."""

    @model_validator(mode="before")
    @classmethod
    def _read_keys(cls, data: object) -> object:
        """Keys under their present names, and the lists of a file as tuples, because a section is frozen."""
        return _as_tuples({cls.former_keys.get(key, key): value for key, value in data.items()} if isinstance(data, dict) else data)

    @classmethod
    def file_keys(cls) -> dict[str, FieldInfo]:
        """The keys of the section in a file."""
        return cls.model_fields

    def alter(self, **values: Any) -> Self:
        """A copy with other values. A dict for a section changes these keys of it. Values are not validated: they are computed in range."""
        parts = {key: getattr(self, key) for key, value in values.items() if isinstance(value, dict)}
        sections = {key: part.alter(**values[key]) for key, part in parts.items() if isinstance(part, Section)}
        return self.model_copy(update=values | sections)


class OpenSection(Section, extra="allow"):
    """A section of which one key names a part, as a layout or a law, and which holds the keys of this part beside its own."""

    part_key: ClassVar[str]

    @classmethod
    def parts(cls) -> Mapping[str, type[Section]]:
        """Classes of the parts by name."""
        raise NotImplementedError

    @classmethod
    def file_keys(cls) -> dict[str, FieldInfo]:
        return cls.model_fields | {key: field for part in cls.parts().values() for key, field in part.model_fields.items()}

    @property
    def part(self) -> Any:
        """The named part with its keys."""
        return self.parts()[getattr(self, self.part_key)].model_construct(**self.__pydantic_extra__ or {})

    @model_validator(mode="after")
    def _take_part(self) -> Self:
        parts, name, given = self.parts(), getattr(self, self.part_key), dict(self.__pydantic_extra__ or {})
        if name not in parts:
            raise ValueError(f"{self.part_key} must be one of {', '.join(map(repr, parts))}, got '{name}'")
        for key in given.keys() - parts[name].model_fields.keys():
            owners = {owner: part.model_fields[key].default for owner, part in parts.items() if key in part.model_fields}
            if owners and given[key] in (None, (), *owners.values()):  # as files of earlier versions hold them
                del given[key]
            elif owners:
                raise ValueError(f"{key} belongs to {self.part_key} = {' or '.join(map(repr, owners))}, not to '{name}'")
        part = parts[name].model_validate(given)
        object.__setattr__(self, "__pydantic_extra__", part.model_dump(exclude_defaults=True))
        return self


def _as_tuples(value: object) -> object:
    if isinstance(value, list):
        return tuple(map(_as_tuples, value))
    return {key: _as_tuples(part) for key, part in value.items()} if isinstance(value, dict) else value
