"""Options that several commands share, and the printing of results."""

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from typer import BadParameter, Option

from twin.errors import OptionError
from twin.types import Form

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
TouchedObject = Annotated[
    str | None, Option("--object", metavar="O", help="object name, specification or mesh file; the experiment's own if not given")
]
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
NoContact = Annotated[
    Path | None, Option("--no-contact", metavar="FRAME", help="frame without contact, if it is not init_0.png beside the frames")
]
Tuning = Annotated[Path | None, Option("--pipeline", metavar="FILE.toml", help="pin detection of 'twin tune', instead of the sensor's own")]
# Further formats in which a record can be kept, as in ``twin.records.ALSO``, whose import would load the pin detection.
AlsoFormat = StrEnum("AlsoFormat", {"LEROBOT": "lerobot", "HUGGINGFACE": "huggingface", "MCAP": "mcap"})
Also = Annotated[
    list[AlsoFormat] | None,
    Option("--also", help="also write this format, in a subfolder of that name; may be repeated ('twin convert --help')"),
]
PlainLight = Annotated[bool, Option("--plain-light", help="render the twin's frames with direct light alone, without path tracing")]
ServoName = Annotated[str, Option("--servo", help="gains, speeds and the object's place: a name, or a TOML file")]


def _even(value: int) -> int:
    """The number, if it is even."""
    if value is not None and value % 2:
        raise OptionError(f"`elements` {value}: give an even number")
    return value


Elements = Annotated[
    int, Option("--elements", min=6, max=64, callback=_even, help="elements along each side of the skin's grid; even"), Formerly("across")
]


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
