"""The reference of functions and classes: a page for each package, made by Sphinx from the docstrings."""

import ast
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("scenes", "twin", "training", "hardware")
# Options are in the reference of commands; Python's own entry is one function.
LEFT_OUT = ("twin.cli",)


@dataclass(frozen=True)
class Module:
    """A public module."""

    name: str
    path: Path

    @property
    def tree(self) -> ast.Module:
        """Its source, parsed."""
        return ast.parse(self.path.read_text(encoding="utf-8"))


def modules() -> list[Module]:
    """Every public module of the packages, those of the command line left out."""
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            if not name.startswith(LEFT_OUT) and not any(part.startswith("_") for part in parts[:-1]):
                found.append(Module(name, path))
    return sorted(found, key=lambda module: module.name)


def pages() -> dict[str, list[Module]]:
    """Modules by the page they stand on: ``twin.pins``, say, or ``twin`` for the modules that lie in it."""
    found: dict[str, list[Module]] = {}
    for module in modules():
        parts = module.name.split(".")
        page = ".".join(parts[:2]) if (ROOT / Path(*parts[:2])).is_dir() else parts[0]
        found.setdefault(page, []).append(module)
    return found


def text_of(page: str, members: list[Module]) -> str:
    """One page, Markdown with Sphinx's directives."""
    lines = [f"# {page}", ""]
    for module in members:
        package = module.path.name == "__init__.py"
        if module.name != page:
            lines += [f"## {module.name}", ""]
        lines += ["```{eval-rst}", f".. automodule:: {module.name}", *([] if package else ["   :members:"]), "```", ""]
        exported = _exported(module.tree) if package else {}
        if exported:
            lines += [f"Imported from here, as in `from {module.name} import {min(exported)}`:", ""]
            lines += ["```{eval-rst}", *(f"* :py:obj:`{name} <{place}>`" for name, place in sorted(exported.items())), "```", ""]
    return "\n".join(lines) + "\n"


def _exported(tree: ast.Module) -> dict[str, str]:
    """Names in ``__all__`` and where they are defined."""
    places = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    lists = [node.value for node in tree.body if isinstance(node, ast.Assign) and any(ast.unparse(t) == "__all__" for t in node.targets)]
    names = [name for each in lists for name in ast.literal_eval(each)]
    return {name: places[name] for name in names if name in places}


def undocumented() -> list[str]:
    """Public functions, classes and methods that neither have a docstring nor stand for one that has.

    A method needs none where another class of the packages explains the method of that name: a protocol or base class that it fills.
    A setter needs none beside its property.
    """
    parsed = [(module, module.tree) for module in modules()]
    said = {name for _, tree in parsed for name, node in _methods(tree) if ast.get_docstring(node)}
    found = []
    for module, tree in parsed:
        if not ast.get_docstring(tree):
            found.append(module.name)
        for node in _public(tree.body):
            if not ast.get_docstring(node):
                found.append(f"{module.name}.{node.name}")
            if isinstance(node, ast.ClassDef):
                silent = [each for each in _public(node.body) if not ast.get_docstring(each)]
                found += [f"{module.name}.{node.name}.{each.name}" for each in silent if each.name not in said]
    return found


def _public(body: list[ast.stmt]) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_") and not _registered(node):
            yield node


def _registered(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Whether a decorator that takes a description registers the function: ``@condition("darker", ...)``."""
    return any(isinstance(mark, ast.Call) and len(mark.args) > 1 for mark in node.decorator_list)


def _methods(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield from ((each.name, each) for each in _public(node.body))


def first_line(text: str | None) -> str:
    """The first paragraph of a docstring on one line."""
    return " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split())
