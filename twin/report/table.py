"""Tables: CSV files, and the tables of a page.

Numbers are readable: integers without decimals, exponents only for very large or small numbers, equal decimals in a column.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeGuard

from twin.store import text_file

# Text for a missing value.
NOTHING = "–"
# Minus sign, which has the width of a plus sign in tabular figures.
MINUS = "−"
# Narrow no-break space between groups of three digits.
GROUP = "\u202f"
# Least number that is written with groups of digits.
GROUPED_FROM = 10_000
# Absolute values between which a number is written without a power of ten.
PLAIN_LOW, PLAIN_HIGH = 1e-4, 1e9
# Least number of significant digits of a column's smallest value.
FEWEST = 2
# Most digits of a column's largest value. If it would need more, each value has its own number of decimals.
LONGEST = 6
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
Row = Mapping[str, object]
UNITS = {
    "mm": "mm", "deg": "deg", "px": "px", "s": "s", "ms": "ms", "n": "N", "mib": "MiB", "percent": "%", "px2": "px²", "mm2": "mm²",
    "minutes": "min",
}  # fmt: skip


def number(value: object, digits: int = 3, *, decimals: int | None = None, signed: bool = False) -> str:
    """A number as text for a sentence or a cell.

    Parameters
    ----------
    value : int, float, bool, str or None
        A bool becomes yes or no, None and NaN become a dash, a text is not changed.
    digits : int
        Significant digits of a number that is not whole; digits before the point are always written.
    decimals : int, optional
        Number of digits after the point instead, also for whole numbers.
    signed : bool
        Write a plus sign before positive numbers.
    """
    if value is None or isinstance(value, str):
        return NOTHING if value is None else value
    if isinstance(value, bool) or type(value).__name__ == "bool":  # numpy's bool is another type
        return "yes" if value else "no"
    if not isinstance(value, Real):
        return str(value)
    size = float(value)
    if math.isnan(size):
        return NOTHING
    sign = MINUS if size < 0 else "+" if signed and size > 0 else ""
    if math.isinf(size):
        return f"{sign}∞"
    if decimals is None:
        if isinstance(value, Integral):
            decimals = 0
        elif size and not PLAIN_LOW <= abs(size) < PLAIN_HIGH:
            mantissa, _, power = f"{abs(size):.{digits - 1}e}".partition("e")
            return f"{sign}{mantissa}×10{str(int(power)).translate(SUPERSCRIPTS)}"
        else:
            decimals = max(0, digits - 1 - _power(size, digits)) if size else 0
    text = f"{abs(size):.{decimals}f}"
    if not float(text):
        sign = ""  # a number that is rounded to zero has no sign
    return sign + _group_digits(text)


def column(values: Sequence[object], digits: int = 3, *, decimals: int | None = None, signed: bool = False) -> list[str]:
    """The values of a table's column with equally many decimals, so that their decimal points are aligned.

    The column's median has ``digits`` significant digits, its smallest value at least two. If the largest value would need more than six
    digits for that, each value has its own number of decimals.
    """
    sizes = sorted(abs(float(v)) for v in values if is_number(v) and math.isfinite(float(v)) and float(v))
    if decimals is None and sizes:
        if all(size == int(size) for size in sizes):
            decimals = 0
        else:
            middle, least = _power(sizes[len(sizes) // 2], digits), _power(sizes[0], FEWEST)
            wanted = max(0, digits - 1 - middle, FEWEST - 1 - least)
            decimals = wanted if wanted + max(_power(sizes[-1], digits), 0) + 1 <= LONGEST else None
    return [number(v, digits, decimals=decimals, signed=signed) for v in values]


def is_number(value: object) -> TypeGuard[Real]:
    """Whether a value is a number of Python or numpy. A bool is not a number."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _power(size: float, digits: int) -> int:
    """Power of ten of a number's first digit after rounding to ``digits`` digits (9.996 to three is 10.0: 1)."""
    return int(f"{abs(size):.{digits - 1}e}".partition("e")[2])


def _group_digits(text: str) -> str:
    whole, point, rest = text.partition(".")
    return (f"{int(whole):,}".replace(",", GROUP) if int(whole) >= GROUPED_FROM else whole) + point + rest


@dataclass(frozen=True)
class Column:
    """Format of a column: how the values of one key of the rows are shown.

    Attributes
    ----------
    key : str
        Key of the rows; a row without it has an empty value.
    title, unit : str
        Text of the heading.
    digits : int
        Significant digits of the column's median.
    decimals : int, optional
        Number of digits after the point instead.
    signed : bool
        Write a plus sign before positive numbers.
    best : {"", "least", "most"}
        Which value is marked as the best.
    scale : float
        Factor on the numbers: 100 for a share that is shown in percent.
    align : {"", "right"}
        ``right`` for texts that are numbers, each with its own number of decimals.
    """

    key: str
    title: str
    unit: str = ""
    digits: int = 3
    decimals: int | None = None
    signed: bool = False
    best: Literal["", "least", "most"] = ""
    scale: float = 1.0
    align: Literal["", "right"] = ""

    @classmethod
    def of(cls, key: str, *, unit: str = "", best: Literal["", "least", "most"] = "", digits: int = 3) -> "Column":
        """A column whose title is made from its key. The unit is the end of the key (``depth_mm``) unless it is given."""
        words = key.split("_")
        if not unit and len(words) > 1 and words[-1] in UNITS:
            unit = UNITS[words.pop()]
        return cls(key, " ".join(words), unit, digits, best=best)


@dataclass(frozen=True)
class Cell:
    """A value of a row with additional information.

    Attributes
    ----------
    value : object
        Number, text or None.
    tone : {"", "good", "bad"}
    note : str
        Small text below.
    bar : float, optional
        Share in [0, 1] that is drawn as a bar below.
    href : str
        Address of a link within the page.
    """

    value: object
    tone: Literal["", "good", "bad"] = ""
    note: str = ""
    bar: float | None = None
    href: str = ""


TemplateTable = dict[str, Any]
"""A table in the form that the template needs: ``heads``, ``body`` with a list of cells for each row (one for each head), ``caption``."""


def make_table(rows: Sequence[Row], columns: Sequence[Column | str], *, caption: str = "") -> TemplateTable:
    """Format rows for a page.

    Parameters
    ----------
    rows : sequence of mappings
        Values by key: numbers, texts, None, or `Cell`.
    columns : sequence of Column or str
        A key is short for ``Column.of(key)``.
    caption : str
    """
    chosen = [entry if isinstance(entry, Column) else Column.of(entry) for entry in columns]
    heads, shown = [], []
    for entry in chosen:
        cells = [value if isinstance(value, Cell) else Cell(value) for value in (row.get(entry.key) for row in rows)]
        values = [(float(cell.value) * entry.scale if entry.scale != 1 and is_number(cell.value) else cell.value) for cell in cells]
        numeric = entry.align == "right" or any(is_number(value) for value in values)
        texts = column(values, entry.digits, decimals=entry.decimals, signed=entry.signed)
        marked = _best(values, entry.best)
        heads.append({"title": entry.title, "unit": entry.unit, "number": numeric})
        shown.append([_style_cell(c, v, t, numeric, k in marked) for k, (c, v, t) in enumerate(zip(cells, values, texts, strict=True))])
    return {"heads": heads, "body": [list(row) for row in zip(*shown, strict=True)], "caption": caption}


def write_rows(path: Path, rows: Sequence[Row]) -> Path:
    """Write rows with the same keys as CSV with full precision, and return the path."""
    return _write_csv(path, list(rows[0]), rows)


def write_table(path: Path, rows: Sequence[Row]) -> Path:
    """Write rows as readable CSV with six significant digits. The table has the columns of all rows. Returns the path."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return _write_csv(path, columns, [{key: _plain(value) for key, value in row.items()} for row in rows])


def _write_csv(path: Path, columns: list[str], rows: Sequence[Row]) -> Path:
    with text_file(path) as text:
        writer = csv.DictWriter(text, fieldnames=columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
    return path


def _plain(value: object) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _best(values: list[object], best: str) -> set[int]:
    known = {k: float(v) for k, v in enumerate(values) if is_number(v) and math.isfinite(float(v))} if best else {}
    if len(known) < 2:
        return set()
    wanted = min(known.values()) if best == "least" else max(known.values())
    return {k for k, value in known.items() if value == wanted}


def _style_cell(cell: Cell, value: object, text: str, numeric: bool, best: bool) -> dict[str, object]:
    """A cell in the form that the template needs; ``style`` holds its CSS classes."""
    styles = [name for name, given in (("number", numeric), ("best", best), (cell.tone, bool(cell.tone))) if given]
    bar = None if cell.bar is None else round(100 * min(max(cell.bar, 0.0), 1.0))
    shown = value if isinstance(value, str) else text  # texts with markup are not changed
    return {"text": shown, "number": numeric, "style": " ".join(styles), "note": cell.note, "bar": bar, "href": cell.href}


def force_interval(force_n: Sequence[float], factor: float) -> tuple[float, float]:
    """Ends of the 90 % interval of a simulated force's size, N, if the true one is larger or smaller by ``skin.stiffness_factor``."""
    size = math.hypot(*force_n)
    return size / factor, size * factor
