"""Tables and single numbers of documents, printed from the kept figures.

In a document stands ``<!-- figures: NAME -->``, then whatever ``templates/NAME.md`` gives with the figures put in, then
``<!-- /figures -->``; within a sentence ``<!-- figure: pins.mg400-331.ms .1f -->3.2<!-- /figure -->``. A template names figures in braces,
with Python's format after a colon (``{mechanics.calculix.plane_force:+.1%}``). A figure that was not measured yet reads ``?``.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from figures.jobs import FIGURES, ROOT, FiguresError, Value, values

TEMPLATES = Path(__file__).with_name("templates")
UNKNOWN = "?"
_PLACE = re.compile(r"\{([\w.+-]+)(?::([^{}]*))?\}")
_TABLE = re.compile(r"(<!-- figures: ([\w.-]+) -->\n).*?(<!-- /figures -->)", re.DOTALL)
_NUMBER = re.compile(r"(<!-- figure: ([\w.+-]+) (\S+) -->).*?(<!-- /figure -->)", re.DOTALL)


def documents(root: Path = ROOT) -> list[Path]:
    """README and what lies in docs."""
    return [path for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))) if path.is_file()]


def render(name: str, known: dict[str, Value]) -> str:
    """A table with its figures."""
    return _PLACE.sub(lambda match: _said(known, match[1], match[2] or ""), _template(name))


def filled(text: str, known: dict[str, Value]) -> str:
    """A document's text with all its tables and numbers."""
    text = _TABLE.sub(lambda match: f"{match[1]}\n{render(match[2], known).strip()}\n\n{match[3]}", text)
    return _NUMBER.sub(lambda match: f"{match[1]}{_said(known, match[2], match[3])}{match[4]}", text)


def used_in(text: str) -> Iterator[str]:
    """Names of the figures that a document needs."""
    for match in _TABLE.finditer(text):
        yield from (place[1] for place in _PLACE.finditer(_template(match[2])))
    yield from (match[2] for match in _NUMBER.finditer(text))


def templates() -> list[str]:
    """Names of all tables."""
    return sorted(path.stem for path in TEMPLATES.glob("*.md"))


def named_in_templates() -> set[str]:
    """Names of the figures in all tables, whether a document shows them or not."""
    return {place[1] for name in templates() for place in _PLACE.finditer(_template(name))}


def fill_documents(known: dict[str, Value] | None = None) -> list[Path]:
    """Write the figures into the documents; those that changed."""
    known, changed = values(FIGURES) if known is None else known, []
    for path in documents():
        text = path.read_text()
        if (made := filled(text, known)) != text:
            path.write_text(made)
            changed.append(path)
    return changed


def _template(name: str) -> str:
    path = TEMPLATES / f"{name}.md"
    if not path.is_file():
        raise FiguresError(f"no table is called {name!r}; there are {', '.join(templates())}")
    return path.read_text()


def _said(known: dict[str, Value], name: str, how: str) -> str:
    return format(known[name].value, how) if name in known else UNKNOWN
