"""What a command prints of a result, on stdout.

How a command that moves an arm may be ended.

Options that several commands share."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Protocol, TypeVar

import typer

from twin.cli import print_notes
from twin.errors import TwinError
from twin.types import Form


class Result(Protocol):
    """What a function that does a command's work returns."""

    @property
    def written(self) -> Sequence[Path]:
        """The files that it wrote."""

    def lines(self) -> Iterable[str]:
        """What it found, for people."""


def say(lines: Iterable[str]) -> None:
    """Print lines, each as soon as it is there."""
    for line in lines:
        print(line, flush=True)


def tell(result: Result) -> None:
    """Print what was found and where it was written."""
    say(result.lines())
    say(f"wrote {path}" for path in result.written)


@contextmanager
def arm_let_go() -> Iterator[None]:
    """SIGTERM and a closed terminal end the command as Ctrl-C does. What could not be let go of is printed."""
    from hardware.rig import signals_as_ctrl_c

    with signals_as_ctrl_c():
        try:
            yield
        except KeyboardInterrupt as interrupt:
            print_notes(interrupt)  # here, because typer ends without a word
            raise


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


CORES = usable_cores()

Sensor = Annotated[str, typer.Option("--sensor", metavar="S", help="sensor name ('twin sensors') or specification file")]
Object = Annotated[str, typer.Option("--object", metavar="O", help="object name ('twin objects'), specification or mesh file")]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="folder to write to; made if missing")]
FormOrAuto = Annotated[Form | None, typer.Option("--form", help="form of the frames; told by size and content if not given")]
Device = Annotated[str, typer.Option("--device", help="auto (a GPU where PyTorch finds one), cpu or cuda")]
Target = Annotated[str, typer.Option("--target", help="preset, or label columns with commas between")]
Workers = Annotated[int, typer.Option("--workers", min=1, metavar="N", show_default="one for each core", help="processes on this machine")]
Pair = tuple[float, float]
Model = Annotated[Path, typer.Option("--model", metavar="RUN", help="folder of a run, or a sensor whose weights go with the package")]
SHIPPED_MODEL = Path("mg400-331")  # its weights go with the package
Camera = Annotated[str, typer.Option("--camera", metavar="C", help="twin, a number, /dev/videoN, http://..., a folder or a video")]
ArmOption = Annotated[str, typer.Option("--arm", metavar="A", help="simulated, simulated:4, mg400:ADDRESS, magician:PORT")]
PlainLight = Annotated[bool, typer.Option("--plain-light", help="twin: lamps' direct light alone, no path tracing at the start")]
ServoName = Annotated[str, typer.Option("--servo", help="gains, speeds and the object's place: a name, or a TOML file")]
Limits = Annotated[str | None, typer.Option("--limits", help="safety limits: mg400, magician, or a TOML file")]
AtRest = Annotated[
    str,
    typer.Option(
        "--at-rest",
        metavar="FRAME|first|none",
        help="no-contact frame that pins are counted from: a file, the first that is taken (an error if the sensor seems pressed in it), "
        "or none (the specification's layout)",
    ),
]
FIRST, NONE = "first", "none"  # as hardware.rig has them
Given = TypeVar("Given", str, Path)
Spec = TypeVar("Spec")


class Quality(StrEnum):
    """Presets of the renderer."""

    PREVIEW = "preview"
    STANDARD = "standard"
    HIGH = "high"


def _even(value: int) -> int:
    if value % 2:
        raise TwinError(f"--across {value}: give an even number")
    return value


Across = Annotated[int, typer.Option("--across", min=6, max=64, callback=_even, help="elements along each side of the skin's grid; even")]


def names_in(text: str) -> list[str]:
    """What stands between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def numbers_in(text: str, option: str) -> tuple[int, ...]:
    """The whole numbers between commas."""
    try:
        return tuple(int(part) for part in names_in(text))
    except ValueError as error:
        raise TwinError(f"{option} takes whole numbers with commas between, got {text!r}") from error


def if_given(load: Callable[[Given], Spec], name: Given | None) -> Spec | None:
    """The specification of that name or file; None where no name is given."""
    return load(name) if name else None


def writable_folder(path: Path) -> Path:
    """Make the folder, or say in one line why it can't be written to."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".write-probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise TwinError(f"{path}: can't write there ({error.strerror}); give another folder with --out") from error
    return path
