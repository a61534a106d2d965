"""What Sphinx does for this documentation beyond its extensions: generated pages, notebooks beside tutorials, formulas as MathML."""

import os
from functools import cache
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx

from generators import api, commands, notebooks, specifications

REFERENCE = "reference/generated"
"""Folder of the generated pages; git does not keep it."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register all steps."""
    app.add_html_math_renderer("mathml", (_inline_formula, None), (_displayed_formula, None))
    app.connect("builder-inited", _write_references)
    app.connect("source-read", _name_notebook)
    app.connect("html-page-context", _draw_titles_only, priority=100)  # before the theme draws its navigation
    app.connect("build-finished", _write_notebooks)
    return {"parallel_read_safe": True}


def generate_pages() -> dict[str, str]:
    """Text of every generated page by its path below the documentation, without the ending."""
    pages = {f"{REFERENCE}/commands/{_stem(group.title)}": commands.text_of(group) for group in commands.groups()}
    pages |= {f"{REFERENCE}/specifications/{made.stem}": specifications.text_of(made) for made in specifications.FILES}
    return pages | {f"{REFERENCE}/api/{page}": api.text_of(page, members) for page, members in api.pages().items()}


def _stem(title: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in title.lower()).replace("--", "-")


def _write_references(app: Sphinx) -> None:
    """Write what has changed and remove what is gone, so that a second build reads only changed pages."""
    pages = {Path(app.srcdir) / f"{name}.md": text for name, text in generate_pages().items()}
    for path in (Path(app.srcdir) / REFERENCE).rglob("*.md"):
        if path not in pages:
            path.unlink()
    for path, text in pages.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _name_notebook(app: Sphinx, name: str, source: list[str]) -> None:
    """Link each tutorial to its notebook, which lies beside its page."""
    if notebooks.is_tutorial(name):
        title, _, rest = source[0].partition("\n")
        stem = name.rpartition("/")[2]
        source[0] = f"{title}\n\n<p><a class='notebook' href='{stem}.ipynb' download>This page as a notebook</a></p>\n{rest}"


@cache
def _titles(toc: nodes.bullet_list) -> nodes.bullet_list:
    """A page's table of contents without the headings below its title. A page that lists other pages keeps all."""
    if next(toc.findall(addnodes.toctree), None) is not None:
        return toc
    short = nodes.bullet_list()
    short += [nodes.list_item("", item[0].deepcopy()) for item in toc]
    return short


def _draw_titles_only(app: Sphinx, name: str, template: str, context: dict[str, Any], page: nodes.document | None) -> None:
    """The navigation shows titles alone. For each page, Sphinx would copy all headings of all pages and drop them: half of its time."""
    env, draw = app.env, context["toctree"]

    def draw_titles(**options: Any) -> str:
        whole, env.tocs = env.tocs, {page: _titles(toc) for page, toc in env.tocs.items()}
        try:
            return draw(**options)
        finally:
            env.tocs = whole

    context["toctree"] = draw_titles


def _write_notebooks(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.format == "html":
        notebooks.write_all(Path(app.srcdir), Path(app.outdir), run=os.environ.get("NOTEBOOKS") != "written")


def _inline_formula(translator: Any, node: nodes.math) -> None:
    translator.body.append(tex2mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _displayed_formula(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f"<div class='formula'>{tex2mathml(node.astext(), as_block=True)}</div>")
    raise nodes.SkipNode
