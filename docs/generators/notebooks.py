"""Pages whose code the tests run: tutorials, from which notebooks are written, and how to add things.

Blocks of ``python`` are run in one namespace, lines of ``bash`` that begin with ``twin`` by the program, and a block of ``text`` after
either states what it prints; ``...`` in it stands for anything. A block of ``toml`` that begins with a comment of one word is the file of
that name. A block may stand in an item of a list.
"""

import os
import re
import sys
import tempfile
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDER = "tutorials"
BLOCK = r"^( *)```([\w{}-]*)[^\n]*\n(.*?)^\1```$"
"""A block of code: its indentation, language and code."""
MOST_CELL_S = 1200
"""Longest time of a cell."""
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
    return [*tutorials(), DOCS / "gallery.md", *(path for path in sorted((DOCS / "how-to").glob("*.md")) if path.stem != "index")]


def blocks(text: str) -> list[Block]:
    """The blocks of code of a page, without the indentation of a list."""
    return [
        Block(found[2], textwrap.dedent(found[3]), text[: found.start()].count("\n") + 1)
        for found in re.finditer(BLOCK, text, re.DOTALL | re.MULTILINE)
    ]


def cells(text: str) -> list[dict[str, Any]]:
    """The cells of a page's notebook: prose, code, commands with ``!``, and files that a cell writes.

    What a block prints is left out, because the notebook shows it itself.
    """
    import nbformat

    found, place = [], 0
    for block in re.finditer(BLOCK, text, re.DOTALL | re.MULTILINE):
        language, code = block[2], textwrap.dedent(block[3]).rstrip()
        file = re.match(r"# (\S+\.toml)\n", code) if language == "toml" else None
        if language == "bash":
            code = re.sub(r"^twin ", "!twin ", re.sub(r"\\\n\s*", "", code), flags=re.MULTILINE)
        elif file:
            code = f"%%writefile {file[1]}\n{code}"
        elif language not in ("python", "text"):
            continue
        found += [nbformat.v4.new_markdown_cell(prose)] if (prose := text[place : block.start()].strip()) else []
        found += [nbformat.v4.new_code_cell(code)] if language != "text" else []
        place = block.end()
    return found + ([nbformat.v4.new_markdown_cell(prose)] if (prose := text[place:].strip()) else [])


def write_all(source: Path, out: Path, *, run: bool = True) -> list[Path]:
    """Write a notebook of each tutorial below ``out``; its folder has the pages' names.

    With ``run`` its own kernel runs each in a fresh folder.

    Raises
    ------
    nbclient.exceptions.CellExecutionError
        A cell ends with an error.
    """
    import nbformat
    from nbclient import NotebookClient

    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"  # for !twin
    os.environ["TERM"] = "dumb"  # no moving bars in what is kept
    written = []
    for page in sorted((source / FOLDER).glob("*.md")):
        if page.stem == "index":
            continue
        notebook = nbformat.v4.new_notebook(cells=cells(page.read_text(encoding="utf-8")))
        notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
        if run:
            with tempfile.TemporaryDirectory() as folder:
                NotebookClient(notebook, timeout=MOST_CELL_S, resources={"metadata": {"path": folder}}).execute()
        for cell in notebook.cells:
            require_commands_done(page.name, cell)
        written.append(out / FOLDER / f"{page.stem}.ipynb")
        nbformat.write(notebook, written[-1])
    return written


def require_commands_done(page: str, cell: dict[str, Any]) -> None:
    """Raise ``RuntimeError`` if a command of an executed cell printed an error; ``!`` itself raises none."""
    for shown in cell.get("outputs", ()):
        if "twin: error:" in (said := shown.get("text", "")):
            raise RuntimeError(f"{page}: {cell['source']}\n{said}")
