"""Options that several commands share, commands that are functions of Python, too, and the printing of results.

A command is declared once: as a function that returns a result, and whose parameters carry help, range and default (``Annotated``).
``App.command`` registers it on the command line. It returns the function that ``import twin`` offers, which takes the same options as
keyword arguments, checks them in the same way, and prints nothing.
"""

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from copy import copy
from dataclasses import dataclass
from enum import Enum, StrEnum
from functools import wraps
from inspect import Parameter
from numbers import Integral, Real
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin

import typer
from typer import BadParameter, Option
from typer.models import ArgumentInfo, ParameterInfo

from twin.errors import ErrorsAs, OptionError, extras_named, warn_once
from twin.progress import Progress, silent
from twin.types import FORMER_VALUES, Form, present_value

if TYPE_CHECKING:
    from scenes.sensor import SensorSpec

Given = TypeVar("Given", str, Path)
Spec = TypeVar("Spec")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Formerly:
    """Mark of an option in ``Annotated``: the name that it had before, which still works, with one line of warning."""

    name: str


# Number of cores that this process may use.
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
# The largest seed of weights and splits. It is the constant of training.runs.config, which is not imported because it would load PyTorch.
MOST_SEED = 2**32 - 1
# Largest number of CPU threads. More threads have never made a training faster, and many more can't be started.
MOST_THREADS = 256

QUALITY = "rasterised without noise, or path-traced with more and more samples"

Sensor = Annotated[str, Option("--sensor", metavar="S", help="sensor name ('twin sensors') or specification file")]
Object = Annotated[str, Option("--object", metavar="O", help="object name ('twin objects'), specification or mesh file")]
TOUCHED = "object name, specification or mesh file; the experiment's own if not given"
TouchedObject = Annotated[str | None, Option("--object", metavar="O", help=TOUCHED)]
Out = Annotated[Path, Option("--out", metavar="DIR", help="folder to write to; made if missing")]
Force = Annotated[bool, Option("--force", help="overwrite files that this program did not write")]
FormOrAuto = Annotated[Form | None, Option("--form", help="form of the frames; found from size and content if not given")]
Experiment = Annotated[str, Option("--experiment", metavar="E", help="how contacts are made: a name ('twin experiments') or a file")]
MaxFrames = Annotated[int, Option("--max-frames", min=1, metavar="N", help="at most N frames, evenly spread"), Formerly("limit")]
Residual = Annotated[bool, Option("--residual", help="add the sensor's residual network")]
Device = Annotated[str, Option("--device", help="auto (a GPU where PyTorch finds one), cpu or cuda")]


def each_once(text: str | None) -> str | None:
    """The comma-separated names, if there are some and none occurs twice; None if there is no text."""
    if text is None:
        return None
    names = names_in(text)
    if not names or len(set(names)) < len(names):
        raise BadParameter(f"give one name or several with commas between, each once, got {text!r}")
    return ",".join(names)


def finite(value: float | None) -> float | None:
    """The number, if it is not NaN or infinite. This is checked here, because a least value of an option lets NaN pass."""
    if value is not None and not math.isfinite(value):
        raise BadParameter(f"give a number, got {value}")
    return value


Target = Annotated[str, Option("--target", callback=each_once, help="preset, or label columns separated by commas")]
Threads = Annotated[int | None, Option("--threads", min=1, max=MOST_THREADS, help="CPU threads")]
Workers = Annotated[int, Option("--workers", min=1, metavar="N", show_default="one for each core", help="processes on this machine")]
Pair = tuple[float, float]
Table = Annotated[Path | None, Option("--table", metavar="CSV", help="table of labels, if it is not targets.csv beside the frames")]
NO_CONTACT = "frame without contact, if it is not init_0.png beside the frames"
NoContact = Annotated[Path | None, Option("--no-contact", metavar="FRAME", help=NO_CONTACT)]
Tuning = Annotated[Path | None, Option("--pipeline", metavar="FILE.toml", help="pin detection of 'twin tune', instead of the sensor's own")]
# Further formats in which a record can be kept, as in ``twin.records.ALSO``, whose import would load the pin detection.
AlsoFormat = StrEnum("AlsoFormat", {"LEROBOT": "lerobot", "HUGGINGFACE": "huggingface", "MCAP": "mcap"})
ALSO = "also write this format, in a subfolder of that name; may be repeated ('twin convert --help')"
Also = Annotated[list[AlsoFormat] | None, Option("--also", help=ALSO)]
PlainLight = Annotated[bool, Option("--plain-light", help="render the twin's frames with direct light alone, without path tracing")]
ServoName = Annotated[str, Option("--servo", help="gains, speeds and the object's place: a name, or a TOML file")]


def _even(value: int) -> int:
    """The number, if it is even."""
    if value is not None and value % 2:
        raise OptionError(f"`elements` {value}: give an even number")
    return value


GRID = "elements along each side of the skin's grid; even"
Elements = Annotated[int, Option("--elements", min=6, max=64, callback=_even, help=GRID), Formerly("across")]


def names_in(text: str) -> list[str]:
    """The comma-separated names."""
    return [name.strip() for name in text.split(",") if name.strip()]


# Names that functions have for an option, if they have no argument of the option's own name.
INSIDE = {
    "data": "recordings",
    "elements": "across",
    "label_kind": "labels",
    "label_table": "labels",
    "max_frames": "limit",
    "model": "models",
    "num_labelled": "labels",
    "pipeline": "pipelines",
    "push": "pushes",
    "randomise": "randomisation",
    "safety": "limits",
    "sim": "simulated",
    "workers": "processes",
}


SPECIFICATION = re.compile(r"(<class '|tuple\[)?[\w.]*(Sensor|Object|Experiment|Randomisation|Servo)Spec\b")
"""Annotation of an argument that is a specification, or a tuple of them."""


def call(function: Callable[..., Made], given: Mapping[str, Any], **others: Any) -> Made:
    """Call a function, or make a plan, with those of a command's options (its ``locals()``) that are arguments of it.

    An option that was not given leaves the function's default. For an argument that is a specification, or a tuple of them, the option has
    names; a sensor gets the pin detection and the residual network that further options ask for. ``others`` are arguments that differ from
    the option.
    """
    import scenes

    takes, arguments = inspect.signature(function).parameters, {}
    tuning = given["pipeline"] if isinstance(given.get("pipeline"), Path) else None
    for name, value in given.items():
        name = name if name in takes else INSIDE.get(name, name)
        if name not in takes or name in others or value is None:
            continue
        arguments[name] = tuple(value) if isinstance(value, list) else value
        if kind := SPECIFICATION.match(str(takes[name].annotation)):
            load = getattr(scenes, f"load_{kind[2].lower()}")
            arguments[name] = tuple(map(load, names_in(value))) if kind[1] == "tuple[" else load(value)
            if kind[2] == "Sensor":
                arguments[name] = sensor_with(value, tuning, residual=given.get("residual", False))
    return function(**arguments | others)


def load_if_named(load: Callable[[Given], Spec], name: Given | None) -> Spec | None:
    """The specification of a name or file; None if none is given."""
    return load(name) if name else None


def sensor_with(name: str, tuning: Path | None = None, *, residual: bool = False) -> "SensorSpec":
    """The sensor, with the pin detection of a 'twin tune' file if one is given, and with its residual network if wanted."""
    from scenes import load_sensor
    from twin.camera.residual import with_residual
    from twin.pins import load_detector, with_detector

    spec = load_sensor(name)
    spec = with_detector(spec, load_detector(tuning)) if tuning is not None else spec
    return with_residual(spec) if residual else spec


NAMED_OTHERWISE = {"obj": "object"}
"""Options whose argument in Python has another name."""


def as_options(text: str) -> str:
    """A message with the options of the command line in place of the arguments of Python, which stand in it as `name` or `name=value`."""

    def option(found: re.Match[str]) -> str:
        name, value = found[1], found[2]
        negation = "no-" if value == "False" else ""
        named = f"--{negation}{NAMED_OTHERWISE.get(name, name).replace('_', '-')}"
        return named if value in (None, "True", "False") else f"{named} {value}"

    return re.sub(r"`([a-z][a-z0-9_]*)(?:=([^`]*))?`", option, text)


def print_lines(lines: Iterable[str]) -> None:
    """Print each line as soon as it is known."""
    for line in lines:
        print(as_options(line), flush=True)


def print_result(result: Any) -> None:
    """Print the ``lines()`` of a result, and the files that it names as ``written``, if it does."""
    print_lines(result.lines())
    print_lines(f"wrote {path}" for path in getattr(result, "written", ()))


class App(typer.Typer):
    """A group of commands."""

    def command(  # type: ignore[override]
        self, name: str, *, help: str | None = None, goes_on: bool = False, exit_code: Callable[[Any], int] = lambda made: 0
    ) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
        """Decorator of the function behind a command. It prints the result, and gives a command that writes files the option ``--force``.

        Parameters
        ----------
        name : str
            Name of the command.
        help : str, optional
            Help of the command; the docstring by default.
        goes_on : bool
            The same command continues interrupted work.
        exit_code : callable
            Exit code of the command for its result.
        """

        def register(work: Callable[..., Made]) -> Callable[..., Made]:
            options = inspect.signature(work).parameters
            forced = [Parameter("force", Parameter.KEYWORD_ONLY, default=False, annotation=Force)] if writes(options) else []
            former = former_names(options)
            known = [*(_with_former_values(each) for each in options.values() if each.name != "progress"), *forced]
            known += [_hidden(old, options[name]) for old, name in former.items()]

            @wraps(work)
            def command(*, force: bool = False, **given: Any) -> None:
                from twin.store import overwriting

                with overwriting(force):
                    made = _do_work(work, with_present_names(given, former), progress=True, goes_on=goes_on)
                    if made is not None:
                        print_result(made)
                if code := exit_code(made):
                    raise SystemExit(code)

            command.__signature__ = inspect.Signature(known)  # type: ignore[attr-defined]
            command.__annotations__ = {each.name: each.annotation for each in known}
            super(App, self).command(name, help=help)(command)
            return as_function(work, help or inspect.getdoc(work) or "")

        return register


def _do_work(work: Callable[..., Made], given: dict[str, Any], *, progress: Progress | bool | None, goes_on: bool = False) -> Made:
    """Do the work, which reports to ``progress`` if it reports at all: True shows bars."""
    with extras_named(), ExitStack() as stack:
        if "progress" in inspect.signature(work).parameters:
            if progress is True:
                from twin.cli.progress import show_progress

                progress = stack.enter_context(show_progress(goes_on=goes_on))
            given = {**given, "progress": progress or silent}
        return work(**given)


def writes(options: Any) -> bool:
    """Whether a command with these options writes files that may be there already."""
    return "out" in options or "maps" in options


def as_function(work: Callable[..., Made], help: str) -> Callable[..., Made]:
    """The function of Python for the work of a command.

    The command's arguments come first, the options are keyword arguments. ``force`` and ``progress`` (a ``Progress``, or True for bars) are
    added where the command has them.
    """
    options = inspect.signature(work).parameters
    marks = {name: mark for name, each in options.items() if (mark := _mark(each)) is not None}
    kinds = {True: Parameter.POSITIONAL_OR_KEYWORD, False: Parameter.KEYWORD_ONLY}
    public = [
        options[name].replace(kind=kinds[isinstance(mark, ArgumentInfo)], annotation=_plain(options[name]))
        for name, mark in marks.items()
        if not mark.is_eager
    ]
    public.sort(key=lambda each: each.kind)
    added = {"force": (writes(options), False, bool), "progress": ("progress" in options, None, Progress | bool | None)}
    public += [Parameter(name, Parameter.KEYWORD_ONLY, default=d, annotation=kind) for name, (has, d, kind) in added.items() if has]
    signature = inspect.Signature(public, return_annotation=inspect.signature(work).return_annotation)
    former = former_names(options)

    @wraps(work)
    def function(*arguments: Any, **given: Any) -> Made:
        from twin.store import overwriting

        bound = signature.bind(*arguments, **with_present_names(given, former)).arguments
        force, progress = bound.pop("force", False), bound.pop("progress", None)
        with ErrorsAs(typer.BadParameter, lambda error: OptionError(f"{error.param_hint or ''} {error.message}".strip())):
            taken = {name: parse_argument(name, _plain(options[name]), marks[name], value) for name, value in bound.items()}
            with overwriting(force):
                return _do_work(work, taken, progress=progress)

    function.__signature__ = signature  # type: ignore[attr-defined]
    function.__doc__ = docstring(help, public, marks)
    return function


def former_names(options: Mapping[str, Parameter]) -> dict[str, str]:
    """The present names of options by those that they had before (``Formerly``)."""
    marks = {name: getattr(each.annotation, "__metadata__", ()) for name, each in options.items()}
    return {mark.name: name for name, those in marks.items() for mark in those if isinstance(mark, Formerly)}


def with_present_names(given: dict[str, Any], former: Mapping[str, str]) -> dict[str, Any]:
    """Options under their present names, with a warning for each that is given under its former one."""
    for old in [name for name in given if name in former]:
        value = given.pop(old)
        if value is not None:
            warn_once(f"`{old}` is now called `{former[old]}`; the old name still works")
            given[former[old]] = value
    return given


def _hidden(old: str, option: Parameter) -> Parameter:
    """The option under its former name, which no help shows."""
    mark = copy(_mark(option))
    assert mark is not None, "only options have former names"
    prefixes = ("", "no-") if _plain(option) is bool else ("",)
    mark.param_decls = ("/".join(f"--{prefix}{old.replace('_', '-')}" for prefix in prefixes),)
    mark.default, mark.hidden = ..., True  # in ``Annotated`` the default holds the option's first name
    return Parameter(old, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[_plain(option) | None, mark])


def _with_former_values(option: Parameter) -> Parameter:
    """The option; a choice also takes the names that its values had in version 1."""
    kinds = (_plain(option), *get_args(_plain(option)))
    values = [v for kind in kinds for v in (get_args(kind) if get_origin(kind) is Literal else getattr(kind, "__members__", {}).values())]
    if not set(values) & set(FORMER_VALUES.values()):
        return option

    def parse(value: str) -> Any:
        if (value := present_value(value)) not in values:
            raise typer.BadParameter(f"{value!r} is not one of {', '.join(repr(str(each)) for each in values)}.")
        return values[values.index(value)]

    (mark,) = (copy(each) for each in option.annotation.__metadata__)
    mark.parser, mark.metavar, mark.autocompletion = parse, f"<{'|'.join(values)}>", lambda: values
    return option.replace(annotation=Annotated[_plain(option), mark])


def _mark(option: Parameter) -> ParameterInfo | None:
    """The mark of an option of the command line; None for other parameters."""
    return next((mark for mark in getattr(option.annotation, "__metadata__", ()) if isinstance(mark, ParameterInfo)), None)


def _plain(option: Parameter) -> Any:
    """The type of an option without its help."""
    return get_args(option.annotation)[0]


def docstring(help: str, parameters: list[Parameter], marks: dict[str, ParameterInfo]) -> str:
    """The help of a command as a docstring of Python: without its example, and with each parameter."""
    text = re.split(r"^(?:\x08\n)?Examples?[^\n]*:[ \t]*\n", help, flags=re.MULTILINE)[0].replace("\b\n", "")
    rows = [
        f"{each.name} : {inspect.formatannotation(each.annotation)}\n    {marks[each.name].help if each.name in marks else ''}".rstrip()
        for each in parameters
    ]
    return "\n".join([text.rstrip(), "", "Parameters", "----------", *rows, ""])


def parse_argument(name: str, kind: Any, mark: ParameterInfo, value: Any) -> Any:
    """The value of an argument as the command line would hand it on.

    Raises
    ------
    OptionError
        It has another type, or is out of the option's range.
    """
    value = convert_option(name, kind, value)
    if value is not None:
        if mark.min is not None and value < mark.min or mark.max is not None and value > mark.max:
            raise OptionError(f"`{name}={value}`: expected {' and '.join(_range(mark))}")
        if mark.callback is not None:
            with ErrorsAs(typer.BadParameter, lambda error: OptionError(f"`{name}={value}`: {error.message}")):
                return mark.callback(value)
    return value


def _range(mark: ParameterInfo) -> list[str]:
    return [f"{words} {limit}" for words, limit in (("at least", mark.min), ("at most", mark.max)) if limit is not None]


def convert_option(name: str, kind: Any, value: Any) -> Any:
    """The value as an instance of the type of an option.

    A path may be a text, a list may be one value or any sequence, names with commas between may be a list, and a specification may stand
    where the command line takes its name.

    Raises
    ------
    OptionError
        The value has another type.
    """
    parts = [part for part in get_args(kind) if part is not NoneType]
    if NoneType in get_args(kind):
        return None if value is None else convert_option(name, parts[0], value)
    if get_origin(kind) is list:
        many = isinstance(value, list | tuple | set | range)
        return [convert_option(name, parts[0], each) for each in (value if many else [value])]
    if get_origin(kind) is tuple:
        if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != len(parts):
            raise OptionError(f"`{name}`: expected {len(parts)} numbers, got {value!r}")
        return tuple(convert_option(name, part, each) for part, each in zip(parts, value, strict=True))
    if get_origin(kind) is Literal or isinstance(kind, type) and issubclass(kind, Enum):
        allowed = parts or list(kind)
        if value not in allowed and (value := present_value(value)) not in allowed:
            raise OptionError(f"`{name}`: expected {' or '.join(map(str, allowed))}, got {value!r}")
        return value if parts else kind(value)
    if kind is Path and isinstance(value, str | os.PathLike):
        return Path(value)
    if kind is str and isinstance(value, list | tuple):
        return ",".join(map(str, value))
    if kind is str and isinstance(value, str | os.PathLike):
        return os.fspath(value)
    if kind is str and hasattr(value, "model_dump"):  # a specification in place of its name
        return value
    if kind is bool and value in (True, False):
        return bool(value)
    if kind is int and isinstance(value, Integral) and not isinstance(value, bool):
        return int(value)
    if kind is float and isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise OptionError(f"`{name}`: expected {NAMES[kind]}, got {value!r}")


NAMES = {Path: "a path", str: "a name", bool: "True or False", int: "a whole number", float: "a number"}
