"""Reads tables of labels and JSON metadata that lie beside the frames."""

import csv
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from scenes.files import read_regular
from twin.errors import FrameError, format_count
from twin.frames.folders import IMAGE_SUFFIXES

# Names of a recording's table, in the order in which they are tried.
TABLES = ("targets.csv", "targets_images.csv", "metadata.csv")
# Names, in lower case, of the columns that hold pictures' names.
NAME_COLUMNS = ("image_name", "sensor_image", "file_name")
# Names of label columns in other conventions, in lower case, by those used here: poses in mm and deg, and moves before the frame was taken.
# tactile_data has pose_x and shear_x, LeRobot the names of a state vector.
_AXES = ("x", "y", "z", "rx", "ry", "rz")
_POSES, _MOVES = ("pose_{}", "observation.state.{}", "observation.state.{}.pos", "{}"), ("shear_{}", "observation.tactile.move.{}")
CALLED_HERE = {
    written.format(axis): f"{here}_{k}"
    for here, names in (("pose", _POSES), ("move", _MOVES))
    for written in names
    for k, axis in enumerate(_AXES, 1)
}
# Ranges of poses and moves in mm, between which a sensor's contacts lie: below the first they are probably in m (contacts within 100 mm),
# above the second, which no arm here reaches, in um.
MM_RANGES = (0.1, 2000.0)
# Range of poses and moves in deg below which they are probably in rad (within 34 deg), and the share by which a range may differ from a
# quarter, a half or a whole turn in rad.
RAD_RANGE, TURN_SHARE, TURNS_RAD = 1.2, 0.01, (np.pi / 2, np.pi, 2 * np.pi)
# Characters that may separate the cells of a row. The most frequent one in the header is used.
SEPARATORS = (",", ";", "\t")
# Largest size of a table or of metadata, bytes: a million rows of a hundred characters.
LARGEST_BYTES = 100_000_000
# Most columns of a table. The widest tables in use have about 40.
MOST_COLUMNS = 1000
# Characters that are removed at both ends of a cell.
AROUND_CELLS = " \t\"'"


def base_name(path: str) -> str:
    """The last part of a path, with Windows or POSIX separators."""
    return re.split(r"[\\/]", path.strip(AROUND_CELLS))[-1]


def bare_name(name: str) -> str:
    """A picture's name in lower case without its suffix, if it has one."""
    stem, dot, suffix = name.casefold().rpartition(".")
    return stem if dot + suffix in IMAGE_SUFFIXES else name.casefold()


def _text(path: Path) -> str:
    data = read_regular(path, LARGEST_BYTES)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    if b"\0" in data[:2]:
        return data.decode("utf-16-be" if data[0] == 0 else "utf-16-le", "replace")
    return data.decode("utf-8-sig", "replace")


@dataclass
class LabelTable:
    """A table: its file's name, its cells by column, and the columns that name pictures. Pictures are named by their base names."""

    name: str
    columns: dict[str, list[str]]
    name_lists: list[list[str]]


def _cells(text: str) -> list[list[str]]:
    """The rows' cells, without empty rows.

    Raises
    ------
    csv.Error
        A cell is too long, or a row has more cells than a table has.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    separator = max(SEPARATORS, key=lines[0].count) if lines else ","
    rows, reader = [], partial(csv.reader, delimiter=separator, skipinitialspace=True)
    for number, line in enumerate(lines, 1):
        if line.count(separator) >= MOST_COLUMNS:
            raise csv.Error(f"row {number} has {line.count(separator) + 1} cells, a table has at most {MOST_COLUMNS}")
        unclosed = line.count('"') % 2 == 1  # the csv reader would join such a line with the following lines
        (row,) = reader([line], quoting=csv.QUOTE_NONE) if unclosed else reader([line])
        row = [cell.strip(AROUND_CELLS) for cell in row]
        if separator != ",":
            row = [re.sub(r"^([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)$", r"\1.\2", cell) for cell in row]
        if any(row):
            rows.append(row)
    return rows


def _distinct(header: list[str]) -> list[str]:
    """Column names. A repeated name gets _2, _3, ... appended."""
    taken: dict[str, int] = {}  # each name so far, and the number of its last try
    distinct = []
    for name in header:
        new = name
        while new and new in taken:
            taken[name] += 1
            new = f"{name}_{taken[name]}"
        taken[new] = 1
        distinct.append(new)
    return distinct


def read_table(path: Path, problems: list[str], *, otherwise: str = "frames are taken in natural order") -> LabelTable | None:
    """A table; None if it names no pictures.

    The reason, with its consequence ``otherwise``, is then added to ``problems``.
    """
    try:
        text = _text(path)
        rows = _cells(text)
    except (OSError, csv.Error) as error:
        problems.append(f"{path.name}: can't be read ({getattr(error, 'strerror', error)}); {otherwise}")
        return None
    header = rows[0] if rows else []
    name_columns = [k for k, column in enumerate(header) if column.casefold() in NAME_COLUMNS]
    if not name_columns:
        problems.append(f"{path.name}: no column {' or '.join(NAME_COLUMNS)}; {otherwise}")
        return None
    ragged = sum(len(row) != len(header) for row in rows[1:])
    if ragged:
        problems.append(f"{path.name}: {format_count(ragged, 'rows')} without the header's {len(header)} cells, left out")
    if _is_truncated(text, rows[1:]):
        problems.append(f"{path.name}: it ends within its last row, before the last number; copy it again")
    distinct = _distinct(header)
    if renamed := [new for new, old in zip(distinct, header, strict=True) if new != old]:
        problems.append(f"{path.name}: {describe_count('columns with the name of another', renamed)}")
    rows = [row for row in rows[1:] if len(row) == len(header)]
    columns = {column: [row[k] for row in rows] for k, column in enumerate(distinct) if column}
    return LabelTable(path.name, columns, [[base_name(row[k]) for row in rows] for k in name_columns])


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Columns of a table that need not name pictures. A column is float if every cell is a number, else text.

    Raises
    ------
    FrameError
        The file can't be read, or a row does not have the header's number of cells.
    """
    try:
        header, *rows = _cells(_text(path)) or [[]]
    except (OSError, csv.Error) as error:
        raise FrameError(f"{path}: can't be read ({error}); give a table with a header and a row for each contact") from None
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise FrameError(f"{path}: row {number} has {len(row)} cells, the header {len(header)}; repair or remove the row")
    return {name: _as_array([row[k] for row in rows]) for k, name in enumerate(_distinct(header)) if name}


def _is_truncated(text: str, rows: list[list[str]]) -> bool:
    """Whether the text was cut within the last row: its last cell is no number, but the cells above it are."""
    ended = text.splitlines(keepends=True)[-1] != text.splitlines()[-1]
    *above, last = (np.isnan(_number(row[-1])) for row in rows or [["0"]])
    return not ended and last and not all(above or [False])


def describe_count(things: str, names: Sequence[str] | np.ndarray) -> str:
    """Number and kind of things, as for ``format_count``, with the names of the first three."""
    return f"{format_count(len(names), things)} ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"


def pair_rows(names: list[str], files: list[Path]) -> tuple[dict[int, Path], list[int], list[int], list[int]]:
    """Pair names and pictures: first by exact names, then without regard to case, then without suffix.

    Returns
    -------
    files : dict of int to Path
        The picture of each row that has its own picture.
    loose : list of int
        The rows in ``files`` whose picture's name differs in case or suffix.
    doubled, missing : list of int
        Rows whose picture belongs to an earlier row; rows without any picture.
    """
    found: dict[int, Path] = {}
    loose: list[int] = []
    doubled: list[int] = []
    missing = list(range(len(names)))
    for key in (str, str.casefold, bare_name):
        taken = set(found.values())
        free = {key(file.name): file for file in reversed(files) if file not in taken}
        rows, missing = missing, []
        for row in rows:
            file = free.get(key(names[row]))
            if file is None:
                missing.append(row)
            elif file in taken:
                doubled.append(row)
            else:
                found[row] = file
                taken.add(file)
                loose += [row] * (key is not str)
    return found, loose, doubled, missing


def order_by_table(tables: list[Path], files: list[Path], problems: list[str]) -> tuple[list[Path], dict[str, np.ndarray]]:
    """Frames in the order of the table that names most of them, and its columns in that order. Frames that it does not name come last.

    Cells are empty for frames without a row. If no table names a frame, the order is unchanged and there are no columns.
    """
    readable = [table for path in tables if (table := read_table(path, problems))]
    pairs = [(table, names, pair_rows(names, files)) for table in readable for names in table.name_lists]
    if not pairs:
        return files, {}
    table, names, (found, loose, doubled, missing) = max(pairs, key=lambda pair: len(pair[2][0]))
    if not found:
        problems.append(f"{table.name}: no row names a picture here; frames are taken in natural order")
        return files, {}
    named = set(found.values())
    unlisted = [file for file in files if file not in named]
    odd = {
        "rows for a picture with another suffix or case": loose,
        "rows for a picture that has one before, left out": doubled,
        "rows without a picture": missing,
    }
    problems += [f"{table.name}: {describe_count(what, [names[k] for k in rows])}" for what, rows in odd.items() if rows]
    if unlisted:
        what = "pictures without a row, placed after the others"
        problems.append(f"{table.name}: {describe_count(what, [p.name for p in unlisted])}")
    rows = sorted(found)
    labels = {c: _as_array([cells[k] for k in rows] + [""] * len(unlisted)) for c, cells in table.columns.items()}
    return [found[k] for k in rows] + unlisted, called_here(labels)


def called_here(labels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns (M,). Columns with names of other conventions are also given under the names used here."""
    return labels | {here: cells for name, cells in labels.items() if (here := CALLED_HERE.get(name.casefold())) and here not in labels}


def unlikely_units(labels: dict[str, np.ndarray]) -> list[str]:
    """Doubts about the unit of a table's poses and moves, one line each. Lengths are in mm, angles in deg.

    A table has one unit for all lengths, and one for all angles, so the widest column of each decides. A column that is constant carries no
    information.
    """
    ranges = {"mm": [(0.0, "")], "deg": [(0.0, "")]}
    for name, cells in labels.items():
        if re.fullmatch("(pose|move)_[1-6]", name) and np.isfinite(values := numbers(cells)).any():
            ranges["mm" if name[-1] in "123" else "deg"].append((float(np.nanmax(values) - np.nanmin(values)), name))
    (length, _), (angle, _) = widest = [max(each) for each in ranges.values()]
    others = ["m" if 0 < length < MM_RANGES[0] else "um" if length > MM_RANGES[1] else ""]
    others += ["rad" if 0 < angle < RAD_RANGE or any(abs(angle / turn - 1) < TURN_SHARE for turn in TURNS_RAD) else ""]
    return [
        f"labels in another unit? Of the columns in {unit}, {name} has the widest range: {span:.3g}; if they are in {other}, convert them"
        for unit, (span, name), other in zip(ranges, widest, others, strict=True)
        if other
    ]


def _as_array(cells: list[str]) -> np.ndarray:
    """A column as float if every cell is a number (an empty cell is NaN), else as text."""
    try:
        return np.array([_written_number(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells, str)


def numbers(cells: np.ndarray) -> np.ndarray:
    """A column (M,) as floats; NaN where a cell holds no finite number."""
    values = cells if cells.dtype.kind == "f" else np.array([_number(cell) for cell in cells])
    return np.where(np.isfinite(values), values, np.nan)


def _number(cell: str) -> float:
    try:
        return _written_number(cell)
    except ValueError:
        return float("nan")


def _written_number(cell: str) -> float:
    """The number in a cell. Unlike Python, this does not read 1_5 as 15, because such a cell is a typing error."""
    if "_" in cell:
        raise ValueError(cell)
    return float(cell)


def read_metadata(path: Path, problems: list[str]) -> object | None:
    """Content of a JSON file; None if it cannot be read, with the reason in ``problems``.

    Some files in use hold Windows paths with single backslashes, and NaN or Infinity. Both are accepted and noted in ``problems``.
    """
    try:
        text = _text(path)
    except OSError as error:
        problems.append(f"{path.name}: can't be read ({error.strerror}); ignored")
        return None
    odd: set[str] = set()

    def constant(name: str) -> float:
        odd.add(name)
        return float(name)

    try:
        content = _parse_json(path.name, text, constant, problems)
    except ValueError as error:
        problems.append(f"{path.name}: invalid JSON ({error}); ignored")
        return None
    except RecursionError:
        problems.append(f"{path.name}: nested too deeply to be metadata; ignored")
        return None
    if odd:
        problems.append(f"{path.name}: holds {', '.join(sorted(odd))}, which isn't JSON")
    return content


def _parse_json(name: str, text: str, constant: Callable[[str], float], problems: list[str]) -> object:
    """Content of JSON text. If necessary, single backslashes are doubled first. ``constant`` converts NaN and Infinity."""
    try:
        return json.loads(text, parse_constant=constant)
    except ValueError as error:
        mended = re.sub(r'\\(?!["\\/bfnrt]|u[0-9a-fA-F]{4})', r"\\\\", text)
        try:
            content = json.loads(mended, parse_constant=constant)
        except ValueError:
            raise error from None
        problems.append(f"{name}: invalid JSON ({error}); read with its backslashes doubled")
        return content
