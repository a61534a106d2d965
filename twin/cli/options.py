"""Options that several commands share."""

import os
from pathlib import Path
from typing import Annotated

import typer

from twin.errors import TwinError
from twin.types import Form


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


def _even(value: int) -> int:
    if value % 2:
        raise TwinError(f"--across {value}: give an even number")
    return value


Across = Annotated[int, typer.Option("--across", min=6, max=64, callback=_even, help="elements along each side of the skin's grid; even")]


def names_in(text: str) -> list[str]:
    """What stands between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


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


def columns_of(target: str) -> str | tuple:
    """What ``load_dataset`` takes: the name of a preset, or the columns themselves."""
    from training.targets import PRESETS

    return target if target in PRESETS else tuple(name.strip() for name in target.split(","))
