"""The code that made a result: all modules that a function imports directly or indirectly, and the versions of its libraries.

Modules are found by the import statements in their files, including those in functions. A name that a package re-exports is followed to
the module that defines it, so the package's other modules don't count. The fingerprint of a module is that of its syntax tree without
strings that stand alone, which are docstrings and explanations of constants, and without what a raised error says, because a computation
that raises has no result. Comments and formatting are not in the tree. Therefore a changed formula changes the fingerprint, and a changed
explanation or error does not. The texts of the command line are in ``twin.cli``, which no computing module imports.

To parse all modules takes a quarter of a second. So what a module held is stored in the cache folder, by the digest of its source.

``made_by`` is the record that every output has of this code, with the digest of its inputs.
"""

import ast
import gc
import hashlib
import inspect
import json
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from datetime import UTC, datetime
from functools import cache, cached_property, partial
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from twin.errors import StoreError
from twin.store.atomic import cache_folder, make_folder, write_json

PACKAGES = ("scenes", "twin", "training", "hardware")
ROOT = Path(__file__).parents[2]  # the folder that the packages lie in
KEEPER = "twin.store"  # package that does not count, because it stores results and does not compute them
LIBRARIES = {  # import name -> distribution, for libraries whose version may change a result
    "cv2": "opencv-python-headless",
    "drjit": "drjit",
    "mitsuba": "mitsuba",
    "numba": "numba",
    "numpy": "numpy",
    "scipy": "scipy",
    "skimage": "scikit-image",
    "torch": "torch",
    "trimesh": "trimesh",
}

_KNOWN = "modules.json"  # file in the cache folder
_From = tuple[str, str | None]  # a module, and the name that is taken from it (None: the module itself)
Maker = Callable[..., Any] | str  # a function, a class, or the name of a module


class UnknownCodeError(StoreError):
    """The source of a function can't be read, because it was typed in and not read from a file."""


@dataclass(frozen=True)
class CodeOf:
    """The code behind a result.

    Attributes
    ----------
    modules : dict of str to str
        Digest of each module, by its name.
    libraries : dict of str to str
        Version of each library, by its distribution's name.
    """

    modules: Mapping[str, str]
    libraries: Mapping[str, str]

    @cached_property
    def fingerprint(self) -> str:
        """One digest of all modules and libraries, 64 hexadecimal digits."""
        lines = [f"{name} {of}\n" for part in (self.modules, self.libraries) for name, of in sorted(part.items())]
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def record(self) -> dict[str, dict[str, str]]:
        """The code as a dict for JSON."""
        return {"modules": dict(sorted(self.modules.items())), "libraries": dict(sorted(self.libraries.items()))}

    def changes(self, record: Mapping[str, Mapping[str, str]]) -> list[str]:
        """Differences from the code of a record, each in a few words; empty if there are none."""
        before, now = record["modules"], self.modules
        kinds = {"is gone": before.keys() - now.keys(), "is new": now.keys() - before.keys()}
        kinds["changed"] = {name for name in before.keys() & now.keys() if before[name] != now[name]}
        had, has = record["libraries"], self.libraries
        libraries = [(name, has.get(name, "not used"), had.get(name, "not used")) for name in sorted({*had, *has})]
        return [f"{name} {kind}" for kind in reversed(kinds) for name in sorted(kinds[kind])] + [
            f"{name} {new}, was {old}" for name, new, old in libraries if new != old
        ]


def fingerprint(*makers: Maker) -> str:
    """Digest of the code behind functions, as 64 hexadecimal digits; see ``code_of``."""
    return code_of(*makers).fingerprint


def code_of(*makers: Maker, root: Path = ROOT) -> CodeOf:
    """The code of functions. It is read once in a process.

    Parameters
    ----------
    makers : functions, classes or names of modules
        For each the code is that of its module and of all that this imports. For ``functools.partial``, methods and callable instances it
        is that of the called function.
    root : Path
        Folder of the packages.

    Raises
    ------
    UnknownCodeError
        The source of one of them can't be read.
    """
    own = map(_unwrap, makers)
    return _code(root, tuple(sorted({maker if isinstance(maker, str) else maker.__module__ for maker in own})))


def name_of(maker: Maker) -> str:
    """Name of a function or class with its module, or name of a module."""
    maker = _unwrap(maker)
    return maker if isinstance(maker, str) else f"{maker.__module__}.{maker.__qualname__}"


def _unwrap(maker: Maker) -> Maker:
    """The function or class itself: the one that a partial or a decorated function calls, or the class of a callable instance."""
    while isinstance(maker, partial):
        maker = maker.func
    if isinstance(maker, str):
        return maker
    maker = inspect.unwrap(maker)
    return maker if inspect.isroutine(maker) or inspect.isclass(maker) else type(maker)


@cache
def _code(root: Path, starts: tuple[str, ...]) -> CodeOf:
    before = dict(_known_modules())
    modules, libraries, waiting = {}, set(), [(name, _file_of(root, name)) for name in starts]
    while waiting:
        name, file = waiting.pop()
        if name in modules:
            continue
        if file is None:
            raise UnknownCodeError(f"{name}: its source can't be read, so what it computes can't be kept; write it to a file")
        found = _read_module(root, file, name)
        modules[name] = found.digest
        for imported, asked in found.imports:
            top = imported.partition(".")[0]
            if top in LIBRARIES:
                libraries.add(LIBRARIES[top])
            elif top in PACKAGES:
                waiting += [(each, _source(root, each)) for each in _resolve_import(root, imported, asked)]
    folder = cache_folder()
    if folder is not None and before != _known_modules():
        with suppress(StoreError):
            write_json(make_folder(folder) / _KNOWN, {file: found for file, found in _known_modules().items() if Path(file).is_file()})
    return CodeOf(modules, {name: _version(name) for name in libraries})


def _file_of(root: Path, name: str) -> Path | None:
    """Source of a module at which the search starts. It may be outside of the packages."""
    if name.partition(".")[0] in PACKAGES:
        return _source(root, name)
    file = getattr(sys.modules.get(name), "__file__", None)
    return Path(file) if file and Path(file).is_file() else None


@cache
def _source(root: Path, name: str) -> Path | None:
    """File of a module, or of a package's ``__init__``; None if there is none."""
    place = root.joinpath(*name.split("."))
    return next((file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()), None)


def _resolve_import(root: Path, name: str, asked: str | None) -> list[str]:
    """Modules whose code ``from name import asked`` (or ``import name``) uses."""
    if name == KEEPER or name.startswith(f"{KEEPER}."):
        return []
    if asked is None or asked == "*":
        return [name]
    if _source(root, f"{name}.{asked}") is not None:
        return _resolve_import(root, f"{name}.{asked}", None)
    file = _source(root, name)
    if file is None or file.name != "__init__.py":
        return [name]
    passed_on = _read_module(root, file, name).names.get(asked)
    return [name] if passed_on is None else _resolve_import(root, *passed_on)


@dataclass(frozen=True)
class _Module:
    """One file: digest, imports as (module, name or None), and the names that it imports from other modules."""

    digest: str
    imports: tuple[_From, ...]
    names: Mapping[str, _From]


@cache
def _read_module(root: Path, file: Path, name: str) -> _Module:
    try:
        source = file.read_bytes()
        key = hashlib.sha256(b"\0".join([*_reader(), name.encode(), source])).hexdigest()
        with suppress(LookupError, TypeError, ValueError):  # not stored, or damaged
            digest, imports, names = _known_modules()[str(file)][key]
            return _Module(
                digest, tuple((of, asked) for of, asked in imports), {called: (of, asked) for called, (of, asked) in names.items()}
            )
        found = _parse(source.decode(), name, file.name == "__init__.py")
    except (OSError, SyntaxError, UnicodeDecodeError) as error:
        raise UnknownCodeError(f"{file}: not readable ({error}); install the program again") from error
    _known_modules()[str(file)] = {key: list(vars(found).values())}
    return found


@cache
def _reader() -> tuple[bytes, bytes]:
    """What is found in a source also depends on this: the code here, and Python's version."""
    return Path(__file__).read_bytes(), sys.version.encode()


def _parse(source: str, name: str, is_package: bool) -> _Module:
    collecting = gc.isenabled()
    gc.disable()  # a syntax tree has many small objects, and garbage collection would double the time
    try:
        tree = ast.parse(source)
        imports, names = _imports(tree, name, is_package)
        return _Module(hashlib.sha256(_bare(tree).encode()).hexdigest()[:16], imports, names)
    finally:
        if collecting:
            gc.enable()


@cache
def _known_modules() -> dict[str, Any]:
    """What was found in files, by file and digest of the source: by earlier processes, and by this one."""
    folder = cache_folder()
    with suppress(OSError, ValueError, TypeError):
        return dict(json.loads((folder / _KNOWN).read_text("utf-8"))) if folder else {}
    return {}


def _imports(tree: ast.Module, module: str, is_package: bool) -> tuple[tuple[_From, ...], dict[str, _From]]:
    """All imports of a module, except those for a type checker alone, and the names that it imports from other modules."""
    found: dict[_From, None] = {}
    names: dict[str, _From] = {}
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            waiting += node.orelse
        elif isinstance(node, ast.Import):
            for alias in node.names:
                found[alias.name, None] = None
                names[alias.asname or alias.name.partition(".")[0]] = (alias.name, None)
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: len(module.split(".")) - node.level + is_package] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                found[source, alias.name] = None
                names[alias.asname or alias.name] = (source, alias.name)
        elif isinstance(node, ast.stmt | ast.Module | ast.ExceptHandler | ast.match_case):
            waiting += ast.iter_child_nodes(node)
    return tuple(found), names


def _bare(tree: ast.Module) -> str:
    """A syntax tree as text, without strings that stand alone, what raised errors say, and line numbers. The tree is changed."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc.args = [part for part in node.exc.args if not _is_words(part)]
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if isinstance(block, list):
                setattr(node, name, [part for part in block if not _is_text(part)])
    return ast.dump(tree)


def _is_words(part: ast.expr) -> bool:
    """Whether an expression is a literal text, or several that are joined. A number that an error carries is not."""
    if isinstance(part, ast.BinOp):
        return isinstance(part.op, ast.Add) and (_is_words(part.left) or _is_words(part.right))
    return isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str))


def _is_text(part: object) -> bool:
    """Whether a part of a syntax tree is a statement of a string alone: a docstring, or the explanation of a constant above it."""
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)


@cache
def _version(distribution: str, otherwise: str = "of another origin") -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return otherwise


PROGRAM = "tactip-twin"
"""Name under which this program is installed."""


def inputs_digest(*inputs: object) -> str:
    """Digest of inputs, 64 hexadecimal digits. It does not depend on the order of a dict's keys.

    Parameters
    ----------
    inputs : objects
        Values that JSON can hold, bytes, arrays of numbers, specifications, dataclasses and paths, nested to any depth.

    Raises
    ------
    TypeError
        An input has another type.
    """
    return hashlib.sha256(json.dumps(inputs, sort_keys=True, default=_plain).encode()).hexdigest()


def _plain(value: object) -> object:
    """A value that JSON can represent, in place of one that it can't."""
    if isinstance(value, bytes):
        return {"sha256": hashlib.sha256(value).hexdigest()}
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return {"array": [value.dtype.str, list(value.shape), hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, PurePath):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    raise TypeError(f"a key holds JSON and bytes, arrays of numbers, specifications and dataclasses, not {type(value).__name__}")


def made_by(*by: Maker, inputs: object = None, dated: bool = True) -> dict[str, str]:
    """The record of a result.

    Parameters
    ----------
    by : functions, classes or names of modules
        The code that made the result; the record has the name of the first one.
    inputs : object, optional
        The inputs of the result, as ``inputs_digest`` takes them.
    dated : bool
        Whether the record has a date. It must be False if the same work must give the same bytes.

    Returns
    -------
    dict of str to str
        ``by`` (name), ``version`` (of the program), ``code`` (fingerprint), ``inputs`` (digest, if there are any) and ``date`` (UTC).
    """
    record = {"by": name_of(by[0]), "version": program_version(), "code": fingerprint(*by)}
    if inputs is not None:
        record["inputs"] = inputs_digest(inputs)
    return record | ({"date": datetime.now(UTC).isoformat(timespec="seconds")} if dated else {})


def program_version() -> str:
    """Version of this program, or "not installed"."""
    return _version(PROGRAM, "not installed")
