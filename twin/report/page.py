"""Pages of results: a builder that all commands use, their tables and CSV files, and the colours and templates that give all the same look.

A page is one HTML file that needs no network. Its pictures are files beside it, or are embedded in it (``embed``). All text is escaped;
emphasis is made by `strong`, `code`, `good` and `bad`, which escape their argument. Words in backquotes are names,
in the font for code.

Numbers of tables are readable: integers without decimals, exponents only for very large or small numbers, equal decimals in a column.

There is a light and a dark theme. Text colours have a contrast of at least 4.5:1 to every background of their theme. Lines of charts have
at least 3:1 in both themes (WCAG 2.1, success criteria 1.4.3 and 1.4.11).
"""

import base64
import csv
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import resources
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypeGuard
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from twin.store import text_file, write_text
from twin.store.fingerprint import program_version


@dataclass(frozen=True)
class Theme:
    """Colours as ``#rrggbb``.

    Attributes
    ----------
    page, surface, tint : str
        Backgrounds: of the page, of figures and tables, and of marked parts.
    ink, muted, accent, good, bad : str
        Text: normal, secondary, links, values that meet their target, values that miss it.
    line : str
        Rules between rows, borders, the grid of a chart.
    """

    page: str
    surface: str
    tint: str
    ink: str
    muted: str
    accent: str
    good: str
    bad: str
    line: str


LIGHT = Theme("#f6f7f9", "#ffffff", "#e4eefa", "#1a222d", "#526070", "#0a58a8", "#0f6b3a", "#ad2118", "#d8dee6")
DARK = Theme("#0f1419", "#161c23", "#1c2f45", "#e4e9ef", "#a1b0c0", "#82bbf7", "#62d296", "#ff9488", "#2c3744")

# Colours of the series of a chart in their order, the same in both themes. They were found by a random search among the colours with the
# contrast above. Any two differ by at least 20 (CIELAB) for readers with normal colour vision, for protanopes and for deuteranopes.
BLUE, RED, GREEN, PURPLE, OLIVE = "#0a7ff8", "#b73f2c", "#35956e", "#b355ac", "#a19200"
SERIES = (BLUE, RED, GREEN, PURPLE, OLIVE)


def dark_of(path: Path) -> Path:
    """Path of a chart in the dark theme."""
    return path.with_name(f"{path.stem}-dark{path.suffix}")


def stylesheet() -> str:
    """CSS of all pages: the colours of the themes as variables, which ``prefers-color-scheme`` chooses, and ``style.css``."""
    rules = resources.files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    light, dark = (f":root {{ {_variables(theme)} }}" for theme in (LIGHT, DARK))
    return f":root {{ color-scheme: light dark; }}\n{light}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n{rules}"


def _variables(theme: Theme) -> str:
    return " ".join(f"--{name}: {color};" for name, color in asdict(theme).items())


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
    grouped = f"{abs(size):,.{decimals}f}".replace(",", GROUP) if float(text) >= GROUPED_FROM else text
    return (sign if float(text) else "") + grouped  # a number that is rounded to zero has no sign


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


Kind = Literal["chart", "frame", "photo"]
# Least number of sections of a page that has a table of contents.
FEWEST_IN_CONTENTS = 4
MIME = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".svg": "image/svg+xml"}


@dataclass(frozen=True)
class PagePicture:
    """A picture of a page.

    Attributes
    ----------
    path : Path
        Relative to the page's folder, or absolute and inside this folder.
    alt : str
        Description of the picture for readers who can't see it.
        caption : str or Markup
    kind : {"chart", "frame", "photo"}
        A chart has a second file for the dark theme (`twin.report.charts.write_chart`). The pixels of a frame are not smoothed.
    width_px : int, optional
        Largest width on the page.
    """

    path: Path
    alt: str
    caption: str = ""
    kind: Kind = "chart"
    width_px: int | None = None

    def __post_init__(self) -> None:
        if not self.alt.strip():
            raise ValueError(f"{self.path}: a picture of a page needs a text that says what it shows (alt)")


@dataclass
class Page:
    """A page that is being made: its parts are added in their order, then it is written.

    Attributes
    ----------
    title : str
    made_by : str
        The command that makes the page, for example ``twin realism``.
    topic : str
        A few words above the title.
    lead : str
        First paragraph.
    """

    title: str
    made_by: str
    topic: str = "TacTip twin"
    lead: str = ""
    _blocks: list[dict[str, Any]] = field(default_factory=list, init=False)
    _files: list[tuple[Path, str]] = field(default_factory=list, init=False)

    def section(self, title: str, *paragraphs: str) -> None:
        """Begin a section, with its first paragraphs."""
        self._blocks.append({"kind": "section", "title": title, "anchor": slug(title)})
        self.text(*paragraphs)

    def heading(self, title: str, *, anchor: str = "") -> None:
        """Begin a part of a section; ``anchor`` is the name for links to it (by default it is made from the title)."""
        self._blocks.append({"kind": "heading", "title": title, "anchor": anchor or slug(title)})

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs."""
        self._blocks += [{"kind": "text", "text": paragraph} for paragraph in paragraphs if paragraph]

    def items(self, items: Sequence[str]) -> None:
        """Add a list."""
        if items:
            self._blocks.append({"kind": "items", "lines": items})

    def notice(self, title: str, items: Sequence[str], *, tone: Literal["", "good", "bad"] = "") -> None:
        """Add important notes. Without items nothing is added."""
        if items:
            self._blocks.append({"kind": "notice", "title": title, "lines": items, "tone": tone})

    def table(self, rows: Sequence[Row], columns: Sequence[Column | str], *, caption: str = "") -> None:
        """Add a table (see `twin.report.page.make_table`)."""
        self._blocks.append({"kind": "table", "table": make_table(rows, columns, caption=caption)})

    def figures(self, *pictures: PagePicture, layout: Literal["", "row", "beside"] = "") -> None:
        """Add pictures: one below the other, in a ``row`` that wraps, or a narrow one ``beside`` a wide one."""
        self._blocks.append({"kind": "figures", "pictures": pictures, "layout": layout})

    def download(self, path: Path, what: str = "") -> None:
        """Add a link to a file beside the page, and a description of its content."""
        self._files.append((path, what))

    def write(self, path: Path, *, embed: bool = False) -> Path:
        """Write the page, and return the path.

        Parameters
        ----------
        path : Path
            The HTML file.
        embed : bool
            Embed the pictures in the file, so that it can be sent alone.
        """
        return write_text(path, self.html(path.parent, embed=embed))

    def html(self, folder: Path, *, embed: bool = False) -> str:
        """The page as HTML, for a file in ``folder``."""
        blocks = [block | {"pictures": [_source(each, folder, embed) for each in block.get("pictures", ())]} for block in self._blocks]
        sections = [block for block in self._blocks if block["kind"] == "section"]
        environment = Environment(
            loader=PackageLoader("twin.report", "."), undefined=StrictUndefined, autoescape=True, trim_blocks=True, lstrip_blocks=True
        )
        environment.filters["names"] = lambda text: Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
        return environment.get_template("page.html.j2").render(
            stylesheet=stylesheet(),
            title=self.title,
            topic=self.topic,
            lead=self.lead,
            contents=sections if len(sections) >= FEWEST_IN_CONTENTS else [],
            blocks=blocks,
            files=[{"href": _address(path, folder), "name": path.name, "what": what} for path, what in self._files],
            provenance=provenance(self.made_by),
        )


def provenance(made_by: str) -> Markup:
    """The line that states the command, the version of this package and the time at which a page was made."""
    made = "Made by <code>{}</code>, tactip-twin {}, {:%Y-%m-%d %H:%M} UTC."
    return Markup(made).format(made_by, program_version(), datetime.now(UTC))


def strong(text: object) -> Markup:
    """Emphasised text."""
    return Markup("<strong>{}</strong>").format(text)


def code(text: object) -> Markup:
    """A name in the font for code."""
    return Markup("<code>{}</code>").format(text)


def good(text: object) -> Markup:
    """Text about something that meets its target."""
    return Markup('<span class="good">{}</span>').format(text)


def bad(text: object) -> Markup:
    """Text about something that misses its target."""
    return Markup('<span class="bad">{}</span>').format(text)


def sentence(*parts: str) -> Markup:
    """Parts of a paragraph joined by spaces. Plain texts among them are escaped, empty ones left out."""
    return Markup(" ").join(part for part in parts if part)


def slug(title: str) -> str:
    """A title as the name of an anchor in a page."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "part"


def link_to(anchor: str) -> str:
    """Address of an anchor in the same page."""
    return f"#{quote(anchor, safe='')}"


def _source(picture: PagePicture, folder: Path, embed: bool) -> dict[str, object]:
    """A picture in the form that the template needs."""
    dark = dark_of(picture.path) if picture.kind == "chart" else None
    found = [_embed_file(folder / _within(path, folder)) if embed else _address(path, folder) for path in (picture.path, dark) if path]
    return {**vars(picture), "src": found[0], "dark": found[1] if dark else ""}


def _address(path: Path, folder: Path) -> str:
    """Address of a file in a page of a folder."""
    return quote(_within(path, folder).as_posix(), safe="/")


def _embed_file(path: Path) -> str:
    return f"data:{MIME[path.suffix.lower()]};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _within(path: Path, folder: Path) -> Path:
    """A file's path relative to the page's folder. A path that is not absolute and does not begin with the folder is already relative."""
    return Path(os.path.relpath(path, folder)) if path.is_absolute() or path.is_relative_to(folder) else path
