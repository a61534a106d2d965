"""Writing a sensor's specification as a TOML file that a person can read and edit."""

from pathlib import Path

import tomlkit

from scenes.sensor import SensorSpec

DIGITS = 6  # significant ones of a number
ROW = 12  # numbers in a line of a long list


def write_sensor(path: Path, spec: SensorSpec, comment: str = "") -> None:
    """Write a specification; values that are the defaults are left out, the name is the file's.

    Parameters
    ----------
    path : Path
    spec : SensorSpec
    comment : str
        Lines that stand above everything.
    """
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line))
    plain = {key: value for key, value in spec.model_dump(exclude_defaults=True).items() if key != "name" and value is not None}
    for key in sorted(plain, key=lambda k: isinstance(plain[k], dict)):  # tables come last
        document.add(key, _item(plain[key]))
    partial = path.with_name(path.name + ".partial")
    partial.write_text(tomlkit.dumps(document))
    partial.replace(path)


def _item(value: object) -> object:
    if isinstance(value, dict):
        table = tomlkit.table()
        for key, part in value.items():
            table.add(key, _item(part))
        return table
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}")
    if isinstance(value, list | tuple):
        array = tomlkit.array()
        if value and isinstance(value[0], dict):
            for part in value:
                inline = tomlkit.inline_table()
                inline.update({k: _item(v) for k, v in part.items()})
                array.add_line(inline)
            array.add_line(indent="")
            return array
        numbers = _numbers(value[0]) if value else 1
        row = max(ROW // numbers, 1)
        if numbers * len(value) <= ROW:
            array.extend(_item(v) for v in value)
            return array
        for start in range(0, len(value), row):
            array.add_line(*(_item(v) for v in value[start : start + row]))
        array.add_line(indent="")
        return array
    return value


def _numbers(value: object) -> int:
    """How many numbers a value holds."""
    return sum(map(_numbers, value)) if isinstance(value, list | tuple) else 1
