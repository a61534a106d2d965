"""Pages of results: a builder that all commands use, and templates that give all pages the same look.

A page is one HTML file that needs no network. Its pictures are files beside it, or are embedded in it (``embed``). All text is escaped;
emphasis is made by `strong`, `code`, `good` and `bad`, which escape their argument. Words in backquotes are names,
in the font for code.
"""

import base64
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from twin.report.table import Column, Row, make_table
from twin.report.themes import dark_of, stylesheet
from twin.store import write_text
from twin.store.fingerprint import program_version

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
        """Add a table (see `twin.report.table.make_table`)."""
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
