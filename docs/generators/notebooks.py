"""Pages whose code the tests run: tutorials, from which notebooks are written, and how to add things.

Blocks of ``python`` are run in one namespace, lines of ``bash`` that begin with ``twin`` by the program, and a block of ``text`` after
either states what it prints; ``...`` in it stands for anything. A block of ``toml`` that begins with a comment of one word is the file of
that name. A block may stand in an item of a list.
"""

import re
import textwrap
from dataclasses import dataclass
from pathlib import Path

FOLDER = "tutorials"
DOCS = Path(__file__).parents[1]


@dataclass(frozen=True)
class Block:
    """A block of code of a page.

    Attributes
    ----------
    language : str
        ``python``, ``bash``, ``text`` or another.
    code : str
    line : int
        Of the page, from 1.
    """

    language: str
    code: str
    line: int


def is_tutorial(name: str) -> bool:
    """Whether a page (its path below the documentation, without the ending) is a tutorial."""
    return name.startswith(f"{FOLDER}/") and not name.endswith("/index")


def tutorials() -> list[Path]:
    """Every tutorial's page."""
    return [path for path in sorted((DOCS / FOLDER).glob("*.md")) if path.stem != "index"]


def run_pages() -> list[Path]:
    """Every page whose code is run."""
    return [*tutorials(), *(path for path in sorted((DOCS / "how-to").glob("*.md")) if path.stem != "index")]


def blocks(text: str) -> list[Block]:
    """The blocks of code of a page, without the indentation of a list."""
    return [
        Block(found[2], textwrap.dedent(found[3]), text[: found.start()].count("\n") + 1)
        for found in re.finditer(r"^( *)```([\w{}-]*)[^\n]*\n(.*?)^\1```$", text, re.DOTALL | re.MULTILINE)
    ]


def write_all(source: Path, out: Path) -> list[Path]:
    """Write a notebook of each tutorial below ``out``; its folder has the pages' names."""
    import jupytext

    written = []
    for page in sorted((source / FOLDER).glob("*.md")):
        if page.stem == "index":
            continue
        notebook = jupytext.reads(page.read_text(encoding="utf-8"), fmt="md")
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        written.append(out / FOLDER / f"{page.stem}.ipynb")
        jupytext.write(notebook, written[-1])
    return written
