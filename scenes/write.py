"""Writing a sensor's specification as a TOML file that a person can read and edit, its long arrays as tables beside it."""

from pathlib import Path

import tomlkit

from scenes.sensor import SensorSpec
from scenes.tables import significant, take_out_tables

ROW = 12
"""Most numbers in a line of a list."""


def write_sensor(path: Path, spec: SensorSpec, comment: str = "") -> None:
    """Write a specification; values that are the defaults are left out, the name is the file's.

    Arrays of many numbers go to CSV files of the same folder (see ``scenes.tables``), which are overwritten together with the TOML file.

    Parameters
    ----------
    path : Path
        Of the TOML file.
    spec : SensorSpec
    comment : str
        Lines that stand above everything.
    """
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line))
    given = {key: value for key, value in spec.model_dump(exclude_defaults=True).items() if key != "name" and value is not None}
    plain, tables = take_out_tables(given, path.stem)
    for key in sorted(plain, key=lambda k: isinstance(plain[k], dict)):  # tables come last
        document.add(key, _item(plain[key]))
    for name, text in {**tables, path.name: tomlkit.dumps(document)}.items():  # the TOML file last: it names the tables
        partial = path.with_name(name + ".partial")
        partial.write_text(text)
        partial.replace(path.with_name(name))


def _item(value: object) -> object:
    """A value as tomlkit writes it: sections as tables, references to tables and lists of sections inline, lists in even lines."""
    if isinstance(value, dict) and set(value) == {"csv", "shape"}:
        reference = tomlkit.inline_table()
        reference.update(value)
        return reference
    if isinstance(value, dict):
        table = tomlkit.table()
        for key, part in value.items():
            table.add(key, _item(part))
        return table
    if isinstance(value, float):
        return significant(value)
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
