"""The reference of every specification file: each key with its unit, default, allowed values and meaning, from the classes that read it."""

import inspect
import re
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen, MinLen, MultipleOf
from pydantic.fields import FieldInfo

from hardware.safety.decide import SafetyLimits
from scenes import ExperimentSpec, ObjectSpec, RandomisationSpec, SensorSpec, ServoSpec
from scenes.base import OpenSection, Section
from twin.evaluation.degradation.study import SweepPlan
from twin.pins import DetectorSpec


@dataclass(frozen=True)
class SpecificationFile:
    """One kind of file that a user writes.

    Attributes
    ----------
    stem : str
        Of the page.
    title : str
    root : type of Section
    where : str
        Where the program reads it, Markdown.
    """

    stem: str
    title: str
    root: type[Section]
    where: str


FILES = (
    SpecificationFile("sensor", "Sensor", SensorSpec, "Given to `--sensor`; shipped ones lie in `scenes/sensors`."),
    SpecificationFile("object", "Object", ObjectSpec, "Given to `--object`; shipped ones lie in `scenes/objects`."),
    SpecificationFile("experiment", "Experiment", ExperimentSpec, "Given to `--experiment`; shipped ones lie in `scenes/experiments`."),
    SpecificationFile(
        "randomisation", "Randomisation", RandomisationSpec, "Given to `--randomise`; shipped ones lie in `scenes/randomisations`."
    ),
    SpecificationFile("servo", "Servo", ServoSpec, "Given to `--servo`; the shipped one lies in `scenes/servos`."),
    SpecificationFile("limits", "Safety limits", SafetyLimits, "Given to `--safety`; shipped ones lie in `hardware/limits`."),
    SpecificationFile("detector", "Pin detection", DetectorSpec, "Written by `twin tune`, given to `--pipeline`."),
    SpecificationFile("sweep", "Robustness sweep", SweepPlan, "Given to `--conditions` of `twin robustness`."),
)

# Ends of names and the units they mean; longer ends first.
UNITS = {
    "_mm_per_n": "mm/N",
    "_deg_per_n": "deg/N",
    "_per_mm": "1/mm",
    "_mm_s": "mm/s",
    "_deg_s": "deg/s",
    "_px2": "px²",
    "_mm2": "mm²",
    "_mpa": "MPa",
    "_nmm": "N mm",
    "_deg": "deg",
    "_mm": "mm",
    "_px": "px",
    "_n": "N",
    "_s": "s",
}


@dataclass(frozen=True)
class Explained:
    """What a class says of one key."""

    kind: str
    text: str


def unit_of(key: str) -> str:
    """The unit that the end of a key's name says; "" for a plain number or a text."""
    return next((unit for end, unit in UNITS.items() if key.endswith(end)), "")


def explain_attributes(section: type[Section]) -> dict[str, Explained]:
    """What the ``Attributes`` of a class and its parents say, by key."""
    found: dict[str, Explained] = {}
    for base in reversed(section.__mro__):
        if not (isinstance(base, type) and issubclass(base, Section)) or not base.__doc__:
            continue
        part = re.search(r"^Attributes\n-+\n(.*?)(?=^\S[^\n]*\n-{3,}|\Z)", inspect.cleandoc(base.__doc__), re.DOTALL | re.MULTILINE)
        entries = re.finditer(r"^(\S[^\n]*?) : ([^\n]*)\n((?:    [^\n]*\n|\n)*)", f"{part[1]}\n" if part else "", re.MULTILINE)
        for names, kind, text in (entry.groups() for entry in entries):
            found |= {name.strip(): Explained(kind, " ".join(text.split())) for name in names.split(",")}
    return found


def list_unexplained(section: type[Section]) -> list[str]:
    """Keys of a class that it says nothing about."""
    known = explain_attributes(section)
    return [key for key in section.model_fields if key not in known or not known[key].text]


def summary_of(section: type[Section]) -> str:
    """The text of a class above its ``Attributes``."""
    return re.split(r"^(?:Attributes|Notes)\n-+$", inspect.cleandoc(section.__doc__ or ""), maxsplit=1, flags=re.MULTILINE)[0].strip()


def notes_of(section: type[Section]) -> str:
    """The text below ``Notes`` of a class."""
    part = re.search(r"^Notes\n-+\n(.*)", inspect.cleandoc(section.__doc__ or ""), re.DOTALL | re.MULTILINE)
    return part[1].strip() if part else ""


def parts_of(annotation: Any) -> Iterator[type[Section]]:
    """Sections within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for part in get_args(annotation):
        yield from parts_of(part)


def sections_of(root: type[Section], path: str = "") -> dict[str, type[Section]]:
    """Every section of a file by its place in it, the file itself first; the shapes of a union side by side, and so are a key's parts."""
    found = {path: root}
    if issubclass(root, OpenSection):
        found |= {f"{path} ({root.part_key} = {name})": part for name, part in root.parts().items() if part.model_fields}
    for key, field in root.model_fields.items():
        below = list(parts_of(field.annotation))
        for part in below:
            place = f"{path}.{key}".lstrip(".") + (f" ({_kind(part)})" if len(below) > 1 else "")
            found |= sections_of(part, place)
    return found


def _kind(section: type[Section]) -> str:
    """The word by which a shape is chosen."""
    field = section.model_fields.get("kind")
    return str(get_args(field.annotation)[0]) if field else section.__name__


def values_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> str:
    """The values that an annotation allows, in words."""
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return values_of(inner, (*more, *metadata))
    flat = [m for each in metadata for m in (each.metadata if isinstance(each, FieldInfo) else [each])]
    limits = "".join(_limit(each) for each in flat)
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        kinds = [values_of(part) for part in arguments if part is not type(None)]
        return (kinds[0] if len(set(kinds)) == 1 else " or ".join(kinds)) + limits
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return f"list of {values_of(arguments[0])}{limits}"
        kinds = list(dict.fromkeys(values_of(part) for part in arguments))
        return f"{len(arguments)} of: {', '.join(kinds)}{limits}"
    if origin is dict:
        return f"table of {values_of(arguments[1])}"
    names = {float: "number", int: "whole number", str: "text", bool: "`true` or `false`"}
    if annotation in names:
        return names[annotation] + limits
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return "table"
    return " or ".join(f"`{value.value}`" for value in annotation) if isinstance(annotation, type) else "value"


def _limit(bound: Any) -> str:
    kinds = {Ge: ("ge", "≥"), Gt: ("gt", ">"), Le: ("le", "≤"), Lt: ("lt", "<"), MultipleOf: ("multiple_of", "multiple of")}
    if type(bound) in kinds:
        name, sign = kinds[type(bound)]
        return f", {sign} {getattr(bound, name):g}"
    if isinstance(bound, MinLen) or (isinstance(bound, Len) and bound.min_length):
        return f", at least {bound.min_length}"
    return f", at most {bound.max_length}" if isinstance(bound, MaxLen) else ""


def default_of(field: FieldInfo) -> str:
    """The default of a key as it would stand in a file."""
    if field.is_required():
        return "**must be given**"
    value = field.get_default(call_default_factory=True)
    if isinstance(value, Section):
        return "its own defaults"
    if value is None:
        return "none"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value!r}`".replace("'", '"') if isinstance(value, str) else f"`{getattr(value, 'value', value)}`"


def text_of(made: SpecificationFile) -> str:
    """The page of one kind of file, Markdown."""
    lines = [f"# {made.title}", "", made.where, ""]
    for place, section in sections_of(made.root).items():
        lines += [f"## `[{place}]`" if place else "## The file", "", _markdown(summary_of(section)), ""]
        known = explain_attributes(section)
        lines += ["| key | unit | default | values | meaning |", "| --- | --- | --- | --- | --- |"]
        for key, field in section.model_fields.items():
            values = values_of(field.annotation, tuple(field.metadata)).replace("|", "\\|")
            text = _markdown(known[key].text).replace("|", "\\|") if key in known else ""
            lines.append(f"| `{key}` | {unit_of(key)} | {default_of(field)} | {values} | {text} |")
        lines += ["", _markdown(notes_of(section)), ""]
    return "\n".join(lines) + "\n"


def _markdown(text: str) -> str:
    """Text of a docstring as Markdown."""
    return text.replace("``", "`")
