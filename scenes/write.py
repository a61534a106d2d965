"""Text of a sensor's specification: a readable and editable TOML file, and tables of its long arrays."""

from collections.abc import Mapping

import tomlkit

from scenes.sensor import SensorSpec
from scenes.tables import significant, take_out_tables

ROW = 12
"""Largest number of numbers in one line of a list."""


def sensor_files(spec: SensorSpec, stem: str, comment: str = "", notes: Mapping[str, str] | None = None) -> dict[str, str]:
    """The files of a specification. Default values are omitted, and so is the sensor's name, which is the file's stem.

    Parameters
    ----------
    spec : SensorSpec
    stem : str
        Name of the TOML file without its suffix. Tables are named after it.
    comment : str
        Comment lines at the beginning of the file.
    notes : mapping of str to str
        Comments behind values, by dotted key (``pins.max_polar_deg``). Keys that are not written are ignored.

    Returns
    -------
    dict of str to str
        Text of each file by its name. The TOML file comes last, because it names the tables (see ``scenes.tables``).
    """
    given = {key: value for key, value in spec.model_dump(exclude_defaults=True).items() if key != "name" and value is not None}
    layout = {"layout": spec.pins.layout} | spec.pins.shape.model_dump(exclude_defaults=True)
    given["pins"] = layout | given.get("pins", {})  # the layout is written even if it is the default
    plain, tables = take_out_tables(given, stem)
    document = toml_document(plain, comment)
    for dotted, note in (notes or {}).items():
        *sections, name = dotted.split(".")
        table: object = document
        for section in sections:
            table = table.get(section, {}) if isinstance(table, dict) else {}
        if isinstance(table, dict) and name in table and hasattr(table[name], "comment"):
            table[name].comment(note)
    return {**tables, f"{stem}.toml": tomlkit.dumps(document)}


def toml_document(content: Mapping[str, object], comment: str = "") -> tomlkit.TOMLDocument:
    """A readable TOML document with comment lines at its beginning. Floats are rounded to the digits that tables have."""
    document = tomlkit.document()
    for line in comment.splitlines():
        document.add(tomlkit.comment(line))
    for key in sorted(content, key=lambda k: isinstance(content[k], dict)):  # tables come last
        document.add(key, _item(content[key]))
    return document


def _item(value: object) -> object:
    """A value in the form that tomlkit writes: sections as tables, references and lists of sections inline, lists in lines."""
    if isinstance(value, dict) and set(value) in ({"csv", "shape"}, {"picture"}):
        reference = tomlkit.inline_table()
        reference.update(value)
        return reference
    if isinstance(value, dict):
        table = tomlkit.table()
        for key, part in value.items():
            table.add(key, _item(part))
        return table
    if isinstance(value, float):
        return tomlkit.item(significant(value))
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
    return tomlkit.item(value)


def _numbers(value: object) -> int:
    """Number of numbers in a value."""
    return sum(map(_numbers, value)) if isinstance(value, list | tuple) else 1
