"""The reference of functions and classes: a page for each package, made from signatures and docstrings. Nothing is imported for it."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("scenes", "twin", "training", "hardware")
# Options are in the reference of commands; Python's own entry is one function.
LEFT_OUT = ("twin.cli",)
# Characters of the longest signature on one line.
WIDTH = 100


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
    """One page, Markdown: each module with its public functions and classes."""
    lines = [f"# {page}", ""]
    for module in members:
        tree = module.tree
        lines += [f"## {module.name}", "", markdown(ast.get_docstring(tree)), ""]
        exported = _list_exports(tree) if module.path.name in ("__init__.py", "extend.py") else {}
        if exported:
            first = min(exported)
            lines += [
                f"Import from here, as in `from {module.name} import {first}`: "
                + ", ".join(f"`{name}`" for name in sorted(exported))
                + ".",
                "",
            ]
        for node in _public(tree.body):
            lines += _describe(node, "###")
    return "\n".join(lines) + "\n"


def _describe(node: ast.FunctionDef | ast.ClassDef, level: str, owner: str = "") -> Iterator[str]:
    """A function or class with its signature and its docstring; a class with its methods."""
    kind = _kind(node)
    yield from (f"{level} {owner}{node.name}", "", f"```python\n{signature(node, kind)}\n```", "", markdown(ast.get_docstring(node)), "")
    if isinstance(node, ast.ClassDef):
        seen: set[str] = set()
        for each in _public(node.body):
            if each.name not in seen:  # a setter stands with its property
                seen.add(each.name)
                yield from _describe(each, f"{level}#", f"{node.name}.")


def _kind(node: ast.FunctionDef | ast.ClassDef) -> str:
    """What a definition is, as its decorators say."""
    marks = {ast.unparse(mark).partition("(")[0].rpartition(".")[2] for mark in node.decorator_list}
    return next((mark for mark in ("property", "cached_property", "classmethod", "staticmethod", "dataclass") if mark in marks), "")


def signature(node: ast.FunctionDef | ast.ClassDef, kind: str = "") -> str:
    """The head of a definition as a reader would call it: without ``self``, long ones with an argument on each line."""
    if isinstance(node, ast.ClassDef):
        made = next((each for each in node.body if isinstance(each, ast.FunctionDef) and each.name == "__init__"), None)
        fields = [each for each in node.body if isinstance(each, ast.AnnAssign) and not ast.unparse(each.target).startswith("_")]
        parts = _arguments(made) if made else [ast.unparse(field) for field in fields]
        bases = ", ".join(map(ast.unparse, node.bases))
        bases = f"  # a {', '.join(map(ast.unparse, node.bases))}" if node.bases else ""
        return f"class {_call(node.name, parts) if parts else node.name}{bases}"
    result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    if kind.endswith("property"):
        return f"{node.name}{result}"
    return _call(node.name, _arguments(node)) + result


def _call(name: str, parts: list[str]) -> str:
    line = f"{name}({', '.join(parts)})"
    return line if len(line) < WIDTH else "\n".join([f"{name}(", *(f"    {part}," for part in parts), ")"])


def _arguments(node: ast.FunctionDef) -> list[str]:
    """Arguments with annotations and defaults, as in the source."""
    given = node.args
    plain = [*given.posonlyargs, *given.args]
    defaults: list[ast.expr | None] = [*[None] * (len(plain) - len(given.defaults)), *given.defaults]
    parts = [_argument(each, default) for each, default in zip(plain, defaults, strict=True) if each.arg not in ("self", "cls")]
    if given.vararg:
        parts.append(f"*{ast.unparse(given.vararg)}")
    elif given.kwonlyargs:
        parts.append("*")
    parts += [_argument(each, default) for each, default in zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    return parts + ([f"**{ast.unparse(given.kwarg)}"] if given.kwarg else [])


def _argument(each: ast.arg, default: ast.expr | None) -> str:
    return ast.unparse(each) + (f" = {ast.unparse(default)}" if default else "")


def markdown(text: str | None) -> str:
    """A numpydoc docstring as Markdown."""
    head, *sections = re.split(r"^([A-Z][A-Za-z ]+)\n-{3,}\n", text or "", flags=re.MULTILINE)
    parts = [plain(head)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        entries = re.findall(r"^(\S[^\n]*)\n?((?:    [^\n]*\n?|\n)*)", body, re.MULTILINE)
        parts.append(f"**{title}**")
        parts.append(
            plain(body) if title in ("Notes", "Examples", "References") else "\n".join(_entry(name, said) for name, said in entries)
        )
    return "\n\n".join(part.strip("\n") for part in parts if part.strip())


def _entry(name: str, said: str) -> str:
    """One parameter, attribute or error as an item of a list."""
    names, _, kind = name.partition(" : ")
    about = plain(" ".join(said.split()))
    return f"- `{names.strip()}`" + (f" ({plain(kind)})" if kind else "") + (f": {about}" if about else "")


def plain(text: str) -> str:
    """Text of a docstring for Markdown: names in backticks become code, indented blocks stay, nothing else is markup."""
    lines = []
    for line in text.splitlines():
        if line.startswith("    "):
            lines.append(line)
            continue
        pieces = re.split(r"(``.*?``|`[^`]*`)", line)
        lines.append(
            "".join(f"`{piece.strip('`')}`" if k % 2 else re.sub(r"([*<$\[\]])", r"\\\1", piece) for k, piece in enumerate(pieces))
        )
    return "\n".join(lines)


def _list_exports(tree: ast.Module) -> dict[str, str]:
    """Names that a module offers of others (``__all__``; all, if it does nothing but import them), and where they are defined."""
    places = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    assigned = {ast.unparse(target): node.value for node in tree.body if isinstance(node, ast.Assign) for target in node.targets}
    if "_OFFERED" in assigned:  # names that are imported when they are first used
        offered, renamed = (ast.literal_eval(assigned[name]) for name in ("_OFFERED", "_RENAMED"))
        renamed = {name: place.replace(":", ".") for name, place in renamed.items()}
        return dict(sorted(({name: place for place, names in offered.items() for name in names} | renamed).items()))
    if "_PLACES" in assigned:
        return dict(ast.literal_eval(assigned["_PLACES"]))
    only_imports = all(isinstance(node, ast.Expr | ast.ImportFrom) for node in tree.body)
    names = ast.literal_eval(assigned["__all__"]) if "__all__" in assigned else list(places) if only_imports else []
    return {name: places[name] for name in names if name in places}


def list_undocumented() -> list[str]:
    """Public functions, classes and methods that neither have a docstring nor stand for one that has.

    A method needs none where another class of the packages explains the method of that name: a protocol or base class that it fills.
    A setter needs none beside its property, and a test of a contract says by its name what it tests.
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
                found += [
                    f"{module.name}.{node.name}.{each.name}"
                    for each in silent
                    if each.name not in said and not each.name.startswith("test_")
                ]
    return found


def _public(body: list[ast.stmt]) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_") and not _registers(node):
            yield node


def _registers(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Whether a decorator that takes a description registers the function: ``@condition("darker", ...)``."""
    return any(isinstance(mark, ast.Call) and len(mark.args) > 1 for mark in node.decorator_list)


def _methods(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield from ((each.name, each) for each in _public(node.body))
