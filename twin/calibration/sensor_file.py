"""Writes a sensor's specification to files."""

from collections.abc import Mapping
from pathlib import Path

from scenes.sensor import SensorSpec
from scenes.write import sensor_files
from twin.errors import OptionError
from twin.store import write_result


def write_sensor(path: Path, spec: SensorSpec, comment: str = "", notes: Mapping[str, str] | None = None) -> Path:
    """Write a specification and its tables, and return the path; ``comment`` and ``notes`` as for ``sensor_files``.

    Each file is written whole or not at all; the TOML file comes last.

    Raises
    ------
    StoreError
        The files can't be written; the error's ``unsaved`` has their texts.
    """
    write_result(path.parent, sensor_files(spec, path.stem, comment, notes))
    return path


def sibling_folder(out: Path, kind: str) -> Path:
    """The folder for further files of a specification that is still to be written.

    Raises
    ------
    OptionError
        ``out`` is not the name of a ``.toml`` file.
    """
    if out.suffix != ".toml":
        raise OptionError(f"`out` {out}: give the name of a .toml file")
    return out.with_name(f"{out.stem}-{kind}")
