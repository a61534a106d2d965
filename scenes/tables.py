"""Measured arrays and pictures of a specification, stored as files beside its TOML file.

The TOML file has a reference in the place of the array::

    light = { csv = "ur5-331.housing.rim.light.csv", shape = [120, 32, 3] }

The CSV file has one line for each index of the first dimension. Within a line the numbers are in C order (the last dimension varies
fastest). Lines that begin with ``#`` are comments. Whole numbers stay whole numbers. A loaded specification holds the numbers, not the
reference, so they are part of its dump and of its digest.

A picture is stored in the same way::

    light = { picture = "ur5-331.housing.background.light.uri" }

The file is a picture (PNG, JPEG or WebP), or a text file with its data URI, which a browser shows. The loaded specification holds the
data URI.
"""

import base64
from collections.abc import Mapping
from math import isfinite, prod
from pathlib import Path

from scenes.base import PICTURE
from scenes.files import INT64, LARGEST_BYTES, quote, read_regular

MOST_INLINE = 120
"""Largest number of numbers in a list that is written to the TOML file itself: about ten lines. A longer list is written to a CSV file."""

DIGITS = 6
"""Number of significant digits of a written number. No length or light of a sensor is known more precisely."""

URI = ".uri"
"""Suffix of a text file with a data URI."""

KINDS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp"}
"""Kind of picture (the subtype of its media type) by the suffix of its file."""

_REFERENCE = {"csv", "shape"}
_PICTURE = {"picture"}


def fill_in_tables(section: Mapping[str, object], folder: Path, key: str = "") -> dict[str, object]:
    """A section from a TOML file, with every reference replaced by the numbers of its table.

    Parameters
    ----------
    section : mapping
        Keys and values. References in nested sections are replaced, too.
    folder : Path
        Folder of the TOML file and its tables.
    key : str
        Dotted name of the section, for errors.

    Raises
    ------
    ValueError
        If a table is missing, is in another folder, contains anything other than numbers, or has another shape than its reference states.
    """
    filled: dict[str, object] = {}
    for name, value in section.items():
        here = f"{key}.{name}" if key else name
        if isinstance(value, dict):
            read = {frozenset(_REFERENCE): _read_table, frozenset(_PICTURE): _read_picture}.get(frozenset(value), fill_in_tables)
            filled[name] = read(value, folder, here)
        else:
            filled[name] = value
    return filled


def take_out_tables(section: Mapping[str, object], stem: str, key: str = "") -> tuple[dict[str, object], dict[str, str]]:
    """Replace every long list of numbers and every picture by a reference. Returns the section, and the texts of the files by name.

    Parameters
    ----------
    section : mapping
        Keys and values, as ``model_dump`` gives them.
    stem : str
        Name of the TOML file without its suffix; every table's name begins with it.
    key : str
        Dotted name of the section.
    """
    import numpy as np  # not above, because whoever imports the specifications may need none

    kept: dict[str, object] = {}
    texts: dict[str, str] = {}
    for name, value in section.items():
        here = f"{key}.{name}" if key else name
        table = np.array(value, object)
        if isinstance(value, dict):
            kept[name], more = take_out_tables(value, stem, here)
            texts |= more
        elif isinstance(value, str) and value.startswith(PICTURE):
            kept[name] = {"picture": f"{stem}.{here}{URI}"}
            texts[f"{stem}.{here}{URI}"] = f"{value}\n"
        elif table.size > MOST_INLINE and all(isinstance(n, int | float) and not isinstance(n, bool) for n in table.flat):
            file = f"{stem}.{here}.csv"
            kept[name] = {"csv": file, "shape": list(table.shape)}
            lines = (",".join(f"{significant(number)}" for number in row) for row in table.reshape(len(table), -1))
            texts[file] = f"# {here}: {' x '.join(map(str, table.shape))} numbers\n" + "\n".join(lines) + "\n"
        else:
            kept[name] = value
    return kept, texts


def significant(number: int | float) -> int | float:
    """A float rounded to ``DIGITS`` significant digits; a whole number as it is."""
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number


def _read_table(reference: Mapping[str, object], folder: Path, key: str) -> list[object]:
    import numpy as np

    file, shape = reference["csv"], reference["shape"]
    if not isinstance(file, str) or not isinstance(shape, list) or not shape or not all(isinstance(n, int) and n > 0 for n in shape):
        raise ValueError(f"{key}: expected {{ csv = 'file name', shape = [numbers above 0] }}, got {dict(reference)}")
    try:
        lines = _content(file, folder, key, "csv", (".csv",)).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{key}: the table {folder / file} is no UTF-8 text (byte {error.start}); save it as UTF-8") from error
    rows = [(number, line.split(",")) for number, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if len(rows) != shape[0]:
        raise ValueError(f"{key}: {file} has {len(rows)} lines of numbers, but shape = {shape} needs {shape[0]}")
    each = prod(shape[1:])
    table: list[int | float] = []
    for number, words in rows:
        if len(words) != each:
            raise ValueError(f"{key}: {file}, line {number} has {len(words)} numbers, but shape = {shape} needs {each}")
        try:
            table += [_number(word) for word in words]
        except ValueError as error:
            raise ValueError(f"{key}: {file}, line {number}: {quote(error)}; give numbers with commas between them") from None
    return list(np.array(table, object).reshape(shape).tolist())


def _read_picture(reference: Mapping[str, object], folder: Path, key: str) -> str:
    file = reference["picture"]
    if not isinstance(file, str):
        raise ValueError(f"{key}: expected {{ picture = 'file name' }}, got {dict(reference)}")
    content = _content(file, folder, key, "picture", (URI, *KINDS))
    suffix = Path(file).suffix
    if suffix == URI:
        return content.decode("ascii", "replace").strip()
    return f"{PICTURE}{KINDS[suffix]};base64,{base64.b64encode(content).decode('ascii')}"


def _content(file: str, folder: Path, key: str, word: str, suffixes: tuple[str, ...]) -> bytes:
    """Content of a file that a reference names."""
    if Path(file).name != file or not file.endswith(suffixes):
        kind = f"a {suffixes[0]} file" if len(suffixes) == 1 else f"a {', '.join(suffixes[:-1])} or {suffixes[-1]} file"
        raise ValueError(f"{key}: {word} = '{file}' must be the name of {kind} in the folder of the specification, without a folder")
    what = "table" if word == "csv" else word
    try:
        return read_regular(folder / file, LARGEST_BYTES)
    except FileNotFoundError:
        raise ValueError(f"{key}: the {what} {folder / file} is missing; copy it together with the specification") from None
    except OSError as error:
        raise ValueError(f"{key}: the {what} {folder / file} can't be read ({error.strerror}); copy it again") from error


def _number(word: str) -> int | float:
    try:
        number = int(word)
    except ValueError:
        value = float(word)
        if not isfinite(value):
            raise ValueError(f"'{word}' is no finite number") from None
        return value
    if number not in INT64:
        raise ValueError("a whole number has more than 64 bits")
    return number
