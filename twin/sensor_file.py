"""A sensor's specification as a file."""

from pathlib import Path

from scenes.sensor import SensorSpec
from scenes.write import sensor_text
from twin.store import write_text


def write_sensor(path: Path, spec: SensorSpec, comment: str = "") -> Path:
    """Write a specification as ``scenes.write.sensor_text`` has it; the path.

    Raises
    ------
    StoreError
        It can't be written.
    """
    return write_text(path, sensor_text(spec, comment))
