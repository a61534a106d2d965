"""A sensor's specification as files."""

from pathlib import Path

from scenes.sensor import SensorSpec
from scenes.write import sensor_files
from twin.store import write_text


def write_sensor(path: Path, spec: SensorSpec, comment: str = "") -> Path:
    """Write a specification, its tables beside it, and return the path.

    Each file is written whole or not at all; the TOML file comes last.

    Raises
    ------
    StoreError
        It can't be written.
    """
    for name, text in sensor_files(spec, path.stem, comment).items():
        write_text(path.with_name(name), text)
    return path
